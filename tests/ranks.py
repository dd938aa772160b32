"""Rankings as tests want them: of a project, cut to k."""

from __future__ import annotations

from pathlib import Path

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project


def rank(project: Project, name: str | Path, options: RetrievalOptions | None = None) -> Ranking:
    """Rank, cut to the k asked for."""
    options = options or RetrievalOptions()
    return rank_project(project, name, options).top(options.k)
