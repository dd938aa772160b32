"""ResNet-50 (He et al., 2016; version 1.5, the stride in the 3 x 3 convolution)."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor, nn

from colmap_netvlad.models.trunk import TORCHVISION_RGB, Normalisation, Trunk

EXPANSION = 4


class Bottleneck(nn.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolution with a short cut: (B, C, H, W) to (B, 4 W', h, w)."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, width * EXPANSION, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(width * EXPANSION)
        self.relu = nn.ReLU(inplace=True)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels != width * EXPANSION:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, width * EXPANSION, 1, stride=stride, bias=False),
                nn.BatchNorm2d(width * EXPANSION),
            )

    def forward(self, x: Tensor) -> Tensor:
        """Features in, features out."""
        short_cut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)))
        return self.relu(self.bn3(self.conv3(x)) + short_cut)


def stage(channels: int, width: int, blocks: int, stride: int) -> nn.Sequential:
    """One resolution of the network; its first block changes resolution and width."""
    first = Bottleneck(channels, width, stride)
    others = [Bottleneck(width * EXPANSION, width, 1) for _ in range(blocks - 1)]
    return nn.Sequential(first, *others)


class ResNet50(Trunk):
    """ResNet-50 without its pooling and classifier, key names of torchvision.

    Features are (B, 2048, ceil(H / 32), ceil(W / 32)).
    """

    name = "resnet50"
    channels = 2048
    stride = 32

    def __init__(self, normalisation: Normalisation = TORCHVISION_RGB) -> None:
        super().__init__()
        self.normalisation = normalisation
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.layer1 = stage(64, 64, blocks=3, stride=1)
        self.layer2 = stage(256, 128, blocks=4, stride=2)
        self.layer3 = stage(512, 256, blocks=6, stride=2)
        self.layer4 = stage(1024, 512, blocks=3, stride=2)

    def forward(self, pixels: Tensor) -> Tensor:
        """Normalised pixels (B, 3, H, W) to the last block (B, 2048, h, w)."""
        x = self.relu(self.bn1(self.conv1(pixels)))  # (B, 64, H/2, W/2)
        x = self.layer1(self.maxpool(x))  # (B, 256, H/4, W/4)
        x = self.layer2(x)  # (B, 512, H/8, W/8)
        x = self.layer3(x)  # (B, 1024, H/16, W/16)
        return self.layer4(x)  # (B, 2048, H/32, W/32)

    def convolutions_with_batch_norm(self) -> Iterator[tuple[nn.Module, str, str]]:
        """See `Trunk`."""
        yield self, "conv1", "bn1"
        for module in self.modules():
            if isinstance(module, Bottleneck):
                for i in (1, 2, 3):
                    yield module, f"conv{i}", f"bn{i}"
                if module.downsample is not None:
                    yield module.downsample, "0", "1"
