"""VGG-16 (Simonyan and Zisserman, 2015), the trunk of NetVLAD in the paper."""

from __future__ import annotations

from torch import Tensor, nn

from colmap_netvlad.models.trunk import TORCHVISION_RGB, Normalisation, Trunk

# Output channels of the 13 convolutions; "pool" halves the resolution.
LAYERS = (
    *(64, 64, "pool"),  # conv1
    *(128, 128, "pool"),  # conv2
    *(256, 256, 256, "pool"),  # conv3
    *(512, 512, 512, "pool"),  # conv4
    *(512, 512, 512),  # conv5
)


class VGG16(Trunk):
    """VGG-16 up to conv5_3 without its last ReLU, as NetVLAD cuts it.

    Keys are torchvision's: `features.0.weight` (conv1_1) to `features.28.bias` (conv5_3).
    Features are (B, 512, H // 16, W // 16).
    """

    name = "vgg16"
    channels = 512
    stride = 16

    def __init__(self, normalisation: Normalisation = TORCHVISION_RGB) -> None:
        super().__init__()
        self.normalisation = normalisation
        layers: list[nn.Module] = []
        channels = 3
        for width in LAYERS:
            if isinstance(width, str):
                layers.append(nn.MaxPool2d(2))
            else:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
                channels = width
        self.features = nn.Sequential(*layers[:-1])  # the last ReLU is left out

    def forward(self, pixels: Tensor) -> Tensor:
        """Normalised pixels (B, 3, H, W) to conv5_3 (B, 512, H // 16, W // 16)."""
        return self.features(pixels)
