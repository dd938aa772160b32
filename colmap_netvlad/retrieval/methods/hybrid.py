"""Deep features and SIFT together: candidates from both rankings, fused, with query expansion."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.fusion import expand, fuse, ranking_of
from colmap_netvlad.retrieval.methods import deep, vlad

if TYPE_CHECKING:
    from colmap_netvlad.retrieval.options import RetrievalOptions

DEEP_WEIGHT = 1.5
VLAD_WEIGHT = 1.0
"""Shares of the two rankings in choosing candidates, chosen on flights that the deep model was not
trained on (`scripts/fit_hybrid.py`, docs/training-log.md)."""

EXPANSION_NEIGHBOURS = 8
EXPANSION_SHARE = 0.3
"""Query expansion, chosen with them."""

LEAST_DEPTH = 200
"""Partners each ranking is asked for at least: what one ranking does not list cannot be fused."""

DEPTH_FACTOR = 4
"""... and at least this many times k."""


def rank(project: Project, options: RetrievalOptions) -> Ranking:
    """Rank candidates by the sum of the deep model's and VLAD's similarity, with query expansion.

    Args:
        project: its database has SIFT features, and its photo folder is known.
        options: k; `model` names another deep model than the default.

    Raises:
        InputError: no features, no photos, or no usable weights.
    """
    deeper = replace(options, k=fusion_depth(options.k))
    rankings = [deep.rank(project, options.model or DEFAULT, deeper), vlad.rank(project, deeper)]
    start = time.perf_counter()
    similarity = expand(
        fuse(rankings, [DEEP_WEIGHT, VLAD_WEIGHT]),
        EXPANSION_NEIGHBOURS,
        EXPANSION_SHARE,
        deeper.k,
    )
    fused = ranking_of(similarity, rankings[0].names, "hybrid", options.k)
    seconds = time.perf_counter() - start
    return replace(
        fused,
        seconds_describe=sum(ranking.seconds_describe for ranking in rankings),
        seconds_search=seconds + sum(ranking.seconds_search for ranking in rankings),
        notes=tuple(f"{r.method}: {note}" for r in rankings for note in r.notes),
        left_out=_left_out_of_all(rankings),
    )


def fusion_depth(k: int) -> int:
    """How deep the rankings to be fused must go for k partners."""
    return max(LEAST_DEPTH, DEPTH_FACTOR * k)


def _left_out_of_all(rankings: list[Ranking]) -> tuple[tuple[str, str], ...]:
    """Return the images no ranking could use, with the first ranking's reason."""
    unusable = set.intersection(*({name for name, _ in r.left_out} for r in rankings))
    return tuple((name, reason) for name, reason in rankings[0].left_out if name in unusable)
