"""What a network saw at each place of a photo, cell by cell, kept small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.codes import decode, encode


@dataclass(frozen=True, eq=False)
class Cells:
    """One feature of a network for each cell of a grid over a photo.

    Attributes:
        codes: (h, w, D) int8, each feature stretched to -127..127; zeros where the photo has no
            texture. A cell is the network's stride, so that distances in cells mean the same in
            all photos of a project.
    """

    codes: NDArray[np.int8]

    @classmethod
    def of(cls, features: NDArray[np.floating]) -> Cells:
        """Encode features (D, h, w) of any length."""
        return cls(encode(np.ascontiguousarray(features.transpose(1, 2, 0))))

    def vectors(self) -> NDArray[np.float32]:
        """Return (h w, D) features, L2-normalised; zero where there is no texture."""
        return decode(self.codes.reshape(-1, self.codes.shape[2]))

    def places(self) -> NDArray[np.float32]:
        """Return (h w, 2) x, y of each feature, in cells."""
        height, width = self.codes.shape[:2]
        y, x = np.divmod(np.arange(height * width), width)
        return np.stack([x, y], axis=1).astype(np.float32)
