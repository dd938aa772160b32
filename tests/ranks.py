"""Rankings as tests want them: of a project, cut to k."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project


def rank(project: Project, name: str | Path, options: RetrievalOptions | None = None) -> Ranking:
    """Rank, cut to the k asked for."""
    options = options or RetrievalOptions()
    return rank_project(project, name, options).top(options.k)


def from_lists(
    names: tuple[str, ...],
    lists: list[list[tuple[int, float]]],
    method: str,
    **times_and_notes: object,
) -> Ranking:
    """Build a ranking from ragged lists of (partner index, score), best first."""
    depth = max((len(row) for row in lists), default=0)
    partners = np.full((len(names), depth), NO_PARTNER, dtype=np.int32)
    scores = np.full((len(names), depth), -np.inf, dtype=np.float32)
    for i, row in enumerate(lists):
        for rank, (partner, score) in enumerate(row):
            partners[i, rank] = partner
            scores[i, rank] = score
    return Ranking(names, partners, scores, method, **times_and_notes)  # type: ignore[arg-type]
