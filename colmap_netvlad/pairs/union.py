"""A ranking -> the set of image pairs to match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking


@dataclass(frozen=True, slots=True)
class ImagePair:
    """Two images that are to be matched.

    Attributes:
        name1, name2: image names; `name1` comes first in the database's order.
        score: the higher of the two scores that the images give each other.
        rank: the better (lower) of the two ranks, from 1.
    """

    name1: str
    name2: str
    score: float
    rank: int


def union_of_top(ranking: Ranking, k: int) -> list[ImagePair]:
    """Return the union of every image's own `k` best partners.

    Each pair once, no self pairs, in the database's order of its images. Taking every image's
    own list before removing duplicates keeps images late in the database from being starved.
    """
    cut, names = ranking.top(k), ranking.names
    image, place = np.nonzero(cut.partners != NO_PARTNER)
    partner = cut.partners[image, place].astype(np.int64)
    key = np.minimum(image, partner) * len(names) + np.maximum(image, partner)
    pairs, which = np.unique(key, return_inverse=True)
    score = np.full(len(pairs), -np.inf, np.float32)
    np.maximum.at(score, which, cut.scores[image, place])
    rank = np.full(len(pairs), ranking.depth, np.int64)
    np.minimum.at(rank, which, place + 1)
    first, second = (pairs // len(names)).tolist(), (pairs % len(names)).tolist()
    rows = zip(first, second, score.tolist(), rank.tolist(), strict=True)
    return [ImagePair(names[i], names[j], high, low) for i, j, high, low in rows]
