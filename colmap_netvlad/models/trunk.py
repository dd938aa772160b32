"""What every trunk has in common: a fully convolutional network from pixels to local features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval


@dataclass(frozen=True)
class Normalisation:
    """How pixels become the input a trunk was trained on: (pixels - mean) / std, by channel.

    Attributes:
        channels: the order of the input's three channels; mean and std follow it.
        mean, std: in units of 0..255.
    """

    channels: Literal["rgb", "bgr"]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]

    def __call__(self, pixels: Tensor) -> Tensor:
        """Normalise RGB pixels of 0..255, float (B, 3, H, W)."""
        if self.channels == "bgr":
            pixels = pixels.flip(1)
        mean = pixels.new_tensor(self.mean).view(1, 3, 1, 1)
        std = pixels.new_tensor(self.std).view(1, 3, 1, 1)
        return (pixels - mean) / std

    def as_dict(self) -> dict[str, Any]:
        """Plain data for a checkpoint's metadata."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Normalisation:
        """Read back what `as_dict` made."""
        return cls(data["channels"], tuple(data["mean"]), tuple(data["std"]))


KERAS_BGR = Normalisation("bgr", (103.939, 116.779, 123.68), (1.0, 1.0, 1.0))
"""Keras' VGG-16 (Caffe's convention)."""

TORCHVISION_RGB = Normalisation("rgb", (123.675, 116.28, 103.53), (58.395, 57.12, 57.375))
"""torchvision's models: mean (0.485, 0.456, 0.406) and std (0.229, 0.224, 0.225) times 255."""

TENSORFLOW_LITE_RGB = Normalisation("rgb", (127.0, 127.0, 127.0), (128.0, 128.0, 128.0))
"""Google's EfficientNet-Lite."""

TIMM_RGB = Normalisation("rgb", (127.5, 127.5, 127.5), (127.5, 127.5, 127.5))
"""timm's ports of TensorFlow models."""


class Trunk(nn.Module):
    """A network from normalised pixels (B, 3, H, W) to features (B, channels, h, w).

    Attributes:
        name: its row in `backbones.BACKBONES`.
        channels: D, the length of one local feature.
        stride: pixels between neighbouring features; h and w are H and W divided by it, rounded
            up or down by the family's padding.
        normalisation: the input its weights expect.
    """

    name: str
    channels: int
    stride: int
    normalisation: Normalisation

    def convolutions_with_batch_norm(self) -> Iterator[tuple[nn.Module, str, str]]:
        """Owner and attribute names of every convolution and the batch norm after it."""
        yield from ()


def fold_batch_norm(trunk: Trunk) -> None:
    """Fold every batch norm into the convolution before it: same result, less to compute.

    For inference only: the trunk changes in place, loses its batch norms, and must be in
    evaluation mode.
    """
    for owner, convolution, batch_norm in trunk.convolutions_with_batch_norm():
        fused = fuse_conv_bn_eval(getattr(owner, convolution), getattr(owner, batch_norm))
        setattr(owner, convolution, fused)
        setattr(owner, batch_norm, nn.Identity())
