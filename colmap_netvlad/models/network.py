"""A trunk, an aggregation and, where wanted, a whitening: pixels to one global descriptor.

Beside it what each place of a photo looks like, along few axes where the network has some.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from colmap_netvlad.models.aggregation import Aggregation
from colmap_netvlad.models.trunk import Trunk
from colmap_netvlad.models.whitening import Whitening


class GlobalDescriptor(nn.Module):
    """The network that is trained and run.

    Attributes:
        trunk: pixels to local features.
        aggregation: local features to one vector.
        whitening: that vector to a shorter one, or None.
        axes: (A, C), orthonormal principal axes of the local features, along which cells are
            kept (`at_places`); None keeps all C values.
        dim: D, length of the descriptor.
    """

    axes: Tensor | None

    def __init__(
        self,
        trunk: Trunk,
        aggregation: Aggregation,
        whitening: Whitening | None = None,
        axes: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.register_buffer("axes", axes)
        self.trunk = trunk
        self.aggregation = aggregation
        self.whitening = whitening
        self.dim = aggregation.dim if whitening is None else whitening.dim

    def features(self, pixels: Tensor) -> Tensor:
        """RGB pixels of 0..255, float (B, 3, H, W), to the trunk's features (B, C, h, w)."""
        height, width = pixels.shape[-2:]
        if min(height, width) < self.trunk.stride:
            # Too small for a single feature: enlarged, so that any photo has a descriptor.
            size = (max(height, self.trunk.stride), max(width, self.trunk.stride))
            pixels = functional.interpolate(pixels, size)
        return self.trunk(self.trunk.normalisation(pixels))

    def forward(self, pixels: Tensor) -> Tensor:
        """RGB pixels of 0..255, float (B, 3, H, W), to descriptors (B, D), L2-normalised."""
        return self.with_local(pixels)[0]

    def with_local(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """RGB pixels as for `forward` to descriptors (B, D) and local features (B, C, h, w).

        Both are L2-normalised.
        """
        features = self.features(pixels)
        descriptors, local = self.aggregation.with_local(features)
        if self.whitening is not None:
            descriptors = self.whitening(descriptors)
        return descriptors, local.unflatten(2, features.shape[2:])

    def at_places(self, local: Tensor) -> Tensor:
        """Local features (B, C, h, w) to what is compared place by place (B, A, h, w).

        L2-normalised; the same for features of any length.
        """
        if self.axes is not None:
            local = torch.einsum("ac,bchw->bahw", self.axes.float(), local)
        return functional.normalize(local, dim=1)
