"""The nearest neighbours of every descriptor among all others, by inner product.

Exact search multiplies blocks of descriptors with each other. Reduced search does so with their
parts along the principal axes and orders what it finds by the whole descriptors, a byte a value.
HNSW (the paper's section 4.2) builds faiss' graph index. All read the descriptors in blocks, so a
store larger than memory serves as well as an array, and none makes an N x N matrix.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.runtime.progress import step
from colmap_netvlad.runtime.sequences import blocks

EXACT_UP_TO = 20_000
"""Exact search up to this number of images, reduced search above
(`benchmarks/search_scale.py --reduced`)."""

AXES = 256
"""Values of a reduced descriptor."""

SAMPLE = 2048
"""Descriptors, spread over all, that the principal axes are of."""

SHORTLIST = 400
"""Least number of reduced search's finds for each image that the whole descriptors order."""

BLOCK_BYTES = 64 << 20
"""Memory of one block of descriptors as float32."""

BLOCK_ROWS = 4096
"""Most rows of a block, so that the product of two blocks stays as small."""

HNSW_LINKS = 32
HNSW_BUILD = 80
"""faiss' M and efConstruction."""


class Vectors(Protocol):
    """(N, D) L2-normalised rows that can be sliced: an array, or a store that reads them."""

    shape: tuple[int, int]

    def __getitem__(self, rows: slice) -> NDArray[np.floating]: ...


class Similar(Protocol):
    """How alike `count` things are, each with each; the same in both directions."""

    count: int

    def parts(self) -> list[slice]:
        """Return all rows, in parts to ask for at once."""
        ...

    def block(self, rows: slice, columns: slice) -> NDArray[np.float32]:
        """Return how alike some are with others."""
        ...


Neighbours = tuple[NDArray[np.int32], NDArray[np.float32]]


def nearest(
    vectors: Vectors | NDArray[np.floating], k: int, exact: bool | None = None, seed: int = 0
) -> Neighbours:
    """Return for each row its `k` nearest other rows, best first.

    Every row gets exactly `k` partners, never itself, none twice; equal scores are ordered by
    row number.

    Args:
        vectors: (N, D) L2-normalised descriptors, N > k.
        k: partners of each row, clamped to N - 1.
        exact: True for exact search, False for HNSW, None for exact search up to `EXACT_UP_TO`
            images and reduced search above.
        seed: of HNSW's random levels.

    Returns:
        partners (N, k) int32 and scores (N, k) float32, the inner products (cosines), -1..1.
    """
    count = vectors.shape[0]
    k = min(k, count - 1)
    if exact or k < 1 or (exact is None and count <= EXACT_UP_TO):
        return nearest_by(_Cosines(vectors), k)
    return _hnsw(vectors, k, seed) if exact is False else _reduced(vectors, k)


def nearest_by(similar: Similar, k: int) -> Neighbours:
    """Return for each row its `k` nearest other rows by exact search, as `nearest`.

    Args:
        similar: is asked once for each two parts of all rows.
        k: partners of each row, clamped to N - 1.
    """
    k = max(min(k, similar.count - 1), 0)
    partners = np.zeros((similar.count, k), np.int32)
    scores = np.full((similar.count, k), -np.inf, np.float32)
    if k == 0:
        return partners, scores
    parts = similar.parts()
    with step("Searching neighbours", len(parts)) as bar:
        for i, rows in enumerate(parts):
            own = similar.block(rows, rows)
            np.fill_diagonal(own, -np.inf)
            _merge(partners, scores, rows, own, rows)
            for columns in parts[i + 1 :]:
                # One block serves both images of a pair.
                block = similar.block(rows, columns)
                _merge(partners, scores, rows, block, columns)
                _merge(partners, scores, columns, block.T, rows)
            bar.advance()
    return partners, scores


class _Cosines:
    """The cosines of descriptors, which are read as they are asked for."""

    def __init__(self, vectors: Vectors | NDArray[np.floating]) -> None:
        self.count = vectors.shape[0]
        self._vectors = vectors
        self._latest: tuple[slice, NDArray[np.float32]] | None = None

    def parts(self) -> list[slice]:
        return _blocks_of(self._vectors)

    def block(self, rows: slice, columns: slice) -> NDArray[np.float32]:
        if self._latest is None or self._latest[0] != rows:
            self._latest = rows, _load(self._vectors, rows)
        left = self._latest[1]
        return left @ (left if columns == rows else _load(self._vectors, columns)).T


def _merge(
    partners: NDArray[np.int32],
    scores: NDArray[np.float32],
    rows: slice,
    found: NDArray[np.float32],
    columns: slice,
) -> None:
    """Merge the scores `found` between `rows` and `columns` into the best of `rows` so far."""
    k = partners.shape[1]
    if found.shape[1] > k:
        keep = np.argpartition(-found, k - 1, axis=1)[:, :k]
        found = np.take_along_axis(found, keep, axis=1)
    else:
        keep = np.broadcast_to(np.arange(found.shape[1]), found.shape)
    all_partners = np.hstack([partners[rows], (keep + columns.start).astype(np.int32)])
    all_scores = np.hstack([scores[rows], found])
    order = np.lexsort((all_partners, -all_scores))[:, :k]
    partners[rows] = np.take_along_axis(all_partners, order, axis=1)
    scores[rows] = np.take_along_axis(all_scores, order, axis=1)


def _hnsw(vectors: Vectors | NDArray[np.floating], k: int, seed: int) -> Neighbours:
    import faiss

    _, dim = vectors.shape
    float16 = faiss.ScalarQuantizer.QT_fp16
    index: Any = faiss.IndexHNSWSQ(dim, float16, HNSW_LINKS, faiss.METRIC_INNER_PRODUCT)  # type: ignore[arg-type]
    index.is_trained = True  # float16 codes have nothing to learn
    index.hnsw.rng = faiss.RandomGenerator(seed)  # type: ignore[attr-defined]
    index.hnsw.efConstruction = HNSW_BUILD
    index.hnsw.efSearch = max(2 * (k + 2), 64)
    with _one_thread(faiss):
        _fill(index, vectors)
    return _ask(index, vectors, k)


def _reduced(vectors: Vectors | NDArray[np.floating], k: int) -> Neighbours:
    import faiss

    _, dim = vectors.shape
    sample = _spread(vectors, SAMPLE)
    axes = _principal_axes(sample, AXES)
    turn = faiss.LinearTransform(dim, len(axes), False)
    faiss.copy_array_to_vector(axes.ravel(), turn.A)
    turn.is_trained = True
    coarse: Any = faiss.IndexPreTransform(turn, faiss.IndexFlatIP(len(axes)))
    byte = faiss.ScalarQuantizer.QT_8bit
    fine: Any = faiss.IndexScalarQuantizer(dim, byte, faiss.METRIC_INNER_PRODUCT)
    fine.train(sample)
    # Room for all at once: growing by halves, faiss would take three times as much on the way.
    fine.codes.resize(vectors.shape[0] * fine.code_size)
    fine.codes.resize(0)
    index: Any = faiss.IndexRefine(coarse, fine)
    index.k_factor = max(1.0, SHORTLIST / (k + 2))
    _fill(index, vectors)
    return _ask(index, vectors, k)


def _spread(vectors: Vectors | NDArray[np.floating], count: int) -> NDArray[np.float32]:
    """Return at most `count` rows, spread over all."""
    total, dim = vectors.shape
    chosen = np.arange(0, total, max(-(-total // count), 1))
    sample = np.empty((len(chosen), dim), np.float32)
    for part in _blocks_of(vectors):
        first, last = np.searchsorted(chosen, [part.start, part.stop])
        # Copied into the sample: views would keep whole blocks, and so all descriptors, in memory.
        sample[first:last] = _load(vectors, part)[chosen[first:last] - part.start]
    return sample


def _principal_axes(sample: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return at most `count` orthonormal axes, largest share of the sample first.

    They are those of the sample as it is, its mean not taken off, since inner products are to be
    kept: with the mean taken off, 3 % less of the 100 nearest were found.
    """
    values, vectors = np.linalg.eigh((sample @ sample.T).astype(np.float64))
    kept = np.flatnonzero(values > 1e-6 * values[-1])[::-1][:count]
    axes = vectors[:, kept].T @ sample / np.sqrt(values[kept])[:, None]
    return np.ascontiguousarray(axes, np.float32)


def _fill(index: Any, vectors: Vectors | NDArray[np.floating]) -> None:
    with step("Indexing descriptors", vectors.shape[0]) as bar:
        for rows in _blocks_of(vectors):
            block = _load(vectors, rows)
            index.add(block)
            bar.advance(len(block))


def _ask(index: Any, vectors: Vectors | NDArray[np.floating], k: int) -> Neighbours:
    """Ask a faiss index for the neighbours of all that is in it."""
    count = vectors.shape[0]
    partners = np.zeros((count, k), np.int32)
    scores = np.zeros((count, k), np.float32)
    parts = _blocks_of(vectors)
    short: list[int] = []
    with step("Searching neighbours", count) as bar:
        for rows in parts:
            block = _load(vectors, rows)
            # Two more than asked for: the row itself, and a spare.
            found_scores, found = index.search(block, min(k + 2, count))
            for i, (row, row_scores) in enumerate(zip(found, found_scores, strict=True)):
                # The row itself is removed by its number: with duplicates it is not always first.
                keep = np.flatnonzero((row >= 0) & (row != rows.start + i))[:k]
                if len(keep) < k:
                    short.append(rows.start + i)
                    continue
                partners[rows.start + i] = row[keep]
                scores[rows.start + i] = row_scores[keep]
            bar.advance(len(block))
    for row_number in short:
        _search_exactly(vectors, parts, row_number, partners, scores)
    return partners, scores


def _search_exactly(
    vectors: Vectors | NDArray[np.floating],
    parts: list[slice],
    row: int,
    partners: NDArray[np.int32],
    scores: NDArray[np.float32],
) -> None:
    """Fill one row by exact search: a part of the graph that its walk did not reach."""
    rows = slice(row, row + 1)
    query = _load(vectors, rows)
    scores[rows] = -np.inf
    for columns in parts:
        found = query @ _load(vectors, columns).T
        if columns.start <= row < columns.stop:
            found[0, row - columns.start] = -np.inf
        _merge(partners, scores, rows, found, columns)


def _blocks_of(vectors: Vectors | NDArray[np.floating]) -> list[slice]:
    count, dim = vectors.shape
    return list(blocks(count, min(max(BLOCK_BYTES // (4 * max(dim, 1)), 16), BLOCK_ROWS)))


def _load(vectors: Vectors | NDArray[np.floating], rows: slice) -> NDArray[np.float32]:
    return np.ascontiguousarray(vectors[rows], dtype=np.float32)


@contextmanager
def _one_thread(faiss: Any) -> Iterator[None]:
    """faiss adds to HNSW in an order that depends on its threads; one thread is repeatable."""
    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        yield
    finally:
        faiss.omp_set_num_threads(threads)
