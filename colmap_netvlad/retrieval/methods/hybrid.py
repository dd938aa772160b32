"""Deep features and SIFT together: candidates from both rankings, fused, with query expansion."""

from __future__ import annotations

import time
from dataclasses import replace

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.flight import Flight
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.retrieval.fusion import expand, fuse, ranking_of
from colmap_netvlad.retrieval.methods import deep, vlad
from colmap_netvlad.retrieval.options import RetrievalOptions

DEEP_WEIGHT = 1.5
VLAD_WEIGHT = 1.0
"""Shares of the two rankings in choosing candidates, chosen on flights that the deep model was not
trained on (`scripts/fit_hybrid.py`, docs/training-log.md)."""

EXPANSION_NEIGHBOURS = 8
EXPANSION_SHARE = 0.3
"""Query expansion, chosen with them."""


def candidates(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
    """Rank candidates by the sum of the deep model's and VLAD's similarity, with query expansion.

    Args:
        flight: its database has SIFT features, and its photo folder is known.
        options: `model` names another deep model than the default.
        depth: partners of each image, of both rankings and of their sum.

    Raises:
        InputError: no features, no photos, or no usable weights.
    """
    rankings = [
        deep.candidates(flight, options, depth, options.model or DEFAULT),
        vlad.candidates(flight, options, depth),
    ]
    start = time.perf_counter()
    similarity = expand(
        fuse(rankings, [DEEP_WEIGHT, VLAD_WEIGHT]), EXPANSION_NEIGHBOURS, EXPANSION_SHARE, depth
    )
    fused = ranking_of(similarity, flight.names, "hybrid", depth)
    seconds = time.perf_counter() - start
    return replace(
        fused,
        seconds_describe=sum(ranking.seconds_describe for ranking in rankings),
        seconds_search=seconds + sum(ranking.seconds_search for ranking in rankings),
        notes=tuple(f"{r.method}: {note}" for r in rankings for note in r.notes),
        left_out=_left_out_of_all(rankings),
    )


def _left_out_of_all(rankings: list[Ranking]) -> tuple[tuple[str, str], ...]:
    """Return the images no ranking could use, with the first ranking's reason."""
    unusable = set.intersection(*({name for name, _ in r.left_out} for r in rankings))
    return tuple((name, reason) for name, reason in rankings[0].left_out if name in unusable)
