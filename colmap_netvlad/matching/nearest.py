"""Nearest descriptors: best and second best of a few against many, as small exact products."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.runtime.products import operand, products

PRODUCT = 2**20
ROWS = (128, 512)
"""Entries of a product, of 4 bytes, so that it stays in the processor's cache; its rows, least and
most: of few columns, more rows save calls."""

NORM = 1 / 512**2
"""Of the products of two descriptors."""

LOWER = 128
"""What codes are less than descriptors."""

NONE = np.iinfo(np.int32).min
"""Below all products."""

MAX_ANGLE = 0.7
MAX_RATIO = 0.8
"""COLMAP's: largest angle (rad) between descriptors that match, and largest ratio to that of the
second best."""


@dataclass(frozen=True, eq=False)
class Codes:
    """Descriptors less `LOWER`.

    Attributes:
        values: (N, 128).
        shift: (N,) the part of the products of descriptors that depends on one of them alone, as
            (a + 128)(b + 128) = ab + 128 a + 128 b + 128 * 128 for each of their values.
    """

    values: NDArray[np.int8]
    shift: NDArray[np.int32]

    @classmethod
    def of(cls, descriptors: NDArray[np.uint8]) -> Codes:
        """Return the codes of (N, 128) descriptors."""
        values = (descriptors ^ LOWER).view(np.int8)
        return cls(values, LOWER * values.sum(axis=1, dtype=np.int32))

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, rows: NDArray[np.intp] | slice) -> Codes:
        return Codes(self.values[rows], self.shift[rows])


@dataclass(frozen=True, eq=False)
class Nearest:
    """Neighbours of M queries.

    Attributes:
        best: (M,) index of the nearest; -1 where there is none.
        angle: (M,) to the nearest, rad.
        ratio: (M,) of that to the angle to the second nearest; 0 where there is only one.
    """

    best: NDArray[np.intp]
    angle: NDArray[np.float32]
    ratio: NDArray[np.float32]

    def distinct(self, max_ratio: float) -> NDArray[np.bool_]:
        """Return (M,) whether the nearest is near and the second nearest is not."""
        return (self.best >= 0) & (self.angle <= MAX_ANGLE) & (self.ratio < max_ratio)


def nearest(queries: Codes, codes: Codes) -> Nearest:
    """Return the nearest of N codes to each of M queries."""
    count = len(queries)
    best = np.full(count, -1, np.intp)
    first, second = np.zeros((2, count), np.int32)
    if count and len(codes):
        columns = operand(codes.values)
        step = int(np.clip(PRODUCT // len(codes), *ROWS))
        for start in range(0, count, step):
            part = slice(start, start + step)
            found = products(operand(queries.values[part]), columns)
            np.add(found, codes.shift.astype(found.dtype), out=found)
            rows = np.arange(len(found))
            best[part] = found.argmax(axis=1)
            first[part] = found[rows, best[part]]
            found[rows, best[part]] = NONE
            second[part] = found[rows, found.argmax(axis=1)]
        rest = queries.shift + LOWER**2 * queries.values.shape[1]
        first += rest
        second = np.where(second == NONE, 0, second + rest)
    angle, other = _angle(first), _angle(second)
    ratio = (angle / np.maximum(other, 1e-6)).astype(np.float32)
    return Nearest(best, angle, ratio)


def _angle(products: NDArray[np.int32]) -> NDArray[np.float32]:
    return np.arccos(np.minimum(products * NORM, 1)).astype(np.float32)
