"""The table of trunks, and where their ImageNet weights are published."""

from __future__ import annotations

import re
import urllib.error
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from colmap_netvlad.models.efficientnet_lite import EfficientNetLite0
from colmap_netvlad.models.resnet import ResNet50
from colmap_netvlad.models.trunk import (
    KERAS_BGR,
    TENSORFLOW_LITE_RGB,
    TIMM_RGB,
    TORCHVISION_RGB,
    Normalisation,
    Trunk,
)
from colmap_netvlad.models.vgg import VGG16
from colmap_netvlad.runtime.errors import InputError


def same_key(key: str) -> str:
    """The published key is ours."""
    return key


def timm_lite_key(key: str) -> str:
    """Translate timm's key of EfficientNet-Lite0 to the TensorFlow port's."""
    match = re.fullmatch(r"blocks\.(\d+)\.(\d+)\.(\w+)\.(.+)", key)
    if match is None:
        return re.sub(r"^bn1\.", "_bn0.", re.sub(r"^conv_stem\.", "_conv_stem.", key))
    stage, block, layer, rest = match.groups()
    first_block = (0, 1, 3, 5, 8, 11, 15)[int(stage)]
    # Blocks without expansion (stage 0) number their layers from the depthwise convolution.
    names = (
        {"conv_dw": "_depthwise_conv", "bn1": "_bn1", "conv_pw": "_project_conv", "bn2": "_bn2"}
        if stage == "0"
        else {
            "conv_pw": "_expand_conv",
            "bn1": "_bn0",
            "conv_dw": "_depthwise_conv",
            "bn2": "_bn1",
            "conv_pwl": "_project_conv",
            "bn3": "_bn2",
        }
    )
    return f"_blocks.{first_block + int(block)}.{names.get(layer, layer)}.{rest}"


@dataclass(frozen=True)
class PublishedWeights:
    """ImageNet weights somebody publishes.

    Attributes:
        url: a file name that ends in `-` and the start of its sha256, as torch hub checks it.
        normalisation: the input they expect.
        key: their key to ours.
        licence: who made them, under which terms.
    """

    url: str
    normalisation: Normalisation
    key: Callable[[str], str]
    licence: str

    @property
    def file(self) -> Path:
        """Where torch hub keeps the download: under $TORCH_HOME, else ~/.cache/torch."""
        return Path(torch.hub.get_dir()) / "checkpoints" / self.url.rsplit("/", 1)[1]

    def state(self) -> dict[str, Tensor]:
        """The weights under our keys, downloaded on first use and checked by their sha256.

        Raises:
            InputError: they are not there and cannot be downloaded.
        """
        try:
            state = torch.hub.load_state_dict_from_url(
                self.url, map_location="cpu", progress=False, check_hash=True, weights_only=True
            )
        except (urllib.error.URLError, OSError) as fault:
            raise InputError(
                f"Cannot download {self.url} ({getattr(fault, 'reason', fault)}): "
                f"fetch it on a machine with internet access and put it at {self.file}."
            ) from fault
        except RuntimeError as fault:  # torch's word for a wrong checksum
            raise InputError(
                f"The download of {self.url} is damaged ({fault}): try again."
            ) from fault
        return {self.key(key): value for key, value in state.items()}


@dataclass(frozen=True)
class Backbone:
    """One row of the table: how to build a trunk, and its published weights."""

    build: Callable[[Normalisation], Trunk]
    published: PublishedWeights
    summary: str


VGG16_TORCHVISION = PublishedWeights(
    "https://download.pytorch.org/models/vgg16-397923af.pth",
    TORCHVISION_RGB,
    same_key,
    "torchvision VGG16_Weights.IMAGENET1K_V1, BSD-3-Clause",
)
RESNET50_TORCHVISION = PublishedWeights(
    "https://download.pytorch.org/models/resnet50-11ad3fa6.pth",
    TORCHVISION_RGB,
    same_key,
    "torchvision ResNet50_Weights.IMAGENET1K_V2, BSD-3-Clause",
)
LITE0_TIMM = PublishedWeights(
    "https://github.com/rwightman/pytorch-image-models/releases/download/"
    "v0.1-weights/tf_efficientnet_lite0-0aa007d2.pth",
    TIMM_RGB,
    timm_lite_key,
    "Google's EfficientNet-Lite0 as ported by timm, Apache-2.0",
)

BACKBONES: dict[str, Backbone] = {
    "vgg16": Backbone(VGG16, VGG16_TORCHVISION, "VGG-16 to conv5_3: 512 channels, stride 16"),
    "resnet50": Backbone(ResNet50, RESNET50_TORCHVISION, "ResNet-50: 2048 channels, stride 32"),
    "efficientnet-lite0-stage7": Backbone(
        lambda normalisation: EfficientNetLite0(7, normalisation),
        LITE0_TIMM,
        "EfficientNet-Lite0, all stages: 320 channels, stride 32",
    ),
    "efficientnet-lite0-stage5": Backbone(
        lambda normalisation: EfficientNetLite0(5, normalisation),
        LITE0_TIMM,
        "EfficientNet-Lite0, five of seven stages: 112 channels, stride 16",
    ),
}

KNOWN_INPUTS: dict[str, Normalisation] = {
    # What a weight file may say about itself in its metadata's `input`.
    "BGR 0..255 minus (103.939,116.779,123.68)": KERAS_BGR,
    "RGB (x-127)/128": TENSORFLOW_LITE_RGB,
}


def build_trunk(name: str, normalisation: Normalisation | None = None) -> Trunk:
    """Make a trunk without trained weights.

    Raises:
        InputError: no such backbone.
    """
    if name not in BACKBONES:
        raise InputError(f"No backbone is called {name!r}: there are {', '.join(BACKBONES)}.")
    backbone = BACKBONES[name]
    return backbone.build(normalisation or backbone.published.normalisation)


def load_trunk(name: str, weights: Path | None = None) -> Trunk:
    """Make a trunk with ImageNet weights: a local file's, or the published ones.

    Args:
        name: a row of `BACKBONES`.
        weights: a .safetensors file (whose metadata `input` names the normalisation) or a
            published .pth file. None downloads the published file through torch hub.

    Raises:
        InputError: no such backbone, the file is missing, damaged or of another network, or the
            download fails.
    """
    trunk = build_trunk(name)
    published = BACKBONES[name].published
    if weights is None:
        state = published.state()
    elif weights.suffix == ".safetensors":
        state, trunk.normalisation = read_safetensors(weights, trunk.normalisation)
    else:
        state = {published.key(key): value for key, value in read_pth(weights).items()}
    load_by_key(trunk, state, weights or Path(published.url))
    return trunk


def read_safetensors(
    path: Path, normalisation: Normalisation
) -> tuple[dict[str, Tensor], Normalisation]:
    """Tensors of a weight file and the normalisation it names, else the one given."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            named = (file.metadata() or {}).get("input", "")
            # safe_open is no iterable and its keys() no dictionary's
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as fault:
        raise InputError(f"Cannot read the weights {path}: {fault}.") from fault
    return state, KNOWN_INPUTS.get(named, normalisation)


def read_pth(path: Path) -> dict[str, Tensor]:
    """Tensors of a PyTorch file, without running code from it."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as fault:  # torch raises a dozen kinds for files that are not its own
        reason = str(fault).splitlines()[0] if str(fault) else type(fault).__name__
        raise InputError(f"Cannot read the weights {path}: {reason}") from fault


def load_by_key(trunk: Trunk, state: dict[str, Tensor], source: Path) -> None:
    """Copy what the trunk needs out of `state`; the rest (classifiers) is left.

    Raises:
        InputError: a key is missing or has another shape.
    """
    needed = trunk.state_dict()
    for key, value in needed.items():
        if key.endswith("num_batches_tracked"):
            continue  # counts training steps, not needed to run
        if key not in state:
            raise InputError(f"{source} holds no weights of {trunk.name}: {key} is missing.")
        if state[key].shape != value.shape:
            raise InputError(
                f"{source} is no {trunk.name}: {key} is {tuple(state[key].shape)}, "
                f"not {tuple(value.shape)}."
            )
    kept = {key: state[key].float() for key in needed if key in state}
    trunk.load_state_dict(kept, strict=False)
