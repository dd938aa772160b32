"""Nearest descriptors: best and second best of a few against many, as small exact products."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

BLOCK = 128
"""Rows of a product: with 8,192 columns of 4 bytes it stays in the processor's cache."""

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


def nearest(queries: NDArray[np.int8], codes: NDArray[np.int8]) -> Nearest:
    """Return the nearest of (N, 128) codes to each of (M, 128) queries."""
    count = len(queries)
    best = np.full(count, -1, np.intp)
    first, second = np.zeros((2, count), np.int32)
    if len(codes):
        transposed = torch.from_numpy(codes).T
        shift = _shift(codes)
        for start in range(0, count, BLOCK):
            part = slice(start, start + BLOCK)
            products = _products(torch.from_numpy(queries[part]), transposed)
            products += shift
            rows = np.arange(len(products))
            best[part] = products.argmax(axis=1)
            first[part] = products[rows, best[part]]
            products[rows, best[part]] = NONE
            second[part] = products[rows, products.argmax(axis=1)]
        rest = _shift(queries) + LOWER**2 * queries.shape[1]
        first += rest
        second = np.where(second == NONE, 0, second + rest)
    angle, other = _angle(first), _angle(second)
    return Nearest(best, angle, angle / np.maximum(other, 1e-6))


def _shift(codes: NDArray[np.int8]) -> NDArray[np.int32]:
    """Return (N,) the part of (a + `LOWER`)(b + `LOWER`) that depends on one code alone."""
    return LOWER * codes.sum(axis=1, dtype=np.int32)


def _angle(products: NDArray[np.int32]) -> NDArray[np.float32]:
    return np.arccos(np.minimum(products * NORM, 1)).astype(np.float32)


def _products(a: torch.Tensor, b: torch.Tensor) -> NDArray[np.int32]:
    """Return (M, N) the products of int8 rows and columns."""
    return torch._int_mm(a, b).numpy()
