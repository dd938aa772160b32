"""EfficientNet-Lite0 (Google, 2020): EfficientNet-B0 without squeeze-and-excitation, ReLU6.

The small trunk for laptops: 0.4 G multiplications at 224 x 224 where VGG-16 needs 15 G.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from torch import Tensor, nn
from torch.nn import functional

from colmap_netvlad.models.trunk import TENSORFLOW_LITE_RGB, Normalisation, Trunk

BATCH_NORM_EPS = 1e-3  # TensorFlow's, ten thousand times PyTorch's


class Stage(NamedTuple):
    """A run of equal blocks; the stride belongs to the first of them."""

    blocks: int
    kernel: int
    stride: int
    expansion: int
    channels: int


STEM_CHANNELS = 32
STAGES = (
    Stage(1, 3, 1, 1, 16),  # block 0        (B, 16, H/2, W/2)
    Stage(2, 3, 2, 6, 24),  # blocks 1, 2    (B, 24, H/4, W/4)
    Stage(2, 5, 2, 6, 40),  # blocks 3, 4    (B, 40, H/8, W/8)
    Stage(3, 3, 2, 6, 80),  # blocks 5 to 7  (B, 80, H/16, W/16)
    Stage(3, 5, 1, 6, 112),  # blocks 8 to 10 (B, 112, H/16, W/16)
    Stage(4, 5, 2, 6, 192),  # blocks 11 to 14 (B, 192, H/32, W/32)
    Stage(1, 3, 1, 6, 320),  # block 15      (B, 320, H/32, W/32)
)


class SameConv2d(nn.Conv2d):
    """A convolution without bias, padded as TensorFlow's "SAME" does for even inputs.

    At stride 2 the padding is one shorter on the top and left than on the bottom and right.
    """

    def __init__(
        self, channels: int, out: int, kernel: int, stride: int = 1, groups: int = 1
    ) -> None:
        padding = kernel // 2 if stride == 1 else 0
        super().__init__(channels, out, kernel, stride, padding, groups=groups, bias=False)
        before = (kernel - stride) // 2
        self.border = (before, kernel - stride - before)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W) to (B, out, H / stride, W / stride)."""
        if self.stride[0] > 1:
            x = functional.pad(x, self.border * 2)
        return super().forward(x)


class Block(nn.Module):
    """Expand 1 x 1, depthwise k x k, project 1 x 1; a short cut where the shape stays.

    Attribute names are those of the published weights.
    """

    def __init__(self, channels: int, out: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        width = channels * expansion
        self.expands = expansion > 1
        self.short_cut = stride == 1 and channels == out
        if self.expands:
            self._expand_conv = SameConv2d(channels, width, 1)
            self._bn0 = nn.BatchNorm2d(width, eps=BATCH_NORM_EPS)
        self._depthwise_conv = SameConv2d(width, width, kernel, stride, groups=width)
        self._bn1 = nn.BatchNorm2d(width, eps=BATCH_NORM_EPS)
        self._project_conv = SameConv2d(width, out, 1)
        self._bn2 = nn.BatchNorm2d(out, eps=BATCH_NORM_EPS)
        self.relu = nn.ReLU6(inplace=True)

    def forward(self, inputs: Tensor) -> Tensor:
        """Features in, features out."""
        x = inputs
        if self.expands:
            x = self.relu(self._bn0(self._expand_conv(x)))
        x = self.relu(self._bn1(self._depthwise_conv(x)))
        x = self._bn2(self._project_conv(x))
        return x + inputs if self.short_cut else x


class EfficientNetLite0(Trunk):
    """EfficientNet-Lite0 up to the end of one of its stages, without head and classifier.

    With all stages features are (B, 320, H / 32, W / 32); with `stages=5` they are
    (B, 112, H / 16, W / 16), which retrieves as well at a third of the descriptor's length.
    """

    def __init__(
        self, stages: int = len(STAGES), normalisation: Normalisation = TENSORFLOW_LITE_RGB
    ) -> None:
        super().__init__()
        self.name = f"efficientnet-lite0-stage{stages}"
        self.normalisation = normalisation
        self._conv_stem = SameConv2d(3, STEM_CHANNELS, 3, stride=2)
        self._bn0 = nn.BatchNorm2d(STEM_CHANNELS, eps=BATCH_NORM_EPS)
        self.relu = nn.ReLU6(inplace=True)
        blocks: list[Block] = []
        channels, self.stride = STEM_CHANNELS, 2
        for stage in STAGES[:stages]:
            for i in range(stage.blocks):
                stride = stage.stride if i == 0 else 1
                blocks.append(
                    Block(channels, stage.channels, stage.kernel, stride, stage.expansion)
                )
                channels = stage.channels
            self.stride *= stage.stride
        self._blocks = nn.ModuleList(blocks)
        self.channels = channels

    def forward(self, pixels: Tensor) -> Tensor:
        """Normalised pixels (B, 3, H, W) to the last stage (B, channels, h, w)."""
        x = self.relu(self._bn0(self._conv_stem(pixels)))  # (B, 32, H/2, W/2)
        for block in self._blocks:
            x = block(x)
        return x

    def convolutions_with_batch_norm(self) -> Iterator[tuple[nn.Module, str, str]]:
        """See `Trunk`."""
        yield self, "_conv_stem", "_bn0"
        for block in self._blocks:
            assert isinstance(block, Block)
            if block.expands:
                yield block, "_expand_conv", "_bn0"
            yield block, "_depthwise_conv", "_bn1"
            yield block, "_project_conv", "_bn2"
