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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.codes import encode, lengths
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.described import rank_described, rank_found
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.search import EXACT_UP_TO, nearest_by
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.runtime.products import operand, products
from colmap_netvlad.runtime.progress import step
from colmap_netvlad.runtime.sequences import blocks

AXES = 32
"""Values of a cell here: its parts along the principal axes of the flight's cells."""

LEAST_WORDS = 256
WORDS_A_PHOTO = 16
"""A flight has a word a photo, but as many as this where its photos are few: at most so many for
each of them."""

MOST_WORDS = 2048
MOST_BYTES = 640 << 20
"""Its descriptors are to fit in memory: fewer words from 10,000 photos on."""

SAMPLE = 100
"""Cells that a word is learned from."""

ASSIGNMENT_RATIO = 100.0
"""How many times more weight the nearest word gets than the second, on average (as NetVLAD's)."""

POWER = 0.35
"""A word's part of a descriptor gets this power of its length: many cells of one kind, a field or
water, count little more than few, and what falls on a word by chance counts next to nothing."""

RARITY = 5.0
"""How alike cells of a photo must be to share a vote: each weighs 1 / (sum over all cells of
exp(-5 (1 - cosine))), so that a wide field or water counts little more than a house (burstiness,
Jegou et al., CVPR 2009)."""

MODELS_SHARE = 180
LEAST_SHARE = 0.05
"""With so many words the model's own descriptors count as much as theirs, and by the square less
with more, to the point where they are left out: with few photos words are single places, and say
little of others. What these constants were chosen by: docs/training-log.md, sections 18 and 21."""

BLOCK_PHOTOS = 64
BLOCK_ROWS = 512
"""Photos described, and rows multiplied, at once."""

Read = Callable[[int], Cells]

Result = TypeVar("Result")


def serves(options: RetrievalOptions, photos: int) -> bool:
    """Whether photos are ranked by words of the flight's own, not by the model's descriptors.

    They are, unless a kind of search is asked for, or each photo is compared with all others, so
    that there is little to rank; above `search.EXACT_UP_TO` photos words do not fit in memory.
    """
    all_compared = photos - 1 <= options.rerank
    return options.exact is None and not all_compared and photos <= EXACT_UP_TO


def rank_in_words(
    store: Store,
    model: str,
    names: Sequence[str],
    left_out: Mapping[str, str],
    options: RetrievalOptions,
    depth: int,
    method: str,
    notes: Sequence[str] = (),
) -> list[tuple[Ranking, float]]:
    """Rank the neighbours of all images by descriptors in words of their own.

    Args:
        store: holds the descriptors and cells of every name that is not in `left_out`; for the
            others see `described.rank_described`.

    Returns:
        That ranking and, where words are few, the one by the model's descriptors, each with its
        share in `fusion.combine`.
    """
    start = time.perf_counter()
    described = [name for name in names if name not in left_out]
    numbers = store.cell_numbers(model)
    cells = [numbers[name] for name in described]

    def read(photo: int) -> Cells:
        return store.read_cells(cells[photo])

    words = Words.learn(read, len(cells), options.seed)
    in_words = InWords(describe(words, read, len(cells)))
    found = replace(
        rank_found(nearest_by(in_words, depth), names, left_out, method),
        seconds_describe=store.seconds(model, described),
        seconds_search=time.perf_counter() - start,
        notes=(*notes, f"ranked by {len(words.centres):,} words of the flight's own"),
    )
    share = models_share(len(words.centres))
    if not share:
        return [(found, 1.0)]
    models = rank_described(store, model, names, left_out, options, depth, method)
    return [(found, 1.0), (replace(models, seconds_describe=0.0), share)]


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

        count = words_of(photos)
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
        vectors = _textured(cells)
        x = _unit(vectors @ self.axes)
        # In place: new memory for a value of each cell and word costs more than the arithmetic.
        weights = x @ _unit(self.centres).T
        weights *= self.hardness
        weights -= weights.max(axis=1, keepdims=True)
        np.exp(weights, out=weights)
        weights *= (_rarity(vectors) / weights.sum(axis=1))[:, None]
        residuals = weights.T @ x - weights.sum(axis=0)[:, None] * self.centres
        lengths = np.linalg.norm(residuals, axis=1, keepdims=True)
        return encode((residuals * np.maximum(lengths, 1e-9) ** (POWER - 1)).ravel())


class InWords:
    """The cosines of N photos described in words of their flight's own.

    Attributes:
        count: N.
    """

    def __init__(self, codes: NDArray[np.int8]) -> None:
        """Take (N, K A) descriptors of `describe`."""
        self.count = len(codes)
        self._codes = codes
        parts = (codes[rows].astype(np.float32) for rows in self.parts())
        self._scale = np.reciprocal(np.concatenate([lengths(part) for part in parts]))

    def parts(self) -> list[slice]:
        """Return rows to multiply at once."""
        return list(blocks(self.count, BLOCK_ROWS))

    def block(self, rows: slice, columns: slice) -> NDArray[np.float32]:
        """Return the cosines of some photos with others."""
        cosines = products(operand(self._codes[rows]), operand(self._codes[columns]))
        return cosines * self._scale[rows, None] * self._scale[columns]


def words_of(photos: int) -> int:
    """Return how many words a flight gets."""
    most = min(MOST_WORDS, MOST_BYTES // (AXES * photos))
    return min(max(photos, min(LEAST_WORDS, WORDS_A_PHOTO * photos)), most)


def models_share(words: int) -> float:
    """Return the weight of the model's cosines beside those in so many words."""
    share = (MODELS_SHARE / words) ** 2
    return share if share >= LEAST_SHARE else 0.0


def describe(words: Words, read: Read, photos: int) -> NDArray[np.int8]:
    """Return (N, K A) the descriptors of all photos in these words, a byte a value."""
    codes = np.empty((photos, words.centres.size), np.int8)
    with step("Describing photos in the flight's own words", photos) as bar:
        for photo, descriptor in enumerate(_of_each(words.describe, read, photos)):
            codes[photo] = descriptor
            bar.advance()
    return codes


def _sample(read: Read, photos: int, count: int, seed: int) -> NDArray[np.float32]:
    """Return about `count` cells, as many of each photo, rare ones rather than common ones."""
    generator = np.random.default_rng(seed)
    each = -(-count // photos)
    drawn = []
    for cells, rarity in _of_each(_with_rarity, read, photos):
        if len(cells) > each:
            chosen = generator.choice(len(cells), each, replace=False, p=rarity / rarity.sum())
            drawn.append(cells[chosen])
        else:
            drawn.append(cells)
    sample = np.concatenate(drawn)
    return sample if len(sample) else np.ones((1, sample.shape[1]), np.float32)


def _of_each(work: Callable[[Cells], Result], read: Read, photos: int) -> Iterator[Result]:
    """Yield what becomes of each photo's cells, in order."""
    # A photo is too little work to share: a thread for each of several.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(usable_processors()) as pool:
        for rows in blocks(photos, BLOCK_PHOTOS):
            yield from pool.map(work, [read(photo) for photo in range(photos)[rows]])


def _with_rarity(cells: Cells) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    textured = _textured(cells)
    return textured, _rarity(textured)


def _textured(cells: Cells) -> NDArray[np.float32]:
    vectors = cells.vectors()
    return vectors[vectors.any(axis=1)]


def _rarity(cells: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (P,) the weight of each of a photo's cells, at most 1: see `RARITY`."""
    alike = np.exp(RARITY * (cells @ cells.T - 1))
    rarity: NDArray[np.float64] = 1 / alike.sum(axis=1, dtype=np.float64)
    return rarity


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(lengths, 1e-12)
