"""Position priors: the nearest photos on the ground, as COLMAP's spatial matching ranks them.

Heights are ignored (COLMAP's default), so that flights at different heights still pair.
"""

from __future__ import annotations

import time

import numpy as np

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.flight import Flight
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError


def candidates(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
    """Rank by distance on the ground; images without a position have no partners.

    Scores are negative distances, in metres for GPS, else in the priors' unit.

    Raises:
        InputError: positions do not tell images apart: none, one, or all equal.
    """
    from scipy.spatial import cKDTree

    start = time.perf_counter()
    names, positions = flight.names, flight.positions
    seconds_describe = time.perf_counter() - start
    known = np.flatnonzero(positions.known).astype(np.int32)
    if not positions.useful:
        raise InputError(
            f"{len(known)} of {len(names)} images have a usable position (from "
            f"{flight.project.database} and the photos' EXIF); use one that goes by appearance."
        )
    start = time.perf_counter()
    k = min(depth, len(known) - 1)
    ground = positions.metres[known, :2]
    distances, found = cKDTree(ground).query(ground, k=k + 1)
    partners = np.full((len(names), k), NO_PARTNER, np.int32)
    scores = np.full((len(names), k), -np.inf, np.float32)
    for i, (row, row_distances) in enumerate(zip(found, distances, strict=True)):
        keep = np.flatnonzero(row != i)[:k]
        partners[known[i]] = known[row[keep]]
        scores[known[i]] = -row_distances[keep]
    return Ranking(
        names,
        partners,
        scores,
        "spatial",
        seconds_describe=seconds_describe,
        seconds_search=time.perf_counter() - start,
        notes=positions.notes,
        left_out=tuple(
            (names[i], "has no position") for i in np.flatnonzero(~positions.known).tolist()
        ),
    )
