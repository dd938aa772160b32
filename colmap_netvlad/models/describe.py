"""Running a model on photos: where, in which precision, in which orientations."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.models.trunk import Trunk, fold_batch_norm
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.runtime.products import threads_of_their_own


def choose_device(name: str | None = None) -> torch.device:
    """The device asked for, else the first CUDA device, else the processor.

    Raises:
        InputError: no such device here.
    """
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as fault:
        raise InputError(
            f"{name!r} is no device: use cpu, cuda, cuda:1 (the second GPU) or mps."
        ) from fault
    present = {
        "cpu": True,
        "cuda": (device.index or 0) < torch.cuda.device_count(),
        "mps": torch.backends.mps.is_available(),
    }
    if not present.get(device.type, False):
        raise InputError(
            f"Device {name} is not available on this machine (or this PyTorch is built without "
            f"it): leave `device` out to use cuda where there is one, else cpu."
        )
    return device


def choose_precision(device: torch.device) -> torch.dtype:
    """The precision in which a trunk runs fastest; the aggregation stays float32.

    Half precision on CUDA. On a processor bfloat16 where it multiplies bfloat16 in hardware
    (AVX512_BF16 or AMX): half the time there, for VGG-16 and EfficientNet-Lite0 alike.
    """
    if device.type == "cuda":
        return torch.float16
    if device.type == "cpu" and has_bfloat16_hardware():
        return torch.bfloat16
    return torch.float32


def has_bfloat16_hardware() -> bool:
    """Whether this processor multiplies bfloat16 numbers itself."""
    capabilities: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def prepare_trunk(trunk: Trunk, device: torch.device, precision: torch.dtype) -> Trunk:
    """A copy of a trunk made fast for inference; the trunk itself can still be trained."""
    fast = copy.deepcopy(trunk).eval().requires_grad_(False)
    fold_batch_norm(fast)
    return fast.to(device, precision).to(memory_format=torch.channels_last)  # type: ignore[call-overload]


class DescriptorModel:
    """A network ready to describe photos.

    Attributes:
        name: what the checkpoint calls itself.
        fingerprint: sha256 (hex) of the checkpoint file: descriptors of two models never mix.
        dim: length of a descriptor.
        long_side: the longer side, in pixels, that photos are reduced to.
        rotations: 1, or 4 for the mean over the four 90 degree rotations.
        metadata: the rest of the checkpoint's card.
    """

    def __init__(
        self,
        network: GlobalDescriptor,
        *,
        name: str,
        fingerprint: str,
        long_side: int,
        rotations: int = 1,
        device: str | None = None,
        metadata: dict[str, object] | None = None,
    ) -> None:
        self.name = name
        self.fingerprint = fingerprint
        self.dim = network.dim
        self.long_side = long_side
        self.rotations = rotations
        self.metadata = metadata or {}
        self.device = choose_device(device)
        self.precision = choose_precision(self.device)
        self._network = copy.deepcopy(network).eval().requires_grad_(False).to(self.device)
        self._network.trunk = prepare_trunk(network.trunk, self.device, self.precision)

    def describe(self, pixels: np.ndarray) -> np.ndarray:
        """Describe photos of one size.

        Args:
            pixels: uint8 (B, 3, H, W), RGB.

        Returns:
            descriptors: float32 (B, dim), L2-normalised.
        """
        return self.describe_with_cells(pixels)[0]

    def describe_with_cells(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Describe photos of one size, as a whole and place by place.

        Args:
            pixels: uint8 (B, 3, H, W), RGB.

        Returns:
            descriptors: float32 (B, dim), L2-normalised.
            cells: float32 (B, A, h, w), L2-normalised, the mean over the turns of each place
            along the network's A axes; zero where the photo has no texture (a mask, a black
            corner), which would look the same in photos that share nothing.
        """
        if len(pixels) == 0:
            return np.zeros((0, self.dim), np.float32), np.zeros((0, 0, 0, 0), np.float32)
        photos = torch.from_numpy(np.ascontiguousarray(pixels))
        if self.device.type != "cpu":
            descriptors, local = self._describe(photos)
            return descriptors.cpu().numpy(), local.cpu().numpy()
        # A thread a photo: they share the layers of one badly, and a descriptor does not depend on
        # which photos happened to be described with it, nor on how many processors there are.
        with threads_of_their_own(min(usable_processors(), len(photos))) as pool:
            parts = list(pool.map(self._describe, photos.split(1)))
        descriptors, local = (torch.cat(part) for part in zip(*parts, strict=True))
        return descriptors.numpy(), local.numpy()

    @torch.inference_mode()
    def _describe(self, photos: Tensor) -> tuple[Tensor, Tensor]:
        photos = photos.to(self.device)
        turned = [torch.rot90(photos, turns, dims=(2, 3)) for turns in range(self.rotations)]
        # Opposite rotations have the same size: two passes for four rotations.
        step = min(2, self.rotations)
        passes = [self._run(torch.cat(turned[first::step])) for first in range(step)]
        descriptors = torch.cat([vectors for vectors, _ in passes])
        mean = descriptors.view(self.rotations, len(photos), -1).mean(dim=0)
        upright = [
            torch.rot90(local, -(first + step * place), dims=(2, 3))
            for first, (_, both) in enumerate(passes)
            for place, local in enumerate(both.split(len(photos)))
        ]
        local = self._network.at_places(torch.stack(upright).mean(dim=0))
        return functional.normalize(mean, dim=1), local * has_texture(photos, local.shape[2:])

    def _run(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        network = self._network
        # Normalised in float32, then rounded: 0..255 minus a mean loses little that way.
        normal = pixels.to(torch.float32, memory_format=torch.channels_last)
        with torch.autocast(
            self.device.type, self.precision, enabled=self.precision != torch.float32
        ):
            descriptors, local = network.with_local(normal)
            return descriptors.float(), local.float()


def has_texture(photos: Tensor, grid: torch.Size) -> Tensor:
    """Return float (B, 1, h, w): 0 where a cell of the grid or one beside it is a single colour.

    Args:
        photos: uint8 (B, 3, H, W).
        grid: (h, w).
    """
    pixels = photos.float()
    brightest = functional.adaptive_max_pool2d(pixels, grid)
    darkest = -functional.adaptive_max_pool2d(-pixels, grid)
    even = (brightest == darkest).all(dim=1, keepdim=True).float()
    return 1 - functional.max_pool2d(even, 3, stride=1, padding=1)
