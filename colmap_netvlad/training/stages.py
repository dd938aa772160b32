"""Trunks as a row of named stages, so that the first of them can stay frozen."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from colmap_netvlad.models.describe import choose_precision
from colmap_netvlad.models.efficientnet_lite import EfficientNetLite0
from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.models.resnet import ResNet50
from colmap_netvlad.models.trunk import Trunk
from colmap_netvlad.models.vgg import VGG16
from colmap_netvlad.runtime.errors import InputError


def _vgg_stages(trunk: VGG16) -> dict[str, nn.Module]:
    """conv1_1 to conv5_3; a pooling belongs to the convolution before it, as its ReLU does."""
    stages: dict[str, list[nn.Module]] = {}
    block = number = 1
    for layer in trunk.features:
        if isinstance(layer, nn.Conv2d):
            stages[name := f"conv{block}_{number}"] = [layer]
            number += 1
            continue
        stages[name].append(layer)
        if isinstance(layer, nn.MaxPool2d):
            block, number = block + 1, 1
    return {name: nn.Sequential(*layers) for name, layers in stages.items()}


def _resnet_stages(trunk: ResNet50) -> dict[str, nn.Module]:
    stem = nn.Sequential(trunk.conv1, trunk.bn1, trunk.relu, trunk.maxpool)
    return {"stem": stem} | {f"layer{i}": getattr(trunk, f"layer{i}") for i in (1, 2, 3, 4)}


def _lite_stages(trunk: EfficientNetLite0) -> dict[str, nn.Module]:
    stem = nn.Sequential(trunk._conv_stem, trunk._bn0, trunk.relu)
    return {"stem": stem} | {f"block{i}": block for i, block in enumerate(trunk._blocks)}


_STAGES: dict[type[Trunk], Callable[..., dict[str, nn.Module]]] = {
    VGG16: _vgg_stages,
    ResNet50: _resnet_stages,
    EfficientNetLite0: _lite_stages,
}


def stages_of(trunk: Trunk) -> dict[str, nn.Module]:
    """Return the trunk's stages by name, in order; one after the other they are the trunk."""
    return _STAGES[type(trunk)](trunk)


class SplitNetwork(nn.Module):
    """A network cut in two: a frozen front, whose features can be kept, and a trained rest.

    Batch normalisation keeps its statistics throughout: batches of a few flights are no sample
    of them.
    """

    def __init__(self, network: GlobalDescriptor, frozen: str | None = None) -> None:
        """Cut after the stage `frozen`; None freezes nothing.

        Raises:
            InputError: the trunk has no stage of that name.
        """
        super().__init__()
        self.network = network
        stages = stages_of(network.trunk)
        if frozen is not None and frozen not in stages:
            raise InputError(
                f"The trunk {network.trunk.name} has no stage {frozen!r}; "
                f"it has {', '.join(stages)}."
            )
        cut = list(stages).index(frozen) + 1 if frozen is not None else 0
        layers = list(stages.values())
        # Held outside the module tree: `network` owns the weights, once.
        self.frozen_layers = tuple(layers[:cut])
        self._rest = tuple(layers[cut:])
        for layer in self.frozen_layers:
            layer.requires_grad_(False)
            layer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.train(False)

    def front(self, pixels: Tensor) -> Tensor:
        """RGB pixels of 0..255 (B, 3, H, W) to the frozen features, float (B, C, h, w)."""
        x = self.network.trunk.normalisation(pixels.float())
        if not self.frozen_layers:
            return x
        # Nothing is learned here, so the precision may be the one that models run in.
        device = pixels.device
        precision = choose_precision(device)
        x = x.contiguous(memory_format=torch.channels_last)
        with (
            torch.no_grad(),
            torch.autocast(device.type, precision, enabled=precision != torch.float32),
        ):
            for layer in self.frozen_layers:
                x = layer(x)
        return x.float().contiguous()

    def features(self, front: Tensor) -> Tensor:
        """Frozen features (B, C, h, w) to the trunk's features (B, D, h', w')."""
        x = front
        for layer in self._rest:
            # Layers may work in place; the first must not touch the kept features.
            x = layer(x.clone() if x is front else x)
        return x

    def rest(
        self, front: Tensor, share: float = 1.0, rng: np.random.Generator | None = None
    ) -> Tensor:
        """Frozen features (B, C, h, w) to descriptors (B, dim), L2-normalised.

        Args:
            share: of the local features that are aggregated; below 1 they are drawn by `rng`.
        """
        features = self.features(front)
        if share < 1 and rng is not None:
            features = features.flatten(2)
            count = features.shape[2]
            drawn = np.sort(rng.permutation(count)[: max(1, round(share * count))])
            features = features[:, :, torch.from_numpy(drawn).to(features.device)].unsqueeze(2)
        descriptors: Tensor = self.network.aggregation(features)
        whitening = self.network.whitening
        return descriptors if whitening is None else whitening(descriptors)

    def forward(self, pixels: Tensor) -> Tensor:
        """RGB pixels of 0..255 (B, 3, H, W) to descriptors (B, D), L2-normalised."""
        return self.rest(self.front(pixels))

    def frozen_fingerprint(self) -> str:
        """Return a hash of the frozen stages and of the input they expect."""
        digest = hashlib.sha256(repr(self.network.trunk.normalisation).encode())
        for layer in self.frozen_layers:
            for name, value in layer.state_dict().items():
                digest.update(name.encode() + value.cpu().numpy().tobytes())
        return digest.hexdigest()[:16]

    def trained(self) -> dict[str, nn.Parameter]:
        """The parameters that are trained, by name."""
        return {
            name: parameter
            for name, parameter in self.network.named_parameters()
            if parameter.requires_grad
        }
