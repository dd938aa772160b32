"""The two ends of the scale: all pairs, and pairs by chance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError

if TYPE_CHECKING:
    from colmap_netvlad.retrieval.options import RetrievalOptions

MOST_EXHAUSTIVE = 10_000
"""Above this many images all pairs (50 million) are beyond any matching."""


def exhaustive(project: Project, options: RetrievalOptions) -> Ranking:
    """Rank all other images of every image, in the database's order; `options.k` is ignored.

    Raises:
        InputError: there are more than `MOST_EXHAUSTIVE` images.
    """
    names = image_names(project.database)
    count = len(names)
    if count > MOST_EXHAUSTIVE:
        raise InputError(
            f"{count} images make {count * (count - 1) // 2:,} pairs; exhaustive serves up to "
            f"{MOST_EXHAUSTIVE:,} images."
        )
    depth = max(count - 1, 0)
    partners = np.tile(np.arange(depth, dtype=np.int32), (count, 1))
    partners += partners >= np.arange(count)[:, None]
    return Ranking(names, partners, np.ones((count, depth), np.float32), "exhaustive")


def chance(project: Project, options: RetrievalOptions) -> Ranking:
    """Rank `options.k` partners of every image drawn without replacement: the floor.

    The draw depends on the seed and the names, not on the images' order.
    """
    names = image_names(project.database)
    count = len(names)
    k = min(options.k, count - 1)
    order = np.array(sorted(range(count), key=names.__getitem__), np.int32)
    partners = np.zeros((count, k), np.int32)
    generator = np.random.default_rng(options.seed)
    for place, i in enumerate(order):
        drawn = generator.choice(count - 1, k, replace=False)
        partners[i] = order[drawn + (drawn >= place)]
    scores = np.tile((1 / np.arange(1, k + 1)).astype(np.float32), (count, 1))
    return Ranking(names, partners, scores, "random")
