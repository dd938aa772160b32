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
from scipy.spatial import cKDTree

from colmap_netvlad.matching.features import SiftFeatures
from colmap_netvlad.matching.nearest import MAX_RATIO, nearest

COARSE_RATIO = 0.9
"""Ratio test of the glance, laxer than COLMAP's 0.8: wrong matches do little harm here, and weak
pairs have few right ones."""

SURENESS_FALL = 0.12
SURENESS_RANGE = (0.1, 2.0)
"""What a match counts for: 1 at COLMAP's ratio of 0.8, less by 1 for each `SURENESS_FALL`, within
the range. Wrong matches crowd just below the ratio asked for. Over the pairs of five scenes
that a glance at 4,096 features leaves in doubt, keeping all true ones keeps 279 false ones by
this, 321 where all count alike (of 549)."""

MOST_ASKED = 256
"""Matches asked at most, those of the best ratio."""

TURN = 0.5
SCALING = 0.45
"""How far matches that agree may differ in turn (rad) and in logarithm of scaling."""

SHIFT = 60.0
STRETCH = 0.25
"""How far from its predicted place a match may lie: pixels, and share of its distance from the
match that predicts (turn and scale of a feature are inexact, and ground is not flat). Half as
wide keeps more false pairs with the same true ones."""

NEIGHBOURS = 8
"""Matches nearest to one of which one should lie where it predicts."""

Matches = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the matches of a glance agree on.

    Attributes:
        matches: (M, 2) features of both photos.
        support: (M,) how many matches agree with each, itself included.
        strength: see `strength`; 0 where there is no match.
    """

    matches: Matches
    support: NDArray[np.intp]
    strength: float


def glance(one: SiftFeatures, other: SiftFeatures, largest: tuple[int, int]) -> Consensus:
    """Match the largest features of two photos, so many of each, and see what agrees."""
    first, second = one.largest[: largest[0]], other.largest[: largest[1]]
    matches, ratio = mutual(one, other, first, second, COARSE_RATIO)
    best = np.argsort(ratio, kind="stable")[:MOST_ASKED]
    matches, ratio = matches[best], ratio[best]
    agreement = agreements(one, other, matches)
    return Consensus(matches, agreement.sum(axis=1), strength(agreement, ratio))


def strength(agreement: NDArray[np.bool_], ratio: NDArray[np.float32]) -> float:
    """Return the most that the matches which agree with one count for, itself included.

    Args:
        agreement: (M, M) which matches agree.
        ratio: (M,) of the angles to their nearest and second nearest descriptors.
    """
    sureness = 1 + (MAX_RATIO - ratio.astype(float)) / SURENESS_FALL
    most = (agreement @ np.clip(sureness, *SURENESS_RANGE)).max(initial=0)
    return round(float(most), 6)


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


def distinct(one: SiftFeatures, other: SiftFeatures, matches: Matches) -> NDArray[np.bool_]:
    """Return (M,) whether matches pass COLMAP's ratio test both ways among all features."""
    i, j = matches.T
    there = nearest(one.codes[i], other.codes)
    keep = there.distinct(MAX_RATIO) & (there.best == j)
    back = nearest(other.codes[j[keep]], one.codes)
    keep[keep] = back.distinct(MAX_RATIO) & (back.best == i[keep])
    return keep


def agreements(one: SiftFeatures, other: SiftFeatures, matches: Matches) -> NDArray[np.bool_]:
    """Return (M, M) whether two matches each lie where the other predicts; of itself, True."""
    i, j = matches.T
    turn, scaling = other.angle[j] - one.angle[i], other.log_scale[j] - one.log_scale[i]
    turns = np.abs(turn[:, None] - turn)
    turns = np.minimum(turns % (2 * np.pi), 2 * np.pi - turns % (2 * np.pi))
    alike = (turns < TURN) & (np.abs(scaling[:, None] - scaling) < SCALING)
    rows, columns = np.nonzero(alike)
    alike[rows, columns] = _predicted(one, other, matches, rows, columns)
    return alike & alike.T


def neighbours_agree(one: SiftFeatures, other: SiftFeatures, matches: Matches) -> NDArray[np.bool_]:
    """Return (M,) whether one of the nearest matches lies where a match predicts."""
    at = one.at[matches[:, 0]]
    nearest_matches = cKDTree(at).query(at, min(NEIGHBOURS + 1, len(at)))[1][:, 1:]
    rows = np.repeat(np.arange(len(at)), nearest_matches.shape[1])
    columns = nearest_matches.ravel()
    predicted = _predicted(one, other, matches, rows, columns) & (rows != columns)
    return predicted.reshape(nearest_matches.shape).any(axis=1)


def _predicted(
    one: SiftFeatures,
    other: SiftFeatures,
    matches: Matches,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """Return whether the matches `columns` lie where the matches `rows` predict."""
    i, j = matches.T
    turn, scaling = other.angle[j] - one.angle[i], other.log_scale[j] - one.log_scale[i]
    similarity = np.exp(scaling + 1j * turn).astype(np.complex64)
    from_place, to_place = _complex(one.at[i]), _complex(other.at[j])
    moved = to_place[columns] - to_place[rows]
    off = np.abs(similarity[rows] * (from_place[columns] - from_place[rows]) - moved)
    near: NDArray[np.bool_] = np.less(off, SHIFT + STRETCH * np.abs(moved))
    return near


def _complex(at: NDArray[np.float32]) -> NDArray[np.complex64]:
    return at[:, 0] + np.complex64(1j) * at[:, 1]
