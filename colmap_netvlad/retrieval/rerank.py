"""Compare candidates place by place, and order them by what agrees.

A global descriptor says that two photos show the same kind of ground. That they show the same
piece of it is known when places that look alike also lie alike: the cells behind the
descriptors are matched (mutual nearest neighbours), and the matches that agree on one similarity
transform (turn, scale, shift) are counted. Photos from above are nearly such transforms of each
other, photos of facades in part. A pair takes about a hundredth of matching its SIFT features.

The counts spread by query expansion: the sure neighbours of my sure neighbours are likely mine.
So they choose what is compared next, and a photo stops asking once its latest comparisons found
nothing: most of a long list of candidates teaches nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.fusion import expand, keep_best, ranking_of
from colmap_netvlad.retrieval.options import COMPARED
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.runtime.progress import step

TOLERANCE = 1.25
"""How far from the common transform a match may lie, cells."""

TRANSFORMS = 500
"""Most transforms tried for a pair (RANSAC)."""

CHANCE = 10
"""Matches that agree in photos of different ground as well: the median of six flights is 8 to 10
where the overlap is small. They count as nothing."""

EXPANSION_NEIGHBOURS = 12
EXPANSION_SHARE = 0.4
"""Query expansion. What these constants were chosen by: docs/training-log.md, section 9."""

ASK = 10
"""Candidates that an image asks for at a time."""

PATIENCE = 20
"""An image asks no more after so many candidates in a row that were no sure partners."""

SURE = 10
"""More matches beyond chance than this make a sure partner."""

SURE_PARTNERS = 2
"""Who has fewer sure partners asks on: what hardly overlaps with any other is not to be missed.
What these four were chosen by: docs/training-log.md, section 10."""

TAIL = 1e-3
"""Weight of the candidates' own order, which decides where nothing agrees."""

CACHE_BYTES = 512 << 20
"""Memory for cells, so that an image's are not read anew for each pair."""

KEEP_PAIRS = 2000
"""Pairs compared between two writes to the store."""

Pairs = NDArray[np.intp]


def rerank(candidates: Ranking, store: Store, model: str, k: int, depth: int = COMPARED) -> Ranking:
    """Return a ranking as deep as the candidates', at most `depth` of them compared place by place.

    Each image asks for its best candidates, `ASK` at a time, until `PATIENCE` in a row were no
    sure partners, or to the end where it has hardly any. What was learned so far chooses: a
    neighbour whom the descriptors overlooked is found by way of its neighbours. Counts are kept
    in the store: pairs compared before are not compared again.

    Args:
        candidates: by whatever found them, `max(k, depth)` deep where there are as many images.
        store: has the images' cells; a pair without them is not compared.
        model: what the store keeps the cells under.
        k: partners that each image will get.
    """
    counted = _Counted(store, model, candidates)
    own = TAIL * _own_order(candidates)
    similarity, seconds = own, 0.0
    most = np.full(len(candidates.names), min(ASK, depth - depth // 2), np.intp)
    asks, left, quiet = most, np.full_like(most, depth), np.zeros_like(most)
    with step("Comparing photos place by place", len(asks)) as bar:
        while asks.any():
            chosen = keep_best(counted.without(similarity), asks)
            seconds += counted.compare(_pairs_of(chosen))
            start = time.perf_counter()
            agreement = counted.agreement()
            expanded = expand(agreement, EXPANSION_NEIGHBOURS, EXPANSION_SHARE, max(k, depth))
            similarity = (expanded + own).tocsr()
            sure = agreement > SURE
            found = (chosen > 0).multiply(sure).sum(axis=1) > 0
            quiet = np.where(found, 0, quiet + asks)
            goes_on = (quiet < PATIENCE) | (sure.sum(axis=1) < SURE_PARTNERS)
            left = left - asks
            asked, asks = asks, np.where((asks > 0) & goes_on, np.minimum(most, left), 0)
            bar.advance(int(np.count_nonzero(asked) - np.count_nonzero(asks)))
            seconds += time.perf_counter() - start
    # Logarithms: twice the matches are not twice as likely to be a true pair.
    best = ranking_of(similarity.log1p(), candidates.names, candidates.method, candidates.depth)
    return replace(
        candidates,
        partners=best.partners,
        scores=best.scores,
        seconds_search=candidates.seconds_search + seconds,
        compared=True,
    )


@dataclass(frozen=True, eq=False)
class Places:
    """Cells ready to be compared.

    Attributes:
        vectors: (P, D) L2-normalised.
        at: (P, 2) x, y, cells.
    """

    vectors: NDArray[np.float32]
    at: NDArray[np.float32]

    @classmethod
    def of(cls, cells: Cells) -> Places:
        """Decode cells, without places that have no texture."""
        vectors, at = cells.vectors(), cells.places()
        textured = vectors.any(axis=1)
        return cls(vectors[textured], at[textured])


def agreeing_matches(one: Places, other: Places) -> int:
    """Return how many mutual nearest neighbours agree on one similarity transform."""
    return int(agreement(one, other)[1].sum())


def agreement(one: Places, other: Places) -> tuple[Pairs, NDArray[np.bool_]]:
    """Return (M, 2) mutual nearest neighbours, places of both, and (M,) which of them agree on
    one similarity transform."""
    nothing = np.zeros((0, 2), np.intp), np.zeros(0, np.bool_)
    if min(len(one.at), len(other.at)) < 2:
        return nothing
    cosines = one.vectors @ other.vectors.T
    best, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    mutual = np.flatnonzero(back[best] == np.arange(len(best)))
    if len(mutual) < 2:
        return nothing
    # OpenCV seeds each call alike: the same count every time.
    _, agree = cv2.estimateAffinePartial2D(
        one.at[mutual],
        other.at[best[mutual]],
        method=cv2.RANSAC,
        ransacReprojThreshold=TOLERANCE,
        maxIters=TRANSFORMS,
        refineIters=0,
    )
    pairs = np.stack([mutual, best[mutual]], axis=1)
    return pairs, np.zeros(len(pairs), np.bool_) if agree is None else agree.ravel() > 0


def _pairs_of(similarity: sparse.csr_array) -> Pairs:
    """Return (M, 2) the distinct pairs of a matrix, lower index first, in order."""
    entries = similarity.tocoo()
    pairs = np.sort(np.stack([entries.row, entries.col], axis=1), axis=1)
    return np.unique(pairs, axis=0).astype(np.intp)


def _own_order(ranking: Ranking) -> sparse.csr_array:
    """Return (N, N) 1 / rank of each image's candidates."""
    rows, places = np.nonzero(ranking.partners != NO_PARTNER)
    return sparse.csr_array(
        (1.0 / (1 + places), (rows, ranking.partners[rows, places])),
        shape=(len(ranking.names),) * 2,
    )


class _Counted:
    """The pairs of a ranking's images that were compared, and what agreed."""

    def __init__(self, store: Store, model: str, candidates: Ranking) -> None:
        numbers = store.cell_numbers(model)
        left_out = {name for name, _ in candidates.left_out}
        ids = [0 if name in left_out else numbers.get(name, 0) for name in candidates.names]
        self._ids = np.array(ids, np.int64)
        self._store = store
        self._read = _reader(store, self._ids)
        self._known = store.agreements()
        self._pairs = np.zeros((0, 2), np.intp)
        self._matches = np.zeros(0)

    def compare(self, pairs: Pairs) -> float:
        """Count the agreeing matches of pairs that have cells; return the seconds it
        took, now or when they were first compared."""
        pairs = pairs[(self._ids[pairs] > 0).all(axis=1)]
        keys = _joined(np.sort(self._ids[pairs], axis=1))
        missing = ~np.isin(keys, _joined(self._known[0]))
        if missing.any():
            _compare(pairs[missing], self._ids, self._store, self._read)
            self._known = self._store.agreements()
        known, matches, seconds = self._known
        at = np.searchsorted(_joined(known), keys)
        self._pairs = np.concatenate([self._pairs, pairs])
        self._matches = np.concatenate([self._matches, matches[at]])
        return float(seconds[at].sum())

    def agreement(self) -> sparse.csr_array:
        """Return (N, N) symmetric: matches that agree beyond chance."""
        matrix = self._matrix(np.maximum(self._matches - CHANCE, 0.0))
        matrix.eliminate_zeros()
        return matrix

    def without(self, similarity: sparse.csr_array) -> sparse.csr_array:
        """Return a similarity without the pairs compared so far."""
        done = self._matrix(np.ones(len(self._pairs)))
        rest = (similarity - similarity * done).tocsr()
        rest.eliminate_zeros()
        return rest

    def _matrix(self, values: NDArray[np.float64]) -> sparse.csr_array:
        upper = sparse.csr_array((values, tuple(self._pairs.T)), shape=(len(self._ids),) * 2)
        return (upper + upper.T).tocsr()


def _joined(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (M,) one number for each row of (M, 2) positive numbers below 2^31, in their order."""
    return (keys[:, 0] << 32) + keys[:, 1]


def _compare(
    pairs: Pairs, ids: NDArray[np.int64], store: Store, read: Callable[[int], Places]
) -> None:
    """Count the agreeing matches of pairs, ordered by their first image, into the store."""
    starts = np.flatnonzero(np.diff(pairs[:, 0], prepend=-1))
    rows: list[tuple[int, int, int, float]] = []
    with (
        step("Pairs of candidates", len(pairs)) as bar,
        # A pair is too little work to share: a thread for each of several pairs is twice as fast.
        threadpool_limits(1, "blas"),
        ThreadPoolExecutor(usable_processors()) as pool,
    ):
        for group in np.split(pairs, starts[1:]):
            start = time.perf_counter()
            one = read(int(group[0, 0]))
            others = [read(int(j)) for j in group[:, 1]]
            counts = list(pool.map(lambda other, one=one: agreeing_matches(one, other), others))
            share = (time.perf_counter() - start) / len(group)
            for (i, j), count in zip(ids[group].tolist(), counts, strict=True):
                rows.append((min(i, j), max(i, j), count, share))
            if len(rows) >= KEEP_PAIRS:
                store.add_agreements(rows)
                rows = []
            bar.advance(len(group))
    store.add_agreements(rows)


def _reader(store: Store, ids: NDArray[np.int64]) -> Callable[[int], Places]:
    """Return a function from an image's index to its features, the latest kept in memory."""
    with_cells = ids[ids > 0]
    values = store.read_cells(int(with_cells[0])).codes.size if len(with_cells) else 0
    most = max(CACHE_BYTES // (4 * max(values, 1)), 2)

    @lru_cache(maxsize=most)
    def read(image: int) -> Places:
        return Places.of(store.read_cells(int(ids[image])))

    return read
