"""From descriptors in the store to a ranking: what every descriptor method ends with."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.search import Neighbours, Vectors, nearest


def missing(store: Store, model: str, photos: Mapping[str, str], cells: bool = False) -> list[str]:
    """Return the names in `photos` (name -> fingerprint) that the model has not described yet,
    or described from another content; with `cells`, also those without cells."""
    known = set(store.described(model).items())
    if cells:
        known &= set(store.described_in_cells(model).items())
    return [name for name, photo in photos.items() if (name, photo) not in known]


def cache_note(computed: int, total: int) -> str:
    """Return the report's sentence on what was computed and what the cache had."""
    if computed == total:
        return f"{computed} of {total} descriptors computed"
    return (
        f"{computed} of {total} descriptors computed; the seconds of the others are those of the "
        "run that computed them"
    )


def rank_described(
    store: Store,
    model: str,
    names: Sequence[str],
    left_out: Mapping[str, str],
    options: RetrievalOptions,
    depth: int,
    method: str,
    notes: Sequence[str] = (),
) -> Ranking:
    """Search the neighbours of all images described in the store; see `rank_vectors`.

    Args:
        store: holds the descriptors of every name that is not in `left_out`.
        model: what they are kept under.

    Returns:
        A ranking whose `seconds_describe` is what all its descriptors took when they were
        computed, whether now or in an earlier run.
    """
    described = [name for name in names if name not in left_out]
    vectors = store.vectors(model, described)
    ranking = rank_vectors(vectors, names, left_out, options, depth, method)
    seconds = store.seconds(model, described)
    return replace(ranking, seconds_describe=seconds, notes=tuple(notes))


def rank_vectors(
    vectors: Vectors | NDArray[np.floating],
    names: Sequence[str],
    left_out: Mapping[str, str],
    options: RetrievalOptions,
    depth: int,
    method: str,
) -> Ranking:
    """Search the neighbours of all described images and rank them.

    Args:
        vectors: (N, D) L2-normalised descriptors of the names that are not in `left_out`.
        names: all image names of the project.
        left_out: name -> reason; these have no partners and are nobody's partner.
        options: exact, seed.
        depth: partners of each image.
        method: name for the ranking.
    """
    start = time.perf_counter()
    found = nearest(vectors, depth, options.exact, options.seed)
    ranking = rank_found(found, names, left_out, method)
    return replace(ranking, seconds_search=time.perf_counter() - start)


def rank_found(
    found: Neighbours, names: Sequence[str], left_out: Mapping[str, str], method: str
) -> Ranking:
    """Return what was found for each described image as a ranking of all; see `rank_vectors`.

    Args:
        found: partners and scores of the names that are not in `left_out`, by their places
            among these.
    """
    rows = np.array([i for i, name in enumerate(names) if name not in left_out], np.int32)
    nearest_of_each, scores_of_each = found
    partners = np.full((len(names), nearest_of_each.shape[1]), NO_PARTNER, np.int32)
    scores = np.full(partners.shape, -np.inf, np.float32)
    partners[rows] = rows[nearest_of_each]
    scores[rows] = scores_of_each
    return Ranking(tuple(names), partners, scores, method, left_out=tuple(left_out.items()))
