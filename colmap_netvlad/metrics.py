"""How good a retrieval is: accuracy, recall, average precision, efficiency (section 4.1.2)."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.graph.verified import correct_pairs


def accuracy(pairs: Iterable[tuple[str, str]], verified: Mapping[Pair, int]) -> float:
    """Return eq. 19, N(MP) / N(RP): the share of the retrieved pairs that is correct, 0..1.

    Args:
        pairs: the retrieved pairs RP, in either order; a pair given twice counts once.
        verified: verified matches by pair; a pair that is not in it has none.

    Returns:
        NaN where nothing was retrieved.
    """
    retrieved = {as_pair(*pair) for pair in pairs}
    return _share(len(retrieved & correct_pairs(verified)), len(retrieved))


def recall(pairs: Iterable[tuple[str, str]], truth: Collection[tuple[str, str]]) -> float:
    """Return the share of the true pairs that was retrieved, 0..1 (NaN where there is no truth).

    Args:
        pairs: the retrieved pairs, in either order.
        truth: the correct pairs of the scene (`correct_pairs` of an exhaustive matching).
    """
    retrieved = {as_pair(*pair) for pair in pairs}
    wanted = {as_pair(*pair) for pair in truth}
    return _share(len(retrieved & wanted), len(wanted))


def average_precisions(
    ranking: Ranking, truth: Collection[tuple[str, str]], depth: int | None = None
) -> dict[str, float]:
    """Return the average precision (0..1) of every image that has a true partner.

    AP is the mean, over the true partners of an image, of the precision of its list down to that
    partner; a true partner that is not in the list gives 0. Among K partners an image can show K
    at most, so the mean is over min(true partners, K): a full ranking has the textbook's value, a
    cut one the usual AP at K.

    Args:
        ranking: its lists may be shorter than K, as where photos have no position.
        truth: the correct pairs, in either order.
        depth: K, the partners asked for; None: as many as the ranking is wide.
    """
    depth = ranking.depth if depth is None else depth
    partners_of: dict[str, set[str]] = defaultdict(set)
    for name1, name2 in truth:
        partners_of[name1].add(name2)
        partners_of[name2].add(name1)
    index = {name: i for i, name in enumerate(ranking.names)}
    precisions = {}
    for name, partners in partners_of.items():
        if name not in index:
            continue
        wanted = np.array([index[p] for p in partners if p in index], dtype=np.int64)
        listed = ranking.partners[index[name], :depth]
        hits = np.isin(listed[listed != NO_PARTNER], wanted)
        possible = min(len(partners), depth)
        precision = np.cumsum(hits) / np.arange(1, hits.size + 1)
        precisions[name] = float(precision[hits].sum() / possible) if possible else 0.0
    return precisions


def mean_average_precision(
    ranking: Ranking, truth: Collection[tuple[str, str]], depth: int | None = None
) -> float:
    """Return the mean of `average_precisions`, 0..1; NaN where no image has a true partner."""
    precisions = average_precisions(ranking, truth, depth)
    return math.fsum(precisions.values()) / len(precisions) if precisions else math.nan


def efficiency(ranking: Ranking) -> float:
    """Return eq. 20, T_fe + T_nns: the seconds of describing and of searching together."""
    return ranking.seconds_describe + ranking.seconds_search


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan
