"""The two ends of the scale: all pairs, and pairs by chance."""

from __future__ import annotations

import numpy as np

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.flight import Flight
from colmap_netvlad.graph.pair import places_by_name
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError

MOST_EXHAUSTIVE = 2_000
"""Two million pairs, days of matching: above this many images nobody waits for all of them, and
their list alone would take gigabytes of memory."""


def exhaustive(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
    """Rank all other images of every image, in the database's order, whatever the depth.

    Raises:
        InputError: there are more than `MOST_EXHAUSTIVE` images.
    """
    count = len(flight.images)
    if count > MOST_EXHAUSTIVE:
        raise InputError(
            f"{count:,} images make {count * (count - 1) // 2:,} pairs, more than can be matched "
            f"in days; exhaustive serves up to {MOST_EXHAUSTIVE:,} images: take another `method`."
        )
    others = max(count - 1, 0)
    partners = np.tile(np.arange(others, dtype=np.int32), (count, 1))
    partners += partners >= np.arange(count)[:, None]
    scores = np.ones((count, others), np.float32)
    return Ranking(flight.names, partners, scores, "exhaustive", every_pair=True)


def chance(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
    """Rank `depth` partners of every image drawn without replacement: the floor.

    The draw depends on the seed and the names, not on the images' order.
    """
    names, count = flight.names, len(flight.images)
    order = np.argsort(places_by_name(names)).astype(np.int32)
    partners = np.zeros((count, depth), np.int32)
    generator = np.random.default_rng(options.seed)
    for place, i in enumerate(order):
        drawn = generator.choice(count - 1, depth, replace=False)
        partners[i] = order[drawn + (drawn >= place)]
    scores = np.tile((1 / np.arange(1, depth + 1)).astype(np.float32), (count, 1))
    return Ranking(names, partners, scores, "random")
