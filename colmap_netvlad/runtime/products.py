"""Products of bytes: ten times as fast as those of floats where the processor has instructions
for them, and exact, so that every machine finds the same.

Products of a few hundred bytes are whole numbers below 2^24, which float32 holds too: whichever of
the two the processor multiplies faster, the result is the same bit for bit.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    import torch  # loaded when something is multiplied, not with everything that might

TRIED = (128, 2048)
"""Rows and columns of the product that tells whether bytes or floats are faster."""


def operand(codes: NDArray[np.int8]) -> torch.Tensor:
    """Return (N, D) bytes as this machine multiplies them faster, for `products`."""
    import torch

    return torch.from_numpy(codes).to(bytes_or_floats())


def products(rows: torch.Tensor, columns: torch.Tensor) -> NDArray[np.int32] | NDArray[np.float32]:
    """Return (M, N) the products of (M, D) and (N, D) operands, of bytes as int32."""
    import torch

    if rows.dtype == torch.int8:
        return torch._int_mm(rows, columns.T).numpy()
    return (rows @ columns.T).numpy()


@cache
def bytes_or_floats() -> torch.dtype:
    """Return what this machine multiplies faster: `torch.int8` or `torch.float32`.

    Processors with instructions for products of bytes (AVX512-VNNI, AVX-VNNI, AMX) do these
    faster; others, and some builds of torch, much slower, or have no such product.
    """
    import torch

    if not hasattr(torch, "_int_mm"):
        return torch.float32
    # In one thread: where others work, threads wait for each other, and chance decides.
    with one_thread():
        return min((torch.int8, torch.float32), key=_seconds)


def _seconds(kind: torch.dtype) -> float:
    """Return the shortest time of a few products; infinite where they cannot be made."""
    import torch

    rows, columns = TRIED
    codes = (torch.arange(columns * 128) % 251 - 125).reshape(columns, 128).to(kind)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        try:
            products(codes[:rows], codes)
        except (RuntimeError, NotImplementedError):
            return float("inf")
        times.append(time.perf_counter() - start)
    return min(times)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let products run in the thread that asks for them."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def threads_of_their_own(count: int) -> Iterator[ThreadPoolExecutor]:
    """Give threads each of which multiplies alone: many small products, too little to share."""
    import torch

    # OpenMP counts its threads for each thread that calls it.
    alone = partial(torch.set_num_threads, 1)
    with one_thread(), ThreadPoolExecutor(count, initializer=alone) as pool:
        yield pool
