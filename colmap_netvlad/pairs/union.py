"""A ranking -> the set of image pairs to match."""

from __future__ import annotations

from dataclasses import dataclass

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking


@dataclass(frozen=True)
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
    best: dict[tuple[int, int], tuple[float, int]] = {}
    cut = ranking.top(k)
    for i, (row, scores) in enumerate(zip(cut.partners.tolist(), cut.scores.tolist(), strict=True)):
        for rank, (j, score) in enumerate(zip(row, scores, strict=True), start=1):
            if j == NO_PARTNER:
                break
            key = (min(i, j), max(i, j))
            old_score, old_rank = best.get(key, (score, rank))
            best[key] = (max(score, old_score), min(rank, old_rank))
    names = ranking.names
    return [ImagePair(names[i], names[j], *best[i, j]) for i, j in sorted(best)]
