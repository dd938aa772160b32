"""Descriptors in words of the flight's own: its cells, aggregated around centres of its own.

A model's NetVLAD has centres for any ground. One flight shows few kinds of it, which fall on few
of these centres: among hundreds of photos of the same woods and fields all descriptors are alike.
So the cells of its photos, kept for comparing, are clustered into words, and each photo is
described once more, by where its cells lie around those: VLAD (Jegou et al., CVPR 2010) with
NetVLAD's soft assignment, on learned features. Nothing of it is kept: it takes a few milliseconds
a photo.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.codes import decode, encode
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.described import rank_vectors
from colmap_netvlad.retrieval.fusion import expand, ranking_of, similarity_matrix
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.search import EXACT_UP_TO, Vectors
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.runtime.progress import step
from colmap_netvlad.runtime.sequences import blocks

AXES = 32
"""Values of a cell here: its parts along the principal axes of the flight's cells."""

MOST_WORDS = 1024
"""A flight has a word a photo, up to this many: its descriptors are to fit in memory."""

SAMPLE = 100
"""Cells that a word is learned from."""

ASSIGNMENT_RATIO = 100.0
"""How many times more weight the nearest word gets than the second, on average (as NetVLAD's)."""

POWER = 0.35
"""A word's part of a descriptor gets this power of its length: many cells of one kind, a field or
water, count little more than few, and what falls on a word by chance counts next to nothing."""

MODELS_SHARE = 136
"""With so many words the model's own descriptors count as much as theirs, and by the square less
with more: in small flights words are single places, and say little of others."""

EXPANSION_NEIGHBOURS = 5
EXPANSION_SHARE = 0.5
"""Query expansion. What these constants were chosen by: docs/training-log.md, section 18."""

BLOCK_PHOTOS = 64

Read = Callable[[int], Cells]


def serves(options: RetrievalOptions, photos: int) -> bool:
    """Whether candidates are chosen by words of the flight's own.

    Where all photos are compared with each other, there is nothing to choose; thousands of words
    for tens of thousands of photos do not fit in memory.
    """
    many = 0 < options.rerank < photos - 1
    return many and photos <= EXACT_UP_TO and options.exact is not False


def rank_in_words(
    store: Store,
    model: str,
    names: Sequence[str],
    left_out: Mapping[str, str],
    options: RetrievalOptions,
    depth: int,
    method: str,
    notes: Sequence[str] = (),
) -> Ranking:
    """Search the neighbours of all images by descriptors in words of their own.

    Args:
        store: holds the descriptors and cells of every name that is not in `left_out`; for the
            others see `described.rank_described`.
    """
    start = time.perf_counter()
    described = [name for name in names if name not in left_out]
    numbers = store.cell_numbers(model)
    cells = [numbers[name] for name in described]

    def read(photo: int) -> Cells:
        return store.read_cells(cells[photo])

    words = Words.learn(read, len(cells), options.seed)
    share = models_share(len(words.centres))
    codes = describe(words, read, len(cells))
    vectors = InWords(codes, store.vectors(model, described), share)
    found = rank_vectors(vectors, names, left_out, options, depth, method)
    similarity = expand(
        similarity_matrix(found), EXPANSION_NEIGHBOURS, EXPANSION_SHARE, found.depth
    )
    best = ranking_of(similarity, found.names, method, found.depth)
    return replace(
        best,
        seconds_describe=store.seconds(model, described),
        seconds_search=time.perf_counter() - start,
        left_out=found.left_out,
        notes=(*notes, f"candidates by {len(words.centres):,} words of the flight's own"),
    )


@dataclass(frozen=True, eq=False)
class Words:
    """The words of a flight.

    Attributes:
        axes: (C, A), orthonormal principal axes of its cells.
        centres: (K, A), of cells along the axes, L2-normalised.
        hardness: of the assignment to words.
    """

    axes: NDArray[np.float32]
    centres: NDArray[np.float32]
    hardness: float

    @classmethod
    def learn(cls, read: Read, photos: int, seed: int) -> Words:
        """Cluster the cells of a flight.

        Args:
            read: the cells of the photo of that number, 0..photos - 1.
            seed: of which cells are drawn, and of k-means.
        """
        import faiss

        count = min(photos, MOST_WORDS)
        sample = _sample(read, photos, SAMPLE * count, seed)
        axes = np.linalg.eigh((sample.T @ sample).astype(np.float64))[1][:, ::-1][:, :AXES]
        axes = np.ascontiguousarray(axes, np.float32)
        sample = _unit(sample @ axes)
        count = min(count, len(sample))
        kmeans = faiss.Kmeans(
            sample.shape[1],
            count,
            niter=10,
            seed=seed + 1,
            min_points_per_centroid=1,
            max_points_per_centroid=2 * SAMPLE,
        )
        kmeans.train(sample)
        centres = np.array(kmeans.centroids, np.float32)
        nearest = np.sort(sample[::SAMPLE] @ _unit(centres).T, axis=1)[:, -2:]
        gap = float((nearest[:, -1] - nearest[:, 0]).mean())
        return cls(axes, centres, float(np.log(ASSIGNMENT_RATIO)) / max(gap, 1e-6))

    def describe(self, cells: Cells) -> NDArray[np.int8]:
        """Return the descriptor of a photo, (K A,), as `cache.codes.encode` keeps it."""
        x = _unit(_textured(cells) @ self.axes)
        scores = self.hardness * (x @ _unit(self.centres).T)
        weights = np.exp(scores - scores.max(axis=1, keepdims=True))
        weights /= weights.sum(axis=1, keepdims=True)
        residuals = weights.T @ x - weights.sum(axis=0)[:, None] * self.centres
        lengths = np.linalg.norm(residuals, axis=1, keepdims=True)
        return encode((residuals * np.maximum(lengths, 1e-9) ** (POWER - 1)).ravel())


class InWords:
    """(N, D) descriptors of a flight in its own words, beside those of the model: rows to slice.

    Attributes:
        shape: (N, D).
    """

    def __init__(self, codes: NDArray[np.int8], models: Vectors, share: float) -> None:
        """Join descriptors in words with the model's, which are read as they are sliced.

        Args:
            codes: (N, K A) of `Words.describe`.
            models: (N, D) L2-normalised.
            share: weight of the model's cosines beside those in words; 0: they are left out.
        """
        self._codes, self._models = codes, models
        self._weights = np.sqrt(np.array([1.0, share]) / (1.0 + share)).astype(np.float32)
        self.shape = (len(codes), codes.shape[1] + (models.shape[1] if share else 0))

    def __getitem__(self, rows: slice) -> NDArray[np.float32]:
        own = self._weights[0] * decode(self._codes[rows])
        if not self._weights[1]:
            return own
        return np.hstack([own, self._weights[1] * self._models[rows]])


def models_share(words: int) -> float:
    """Return the weight of the model's cosines beside those in so many words."""
    return (MODELS_SHARE / words) ** 2 if words < MOST_WORDS else 0.0


def describe(words: Words, read: Read, photos: int) -> NDArray[np.int8]:
    """Return (N, K A) the descriptors of all photos in these words, a byte a value."""
    codes = np.empty((photos, words.centres.size), np.int8)
    with (
        step("Describing photos in the flight's own words", photos) as bar,
        # A photo is too little work to share: a thread for each of several.
        threadpool_limits(1, "blas"),
        ThreadPoolExecutor(usable_processors()) as pool,
    ):
        for rows in blocks(photos, BLOCK_PHOTOS):
            cells = [read(photo) for photo in range(photos)[rows]]
            codes[rows] = list(pool.map(words.describe, cells))
            bar.advance(len(cells))
    return codes


def _sample(read: Read, photos: int, count: int, seed: int) -> NDArray[np.float32]:
    """Return about `count` cells, as many of each photo."""
    generator = np.random.default_rng(seed)
    each = -(-count // photos)
    drawn = []
    for photo in range(photos):
        cells = _textured(read(photo))
        drawn.append(cells[generator.permutation(len(cells))[:each]])
    sample = np.concatenate(drawn)
    return sample if len(sample) else np.ones((1, sample.shape[1]), np.float32)


def _textured(cells: Cells) -> NDArray[np.float32]:
    vectors = cells.vectors()
    return vectors[vectors.any(axis=1)]


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(lengths, 1e-12)
