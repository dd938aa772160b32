"""A glance at two photos: do the largest features of both agree on where one lies in the other?

A SIFT feature has a place, a scale and an orientation, so that a single match already says how
one photo is turned, scaled and shifted in the other. Each match is asked how many others lie
where it predicts and are turned and scaled alike. Wrong matches predict each something else; of
right ones, few among many wrong are enough. There is no single model: a facade and the street
before it may each have their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.matching.features import LARGEST, SiftFeatures
from colmap_netvlad.matching.nearest import nearest

COARSE_RATIO = 0.9
"""Ratio test of the glance, laxer than COLMAP's 0.8: wrong matches do little harm here, and weak
pairs have few right ones."""

MOST_ASKED = 256
"""Matches asked at most, those of the best ratio."""

TURN = 0.5
SCALING = 0.45
"""How far matches that agree may differ in turn (rad) and in logarithm of scaling."""

SHIFT = 60.0
STRETCH = 0.25
"""How far from its predicted place a match may lie: pixels, and share of its distance from the
match that predicts (turn and scale of a feature are inexact, and ground is not flat)."""

Matches = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the matches of a glance agree on.

    Attributes:
        matches: (M, 2) features of both photos.
        support: (M,) how many matches agree with each, itself included.
        agree: (M,) whether a match agrees with the one that most agree with.
    """

    matches: Matches
    support: NDArray[np.intp]
    agree: NDArray[np.bool_]

    @property
    def strength(self) -> int:
        """Most matches that agree with one."""
        return int(self.support.max(initial=0))


def glance(
    one: SiftFeatures, other: SiftFeatures, largest: int = LARGEST, max_ratio: float = COARSE_RATIO
) -> Consensus:
    """Match the largest features of two photos and see what agrees."""
    matches, ratio = mutual(one, other, one.largest[:largest], other.largest[:largest], max_ratio)
    return consensus(one, other, matches, ratio)


def mutual(
    one: SiftFeatures,
    other: SiftFeatures,
    of_one: NDArray[np.intp] | slice,
    of_other: NDArray[np.intp] | slice,
    max_ratio: float,
) -> tuple[Matches, NDArray[np.float32]]:
    """Return (M, 2) matches of some features that pass the ratio test both ways; (M,) the larger
    of their two ratios."""
    first, second = np.arange(len(one))[of_one], np.arange(len(other))[of_other]
    codes, other_codes = one.codes[of_one], other.codes[of_other]
    there = nearest(codes, other_codes)
    i = np.flatnonzero(there.distinct(max_ratio))
    j = there.best[i]
    back = nearest(other_codes[j], codes)
    keep = back.distinct(max_ratio) & (back.best == i)
    ratio = np.maximum(there.ratio[i], back.ratio)[keep]
    return np.stack([first[i[keep]], second[j[keep]]], axis=1), ratio


def consensus(
    one: SiftFeatures, other: SiftFeatures, matches: Matches, ratio: NDArray[np.float32]
) -> Consensus:
    """Ask the best matches how many others agree with each."""
    matches = matches[np.argsort(ratio, kind="stable")[:MOST_ASKED]]
    agreement = agreements(one, other, matches)
    support = agreement.sum(axis=1)
    agree = agreement[support.argmax()] if len(matches) else np.zeros(0, bool)
    return Consensus(matches, support, agree)


def agreements(one: SiftFeatures, other: SiftFeatures, matches: Matches) -> NDArray[np.bool_]:
    """Return (M, M) whether the match of the column lies where that of the row predicts."""
    i, j = matches.T
    turn, scaling = other.angle[j] - one.angle[i], other.log_scale[j] - one.log_scale[i]
    turns = np.abs(turn[:, None] - turn)
    turns = np.minimum(turns % (2 * np.pi), 2 * np.pi - turns % (2 * np.pi))
    alike = (turns < TURN) & (np.abs(scaling[:, None] - scaling) < SCALING)
    rows, columns = np.nonzero(alike)
    from_place, to_place = _complex(one.at[i]), _complex(other.at[j])
    similarity = np.exp(scaling + 1j * turn).astype(np.complex64)
    moved = to_place[columns] - to_place[rows]
    off = np.abs(similarity[rows] * (from_place[columns] - from_place[rows]) - moved)
    alike[rows, columns] = off < SHIFT + STRETCH * np.abs(moved)
    return alike


def _complex(at: NDArray[np.float32]) -> NDArray[np.complex64]:
    return at[:, 0] + np.complex64(1j) * at[:, 1]
