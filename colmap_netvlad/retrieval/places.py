"""Two photos compared place by place: which places that look alike also lie alike?

The cells behind the descriptors are matched (mutual nearest neighbours), and the matches that agree
on one similarity transform (turn, scale, shift) are counted. Photos from above are nearly such
transforms of each other, photos of facades in part. A pair takes about a hundredth of matching its
SIFT features.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.runtime.products import operand, products

if TYPE_CHECKING:
    import torch

TOLERANCE = 1.25
"""How far from the common transform a match may lie, cells."""

TRANSFORMS = 500
"""Most transforms tried for a pair (RANSAC)."""

LENGTH = 192.0
"""Of a place's bytes, the same for all, so that products order them as cosines do. Of a hundred
places fewer than one has a value beyond 127, which is cut off."""


@dataclass(frozen=True, eq=False)
class Places:
    """Cells ready to be compared.

    Attributes:
        codes: (P, D) bytes of length `LENGTH`.
        at: (P, 2) x, y, cells.
    """

    codes: torch.Tensor
    at: NDArray[np.float32]

    @classmethod
    def of(cls, cells: Cells) -> Places:
        """Prepare cells, without places that have no texture."""
        vectors, at = cells.vectors(), cells.places()
        textured = vectors.any(axis=1)
        codes = np.rint(LENGTH * vectors[textured]).clip(-127, 127).astype(np.int8)
        return cls(operand(codes), at[textured])

    @property
    def nbytes(self) -> int:
        """Memory they take."""
        return self.codes.nbytes + self.at.nbytes


def agreeing_matches(one: Places, other: Places) -> int:
    """Return how many mutual nearest neighbours agree on one similarity transform."""
    return int(agreement(one, other)[1].sum())


def agreement(one: Places, other: Places) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return (M, 2) mutual nearest neighbours, places of both, and (M,) which of them agree on
    one similarity transform."""
    nothing = np.zeros((0, 2), np.intp), np.zeros(0, np.bool_)
    if min(len(one.at), len(other.at)) < 2:
        return nothing
    # Twice: the product costs less than to find the most alike of each column in the first.
    best = products(one.codes, other.codes).argmax(axis=1)
    back = products(other.codes, one.codes).argmax(axis=1)
    mutual = np.flatnonzero(back[best] == np.arange(len(best)))
    if len(mutual) < 2:
        return nothing
    # OpenCV seeds each call alike: the same count every time.
    _, agree = cv2.estimateAffinePartial2D(
        one.at[mutual],
        other.at[best[mutual]],
        method=cv2.RANSAC,
        ransacReprojThreshold=TOLERANCE,
        maxIters=TRANSFORMS,
        refineIters=0,
    )
    pairs = np.stack([mutual, best[mutual]], axis=1)
    return pairs, np.zeros(len(pairs), np.bool_) if agree is None else agree.ravel() > 0
