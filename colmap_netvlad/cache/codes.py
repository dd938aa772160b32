"""Vectors of which the direction matters, a byte a value."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def encode(vectors: NDArray[np.floating]) -> NDArray[np.int8]:
    """Return vectors (..., D) of any length stretched to -127..127, each by its largest value."""
    largest = np.maximum(np.abs(vectors).max(axis=-1, keepdims=True), 1e-12)
    return np.round(127 * vectors / largest).astype(np.int8)


def decode(codes: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return the vectors (M, D) of codes, L2-normalised; zeros stay zeros."""
    vectors = codes.astype(np.float32)
    vectors /= lengths(vectors)[:, None]
    return vectors


def lengths(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (M,) the lengths of vectors (M, D), none quite zero, to divide by."""
    length: NDArray[np.float32] = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return np.maximum(length, np.float32(1e-12))
