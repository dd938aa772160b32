"""Deep features and SIFT together: candidates by both rankings."""

from __future__ import annotations

from dataclasses import replace

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.flight import Flight
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.retrieval.methods import deep, vlad
from colmap_netvlad.retrieval.options import RetrievalOptions

VLAD_SHARE = 0.1
"""Of VLAD beside the deep ranking, chosen on training flights (`scripts/fit_hybrid.py`,
docs/training-log.md, section 21)."""


def candidates(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
    """Rank candidates by the deep model and by VLAD (`fusion.combine`).

    Args:
        flight: its database has SIFT features, and its photo folder is known.
        options: `model` names another deep model than the default.
        depth: partners of each image, of both rankings and of their sum.

    Raises:
        InputError: no features, no photos, or no usable weights.
    """
    local = vlad.candidates(flight, options, depth)
    beside = replace(local, notes=tuple(f"vlad: {note}" for note in local.notes))
    model = options.model or DEFAULT
    return replace(
        deep.candidates(flight, options, depth, model, [(beside, VLAD_SHARE)]), method="hybrid"
    )
