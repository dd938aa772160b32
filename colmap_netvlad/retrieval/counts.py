"""How much agrees in pairs of images: counted once, kept in the store."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property, lru_cache
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.store import Store
from colmap_netvlad.runtime.machine import usable_memory, usable_processors
from colmap_netvlad.runtime.products import threads_of_their_own
from colmap_netvlad.runtime.progress import step
from colmap_netvlad.runtime.sequences import blocks

CACHE_SHARE = 1 / 8
"""Of the memory, for features of one kind: an image's are not read anew for each pair. Those of
the largest features of 3,500 photos take 1 GiB."""

AT_ONCE = 8
"""Images that one is compared with at a time."""

KEEP_PAIRS = 2000
"""Pairs compared between two writes to the store."""

Pairs = NDArray[np.intp]
"""(M, 2) pairs of indices of images."""


class Seen(Protocol):
    """What of a photo is compared."""

    @property
    def nbytes(self) -> int:
        """Memory it takes."""
        ...


Kind = TypeVar("Kind", bound=Seen)

Agreeing = Callable[[Kind, Sequence[Kind]], list[int]]

Known = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]
"""What the store has counted (`Store.agreements`)."""

Rows = list[tuple[int, int, int, float]]
"""Numbers of two images, lower first; how much agrees; seconds."""


class Counts(Generic[Kind]):
    """Counts of what agrees in pairs of N images by one kind of features.

    Attributes:
        numbers: (N,) what the store knows the images' features by; 0 where there are none.
    """

    def __init__(
        self,
        store: Store,
        known: Known,
        numbers: NDArray[np.int64],
        read: Callable[[int], Kind],
        agreeing: Agreeing[Kind],
    ) -> None:
        """Start from what the store has.

        Args:
            known: of all kinds of features; theirs are told apart by their numbers.
            read: an image's features, by its index.
            agreeing: how much agrees in an image and each of several others.
        """
        self.numbers = numbers
        self._store, self._read, self._agreeing = store, read, agreeing
        pairs, self._matches, self._seconds = known
        self._keys = _joined(pairs)

    def has(self, pairs: Pairs) -> NDArray[np.bool_]:
        """Return (M,) whether both images have such features."""
        has: NDArray[np.bool_] = np.all(self.numbers[pairs] > 0, axis=1)
        return has

    def count(self, pairs: Pairs) -> tuple[NDArray[np.int64], float]:
        """Return (M,) how much agrees, 0 where there are no features; the seconds that counting
        took, now or when the pairs were first compared.

        Args:
            pairs: ordered by their first image.
        """
        has = self.has(pairs)
        pairs = pairs[has]
        keys = _joined(np.sort(self.numbers[pairs], axis=1))
        missing = ~_among(keys, self._keys)
        if missing.any():
            new = pairs[missing]
            self._add(_compare(new, self.numbers, self._store, self._latest, self._agreeing))
        at = np.searchsorted(self._keys, keys)
        matches = np.zeros(len(has), np.int64)
        matches[has] = self._matches[at]
        return matches, float(self._seconds[at].sum())

    @cached_property
    def _latest(self) -> Callable[[int], Kind]:
        """From an image's index to its features, the latest kept in memory."""
        # Of three images far apart: one may show nothing but sky.
        images = np.flatnonzero(self.numbers)
        some = images[[0, len(images) // 2, -1]].tolist()
        size = max(1, *(self._read(image).nbytes for image in some))
        return lru_cache(maxsize=max(int(CACHE_SHARE * usable_memory() / size), 2))(self._read)

    def _add(self, rows: Rows) -> None:
        first, second, matches, seconds = np.array(rows).T
        pairs = np.stack([first, second], axis=1).astype(np.int64)
        keys = np.concatenate([self._keys, _joined(pairs)])
        order = np.argsort(keys, kind="stable")
        self._keys = keys[order]
        self._matches = np.concatenate([self._matches, matches.astype(np.int64)])[order]
        self._seconds = np.concatenate([self._seconds, seconds])[order]


def _joined(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (M,) one number for each row of (M, 2) positive numbers below 2^31, in their order."""
    return (keys[:, 0] << 32) + keys[:, 1]


def _among(keys: NDArray[np.int64], known: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (M,) which keys are among the known ones, which are in order."""
    # Not `numpy.isin`: it hashes all that is known, each time.
    at = np.searchsorted(known, keys)
    found = at < len(known)
    found[found] = known[at[found]] == keys[found]
    return found


def _compare(
    pairs: Pairs,
    numbers: NDArray[np.int64],
    store: Store,
    read: Callable[[int], Kind],
    agreeing: Agreeing[Kind],
) -> Rows:
    """Count what agrees in pairs, ordered by their first image, into the store; return it."""
    rows: Rows = []
    kept = 0
    with (
        step("Pairs of candidates", len(pairs)) as bar,
        # Too little work to share: threads each of which compares on its own are twice as fast.
        threads_of_their_own(usable_processors()) as pool,
    ):
        start = time.perf_counter()
        for group, counts in _counted(_groups(pairs), read, agreeing, pool):
            done = time.perf_counter()
            share = (done - start) / len(group)
            start = done
            for (i, j), count in zip(numbers[group].tolist(), counts, strict=True):
                rows.append((min(i, j), max(i, j), count, share))
            if len(rows) - kept >= KEEP_PAIRS:
                store.add_agreements(rows[kept:])
                kept = len(rows)
            bar.advance(len(group))
    store.add_agreements(rows[kept:])
    return rows


def _groups(pairs: Pairs) -> Iterator[Pairs]:
    """Yield pairs of the same first image, a few at a time."""
    starts = np.flatnonzero(np.diff(pairs[:, 0], prepend=-1))
    for group in np.split(pairs, starts[1:]):
        for part in blocks(len(group), AT_ONCE):
            yield group[part]


def _counted(
    groups: Iterable[Pairs],
    read: Callable[[int], Kind],
    agreeing: Agreeing[Kind],
    pool: ThreadPoolExecutor,
) -> Iterator[tuple[Pairs, list[int]]]:
    """Yield groups and what agrees in each of their pairs, in order; features are read here."""
    ahead = 2 * usable_processors()
    waiting: deque[tuple[Pairs, Future[list[int]]]] = deque()
    for group in groups:
        one, others = read(int(group[0, 0])), [read(int(j)) for j in group[:, 1]]
        waiting.append((group, pool.submit(agreeing, one, others)))
        if len(waiting) > ahead:
            oldest, counts = waiting.popleft()
            yield oldest, counts.result()
    for group, counts in waiting:
        yield group, counts.result()
