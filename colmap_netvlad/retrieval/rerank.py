"""Compare candidates place by place, and order them by what agrees.

A global descriptor says that two photos show the same kind of ground. That they show the same
piece of it is known when places that look alike also lie alike (`retrieval.places`). Where few
places agree, the largest SIFT features are asked as well, if there are any (`retrieval.confirm`).

The counts spread by query expansion: the sure neighbours of my sure neighbours are likely mine.
So they choose what is compared next (`retrieval.asking`), and whether anything is: most of a long
list of candidates teaches nothing.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.asking import Asking
from colmap_netvlad.retrieval.confirm import (
    LARGEST_FEATURES,
    Largest,
    LargestFeatures,
    agreeing_features,
)
from colmap_netvlad.retrieval.counts import Counts, Known, Pairs
from colmap_netvlad.retrieval.fusion import TAIL, expand, ranking_of
from colmap_netvlad.retrieval.options import COMPARED
from colmap_netvlad.retrieval.places import Places, agreeing_matches
from colmap_netvlad.runtime.progress import step

CHANCE = 10
"""Places that agree in photos of different ground as well: the median of six flights is 8 to 10
where the overlap is small. They count as nothing."""

SURE = 20
"""More agreeing places than this make a sure partner."""

FEATURES_BY_CHANCE = 2
SURE_FEATURES = 7
"""The same of features, where each match agrees with itself."""

FEATURE_WEIGHT = 10.0
PLACE_WEIGHT = 0.25
"""What the square root of a number of features counts for, and beside it a place. Features are many
where photos overlap by far, and then some more of them say nothing."""

PLENTY = 60
PLENTY_OF_FEATURES = 2
"""So many places leave no doubt: the features of such a pair are not asked, and taken to be so many
times as many."""

EXPANSION_NEIGHBOURS = 12
EXPANSION_SHARE = 0.4
"""Query expansion. What these constants were chosen by: docs/training-log.md, sections 9 and 20."""


def rerank(
    candidates: Ranking,
    store: Store,
    model: str,
    k: int,
    depth: int = COMPARED,
    features: LargestFeatures | None = None,
) -> Ranking:
    """Return a ranking as deep as the candidates', at most `depth` of them compared place by place.

    Each image asks for its likeliest partners, a few at a time, until none is likely, or to the end
    where it has hardly any (`Asking`). What was learned so far chooses: a neighbour whom the
    descriptors overlooked is found by way of its neighbours. Counts are kept in the store: pairs
    compared before are not compared again.

    Args:
        candidates: by whatever found them, `max(k, depth)` deep where there are as many images.
        store: has the images' cells; a pair without them is not compared.
        model: what the store keeps the cells under.
        k: partners that each image will get.
        features: the images' largest SIFT features; None: there are none.
    """
    counted = _Counted(store, model, candidates, features)
    order = _own_order(candidates)
    asking = Asking(order, depth)
    votes, seconds, idle = sparse.csr_array(order.shape), 0.0, 0
    with step("Comparing photos place by place", order.shape[0]) as bar:
        while (asked := asking.next(_scaled(votes), counted.compared(), counted.sure())).nnz:
            seconds += counted.compare(_pairs_of(asked))
            start = time.perf_counter()
            agreement = counted.agreement()
            votes = expand(agreement, EXPANSION_NEIGHBOURS, EXPANSION_SHARE, max(k, depth))
            # Who was idle may ask again, but progress does not go back.
            most_idle = max(idle, int(np.count_nonzero(np.diff(asked.indptr) == 0)))
            bar.advance(most_idle - idle)
            idle = most_idle
            seconds += time.perf_counter() - start
        bar.advance(order.shape[0] - idle)
    scores = _scaled(votes + TAIL * order)
    best = ranking_of(scores, candidates.names, candidates.method, candidates.depth)
    return replace(
        candidates,
        partners=best.partners,
        scores=best.scores,
        seconds_search=candidates.seconds_search + seconds,
        compared=True,
    )


def _pairs_of(similarity: sparse.csr_array) -> Pairs:
    """Return (M, 2) the distinct pairs of a matrix, lower index first, in order."""
    entries = similarity.tocoo()
    pairs = np.sort(np.stack([entries.row, entries.col], axis=1), axis=1)
    return np.unique(pairs, axis=0).astype(np.intp)


def _scaled(matches: sparse.csr_array) -> sparse.csr_array:
    """Return logarithms: twice the matches are not twice as likely to be a true pair."""
    return (matches / CHANCE).log1p().tocsr()


def _own_order(ranking: Ranking) -> sparse.csr_array:
    """Return (N, N) 1 / rank of each image's candidates."""
    rows, places = np.nonzero(ranking.partners != NO_PARTNER)
    return sparse.csr_array(
        (1.0 / (1 + places), (rows, ranking.partners[rows, places])),
        shape=(len(ranking.names),) * 2,
    )


class _Counted:
    """The pairs of a ranking's images that were compared, and what agreed."""

    def __init__(
        self, store: Store, model: str, candidates: Ranking, features: LargestFeatures | None
    ) -> None:
        # Cells of photos that are broken or gone by now may still be in the store.
        hidden = candidates.not_described
        names = ["" if name in hidden else name for name in candidates.names]
        known = store.agreements()  # once: a million pairs of 20,000 images
        self._places = _counts_of_places(store, known, model, names)
        self._features = (
            None if features is None else _counts_of_features(store, known, features, names)
        )
        self._pairs = np.zeros((0, 2), np.intp)
        self._beyond = np.zeros(0)
        self._sure = np.zeros(0, np.bool_)

    def compare(self, pairs: Pairs) -> float:
        """Count what agrees in pairs that have cells; return the seconds it took, now or when they
        were first compared."""
        pairs = pairs[self._places.has(pairs)]
        places, seconds = self._places.count(pairs)
        beyond, sure = np.maximum(places - CHANCE, 0.0), places > SURE
        if self._features is not None:
            asked = self._features.has(pairs)
            features, doubtful = PLENTY_OF_FEATURES * places, asked & (places < PLENTY)
            features[doubtful], more = self._features.count(pairs[doubtful])
            seen = FEATURE_WEIGHT * np.sqrt(np.maximum(features - FEATURES_BY_CHANCE, 0))
            beyond = np.where(asked, PLACE_WEIGHT * beyond + seen, beyond)
            sure = np.where(asked, features > SURE_FEATURES, sure)
            seconds += more
        self._pairs = np.concatenate([self._pairs, pairs])
        self._beyond = np.concatenate([self._beyond, beyond])
        self._sure = np.concatenate([self._sure, sure])
        return seconds

    def agreement(self) -> sparse.csr_array:
        """Return (N, N) symmetric: what agrees beyond chance, in places."""
        return self._matrix(self._beyond)

    def compared(self) -> sparse.csr_array:
        """Return (N, N) symmetric: 1 for the pairs compared so far."""
        return self._matrix(np.ones(len(self._pairs)))

    def sure(self) -> sparse.csr_array:
        """Return (N, N) symmetric: 1 for sure partners."""
        return self._matrix(self._sure.astype(np.float64))

    def _matrix(self, values: NDArray[np.float64]) -> sparse.csr_array:
        n = len(self._places.numbers)
        upper = sparse.csr_array((values, tuple(self._pairs.T)), shape=(n, n))
        matrix = (upper + upper.T).tocsr()
        matrix.eliminate_zeros()
        return matrix


def _counts_of_places(
    store: Store, known: Known, model: str, names: Sequence[str]
) -> Counts[Places]:
    numbers = _in_order(store.cell_numbers(model), names)
    return Counts(
        store,
        known,
        numbers,
        lambda i: Places.of(store.read_cells(int(numbers[i]))),
        lambda one, others: [agreeing_matches(one, other) for other in others],
    )


def _counts_of_features(
    store: Store, known: Known, features: LargestFeatures, names: Sequence[str]
) -> Counts[Largest]:
    store.number(LARGEST_FEATURES, features.fingerprints)
    given = store.cell_numbers(LARGEST_FEATURES)
    numbers = _in_order({name: given[name] for name in features.fingerprints}, names)
    return Counts(store, known, numbers, lambda i: features.read(names[i]), agreeing_features)


def _in_order(numbers: Mapping[str, int], names: Sequence[str]) -> NDArray[np.int64]:
    return np.array([numbers.get(name, 0) for name in names], np.int64)
