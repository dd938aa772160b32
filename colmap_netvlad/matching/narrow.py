"""All features of two photos, each looked for only where the agreed matches say it lies.

One affine transform carries a photo roughly into the other; how far the agreed matches nearby lie
from it widens and moves the window of each block of features. Windows are wide (a tenth of a photo
or more): a product of bytes costs less than to place a small window well, and the ratio
test means the same in a wide window as in the whole photo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_netvlad.matching.coarse import Consensus, Matches
from colmap_netvlad.matching.features import SiftFeatures
from colmap_netvlad.matching.nearest import Nearest, nearest

MARGIN = 0.03
"""Around a predicted window, share of the diagonal of the photo looked in."""

NEARBY = 10
"""Agreed matches near a block whose distance from the affine transform widens its window."""

SUPPORT = 4
"""Matches that must agree with one (itself included) that guides."""


Places = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Guide:
    """Where features of one photo lie in the other, roughly.

    Attributes:
        affine: (3, 2) carries (x, y, 1) into the other photo.
        at: (S, 2) guiding matches in this photo.
        offset: (S, 2) how far each lies from where `affine` carries it, pixels.
        margin: pixels around a predicted window.
    """

    affine: NDArray[np.float64]
    at: NDArray[np.float64]
    offset: NDArray[np.float64]
    margin: float

    @classmethod
    def of(cls, start: NDArray[np.float64], end: NDArray[np.float64], margin: float) -> Guide:
        """Fit the guide to (S, 2) places that lie at (S, 2) in the other photo."""
        affine = np.linalg.lstsq(_ones(start), end, rcond=None)[0].astype(float)
        return cls(affine, start, end - _ones(start) @ affine, margin)

    def near(self, centres: NDArray[np.float64]) -> tuple[Places, Places]:
        """Return (B, 2) least and most offset of the guiding matches near each centre."""
        nearby = cKDTree(self.at).query(centres, min(NEARBY, len(self.at)))[1]
        offsets = self.offset[nearby.reshape(len(centres), -1)]
        return offsets.min(axis=1), offsets.max(axis=1)


def search(
    one: SiftFeatures, other: SiftFeatures, agreed: Consensus, max_ratio: float
) -> tuple[Matches, NDArray[np.float32]]:
    """Return (M, 2) matches that pass the ratio test both ways in their windows; (M,) the larger
    of their two ratios."""
    guides = agreed.matches[agreed.support >= SUPPORT]
    start, end = one.at[guides[:, 0]].astype(float), other.at[guides[:, 1]].astype(float)
    there = _search(one, np.ones(len(one), bool), other, Guide.of(start, end, _margin(other)))
    i = np.flatnonzero(there.distinct(max_ratio))
    j = there.best[i]
    wanted = np.zeros(len(other), bool)
    wanted[j] = True
    back = _search(other, wanted, one, Guide.of(end, start, _margin(one)))
    keep = back.distinct(max_ratio)[j] & (back.best[j] == i)
    i, j = i[keep], j[keep]
    return np.stack([i, j], axis=1), np.maximum(there.ratio[i], back.ratio[j])


def _search(
    one: SiftFeatures, wanted: NDArray[np.bool_], other: SiftFeatures, guide: Guide
) -> Nearest:
    """Return the neighbours of all features of `one`, looked for where they are wanted."""
    best = np.full(len(one), -1, np.intp)
    angle, ratio = np.full((2, len(one)), np.inf, np.float32)
    carried = _ones(one.at.astype(float)) @ guide.affine
    x, y = other.at.T.copy()
    low, high = guide.near(one.centres)
    low, high = low - guide.margin, high + guide.margin
    for block, least, most in zip(one.blocks, low, high, strict=True):
        places = carried[block]
        seen = places + most >= other.corners[0]
        seen &= places + least <= other.corners[1]
        seen = seen.all(axis=1)
        block, places = (rows[seen & wanted[block]] for rows in (block, places))
        if not len(block):
            continue
        (x0, y0), (x1, y1) = places.min(axis=0) + least, places.max(axis=0) + most
        inside = np.flatnonzero((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
        if len(inside):
            found = nearest(one.codes[block], other.codes[inside])
            best[block] = inside[found.best]
            angle[block], ratio[block] = found.angle, found.ratio
    return Nearest(best, angle, ratio)


def _ones(at: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([at, np.ones(len(at))])


def _margin(features: SiftFeatures) -> float:
    return MARGIN * float(np.hypot(*np.ptp(features.corners, axis=0)))
