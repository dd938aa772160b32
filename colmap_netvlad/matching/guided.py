"""Two photos' SIFT features matched by stages, each as dear as the one before leaves doubt."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.matching import narrow
from colmap_netvlad.matching.coarse import (
    Consensus,
    Matches,
    agreements,
    distinct,
    glance,
    mutual,
    neighbours_agree,
    strength,
)
from colmap_netvlad.matching.features import SiftFeatures
from colmap_netvlad.matching.nearest import MAX_RATIO

LARGEST = 2048
"""Features of the first glance: those of the largest scales, which the other photo shows too
where heights are alike."""

FEWER, PLAIN = 1024, 24.0
"""Fewer features that are looked at before, and the strength from which on they are enough. They
cost a quarter, and are enough for most pairs that overlap; these have the same inliers then."""

LEAST = 1.6
"""Strength of the first glance below which a pair is given up: barely more than one sure match.
The weakest pair that COLMAP verifies has 1.7 (yongzhou_river). Of the pairs it does not verify, two
in five have less on farmland, none on facades."""

MANY = 5500
SECOND_LEAST = 4.5
"""Where both photos have more features than `MANY`, a glance at half of all precedes the full
search, at a quarter of its cost. With less strength then, the pair is given up: the weakest that
COLMAP verifies has 6.0 (yongzhou_river); of the others there and on farmland some nine in ten
have less than 5, with those that the first glance gave up."""

SURE = 12.0
"""Strength from which on the search is narrowed. From 8 to 11 that lost 3 of 38 pairs that COLMAP
verifies, from 11 on 2 of 151, both of 16 or 17 inliers and as weak in a full search."""

CLEAR = 0.65
"""Ratio within a window below which a match is taken; from there up to COLMAP's 0.8 it must also
pass among all features of both photos. A window holds about a tenth of them, so that its second
best is further away: three quarters of the matches that it adds to COLMAP's are such as COLMAP's
test refuses. They lie further from their epipolar lines (0.65 px in the median beside 0.54 on
toledo_tests, 0.30 beside 0.17 on corpus_christi) and made the model's error a tenth larger. Of
those below 0.65 it would drop 1 % over land, 8 % on a facade."""

FEW = 30
AGREED_RATIO = 0.82
"""Matches that pass up to which others are added: those of a window that pass in it alone, and of
up to `AGREED_RATIO` those that agree with one of them. Without any, 1 to 5 of a hundred pairs that
COLMAP verifies (on seven scenes) fall short of its 16 inliers, all but two of 16 to 19; without
the less sure ones 0 to 1, with them none but one wrong pair on a facade (with 60 for 30, which
verifies the same pairs of corpus_christi). With 0.84, half as many
pairs again are verified that COLMAP does not verify, on facades all of them wrong."""

LAST_LEAST = 8.0
"""Strength of all matches found below which none is worth verifying: the weakest pair that COLMAP
verifies has 10.7 (corpus_christi, with a ratio of 0.85); half to three quarters of the others that
are searched in full have less than 8, on facades hardly one."""

LONELY_FROM, LONELY_TO = 60, 400
"""Numbers of matches from and up to which those are dropped that no neighbour agrees with. Among
so many, they cost the robust estimation more than all else (on a courtyard's facades, at 40 %
inliers, 204 ms a pair with them, 54 without). Fewer may need every one; of more, few are wrong."""


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
    agreed = glance(one, other, (FEWER, FEWER))
    if agreed.strength < PLAIN:
        agreed = glance(one, other, (LARGEST, LARGEST))
    hope = agreed.strength >= LEAST
    if hope and agreed.strength < SURE and len(one) > MANY:
        agreed = glance(one, other, (len(one) // 2, len(other) // 2))
        hope = agreed.strength >= SECOND_LEAST
    if not (hope or thorough):
        return Matched(np.zeros((0, 2), np.uint32), Stage.GIVEN_UP)
    stage = Stage.NARROW if agreed.strength >= SURE else Stage.FULL
    return Matched(_sorted(_search(one, other, agreed, stage)), stage)


def _search(one: SiftFeatures, other: SiftFeatures, agreed: Consensus, stage: Stage) -> Matches:
    """Return (M, 2) the matches that COLMAP's ratio test leaves; where they are few, also less
    sure ones that agree with any of them, or none at all if hardly any agree."""
    if stage is Stage.NARROW:
        matches, ratio = narrow.search(one, other, agreed, AGREED_RATIO)
    else:
        matches, ratio = mutual(one, other, slice(None), slice(None), AGREED_RATIO)
    passing = ratio < MAX_RATIO
    keep = passing.copy()
    if stage is Stage.NARROW:
        doubtful = passing & (ratio >= CLEAR)
        keep[doubtful] = distinct(one, other, matches[doubtful])
    if keep.sum() <= FEW:
        agreement = agreements(one, other, matches)
        if strength(agreement, ratio) < LAST_LEAST:
            return matches[:0]
        keep = passing | agreement[:, passing].any(axis=1)
    matches = matches[keep]
    if LONELY_FROM <= len(matches) <= LONELY_TO:
        matches = matches[neighbours_agree(one, other, matches)]
    return matches


def _sorted(matches: NDArray[np.integer]) -> NDArray[np.uint32]:
    return matches[np.argsort(matches[:, 0])].astype(np.uint32)
