"""Two photos' SIFT features matched by stages, each as dear as the one before leaves doubt."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.matching import narrow
from colmap_netvlad.matching.coarse import Matches, agreements, glance, mutual
from colmap_netvlad.matching.features import SiftFeatures
from colmap_netvlad.matching.nearest import MAX_RATIO

LEAST = 5
"""Agreeing matches of the glance below which a pair is given up."""

SECOND_LARGEST = 4096
WORTH_A_SECOND = 5500
SECOND_LEAST = 6
"""A second glance at twice as many features, before photos with many
features are searched in full; below `SECOND_LEAST` agreeing matches the pair is given up."""

SURE = 20
"""Agreeing matches of the glance from which on the search is narrowed."""

AGREED_RATIO = 0.85
"""Ratio test of a full search for a match that another agrees with."""

MOST_FILTERED = 400
"""Matches of a full search up to which those without any that agrees are dropped."""


class Stage(Enum):
    """Where a pair's matching ended."""

    GIVEN_UP = "given up"
    FULL = "full"
    NARROW = "narrow"


@dataclass(frozen=True, eq=False)
class Matched:
    """Matches of a pair.

    Attributes:
        matches: (M, 2) features of the first and the second photo, sorted, none used twice.
        stage: where matching ended.
    """

    matches: NDArray[np.uint32]
    stage: Stage


def match(one: SiftFeatures, other: SiftFeatures, thorough: bool = False) -> Matched:
    """Match two photos' features; the order of the photos does not matter.

    Args:
        one, other: the photos' features.
        thorough: search a pair in full that would be given up.
    """
    if (len(one), one.checksum) > (len(other), other.checksum):
        turned = match(other, one, thorough)
        return Matched(_sorted(turned.matches[:, ::-1]), turned.stage)
    agreed = glance(one, other)
    if agreed.strength >= SURE:
        return Matched(_sorted(narrow.search(one, other, agreed)), Stage.NARROW)
    doubtful = agreed.strength >= LEAST
    if doubtful and min(len(one), len(other)) >= WORTH_A_SECOND:
        again = glance(one, other, SECOND_LARGEST, AGREED_RATIO)
        if again.strength >= SURE:
            return Matched(_sorted(narrow.search(one, other, again)), Stage.NARROW)
        doubtful = again.strength >= SECOND_LEAST
    if doubtful or thorough:
        return Matched(_sorted(_full(one, other)), Stage.FULL)
    return Matched(np.zeros((0, 2), np.uint32), Stage.GIVEN_UP)


def _full(one: SiftFeatures, other: SiftFeatures) -> Matches:
    """Search all features in all; where that leaves doubt, keep what agrees with a sure match."""
    everything = slice(None)
    matches, ratio = mutual(one, other, everything, everything, AGREED_RATIO)
    sure = ratio < MAX_RATIO
    if len(matches) > MOST_FILTERED:
        return matches[sure]
    agree = agreements(one, other, matches)
    agree &= agree.T
    np.fill_diagonal(agree, False)
    return matches[agree[:, sure].any(axis=1)]


def _sorted(matches: NDArray[np.integer]) -> NDArray[np.uint32]:
    return matches[np.argsort(matches[:, 0])].astype(np.uint32)
