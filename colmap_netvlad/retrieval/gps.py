"""Positions re-weight a ranking's candidates: near photos first, nobody excluded.

A position says where the camera was, not what it saw, and some are wrong; so nearness is added
to what the photos look like and never replaces it. Heights are ignored: flights at different
heights still pair.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.photos.positions import Positions
from colmap_netvlad.retrieval.fusion import ranking_of, similarity_matrix

NEUTRAL = 0.5
"""Nearness of a pair of which a position is unknown: it neither gains nor loses."""

REACH = 2.0
"""A pair's nearness is one half-width at this many times the distance to the k-th neighbour."""


SPACING_NEIGHBOURS = 10
"""The neighbour whose distance measures how dense the flight is around a photo."""

WEIGHT = 4.0
"""Weight of nearness beside a ranking's similarity, chosen on the training flights
(`scripts/fit_hybrid.py`)."""


def near_first(ranking: Ranking, positions: Positions) -> Ranking:
    """Return a ranking with nearness added, as deep as it was.

    Photos without a position are ranked by appearance as before; where no positions are useful
    the ranking stays as it is. The positions' notes join the ranking's.
    """
    if not positions.useful:
        return replace(ranking, notes=(*ranking.notes, *positions.notes))
    start = time.perf_counter()
    positions = _without(positions, ranking)
    similarity = add_nearness(similarity_matrix(ranking), positions, SPACING_NEIGHBOURS, WEIGHT)
    nearer = ranking_of(similarity, ranking.names, ranking.method, ranking.depth)
    used = f"positions of {int(positions.known.sum())} of {len(ranking.names)} photos used"
    return replace(
        ranking,
        partners=nearer.partners,
        scores=nearer.scores,
        seconds_search=ranking.seconds_search + time.perf_counter() - start,
        notes=(*ranking.notes, used, *positions.notes),
    )


def _without(positions: Positions, ranking: Ranking) -> Positions:
    """Forget the positions of images left out, so that nearness gives them no partners."""
    left_out = {name for name, _ in ranking.left_out}
    metres = positions.metres.copy()
    metres[[name in left_out for name in ranking.names]] = np.nan
    return replace(positions, metres=metres)


def add_nearness(
    similarity: sparse.csr_array, positions: Positions, k: int, weight: float
) -> sparse.csr_array:
    """Return the similarity plus `weight` times the nearness of each pair, 0..1.

    Nearness is exp(-d^2 / 2 s^2): d is the horizontal distance and s is `REACH` times the
    geometric mean of the two photos' distances to their k-th nearest photo, so that dense and
    sparse parts of a flight, and a fast and a slow flight, are each measured by their own
    spacing. Each photo's k nearest on the ground become candidates too.

    Args:
        similarity: (N, N) symmetric sparse similarity.
        positions: of the same N photos.
    """
    nearest, spacing = _ground_neighbours(positions, k)
    candidates = (similarity + nearest).tocoo()
    a, b = candidates.row, candidates.col
    other = a != b
    a, b = a[other], b[other]
    ground = positions.metres[:, :2]
    distance = np.linalg.norm(ground[a] - ground[b], axis=1)
    width = REACH * np.maximum(np.sqrt(spacing[a] * spacing[b]), 1e-6)
    nearness = np.where(np.isfinite(distance), np.exp(-0.5 * (distance / width) ** 2), NEUTRAL)
    value = np.asarray(similarity[a, b]).ravel() + weight * nearness
    return sparse.csr_array((value, (a, b)), shape=similarity.shape)


def _ground_neighbours(
    positions: Positions, k: int
) -> tuple[sparse.csr_array, NDArray[np.float64]]:
    """Return a symmetric pattern of each photo's k nearest, and (N,) distances to the k-th, m."""
    n = len(positions.metres)
    spacing = np.full(n, np.nan)
    known = np.flatnonzero(positions.known)
    count = min(k, len(known) - 1)
    if count < 1:
        return sparse.csr_array((n, n)), spacing
    ground = positions.metres[known, :2]
    distances, found = cKDTree(ground).query(ground, k=count + 1)
    spacing[known] = distances[:, -1]
    rows = np.repeat(known, count + 1)
    columns = known[found.ravel()]
    # The pattern is what counts: a value too small to change any order.
    tiny = np.full(len(rows), 1e-12)
    pattern = sparse.csr_array((tiny, (rows, columns)), shape=(n, n))
    return (pattern + pattern.T).tocsr(), spacing
