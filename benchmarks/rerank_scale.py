"""Memory and time of comparing candidates place by place, on simulated local features.

    python benchmarks/rerank_scale.py --images 1000 5000

A square flight over simulated ground: a random feature for each cell, photos of 24 x 18 cells on
a grid with 75 % overlap, turned by quarter turns, with noise. Candidates are the photos nearest
by position, in a poor order: a tenth of each photo's list are photos from anywhere. Each line is
measured in a process of its own. Recall is the share of the 24 photos around each photo (those
that overlap by half or more in both directions) among its 24 best partners, before and after.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.options import COMPARED
from colmap_netvlad.retrieval.rerank import rerank

WIDTH, HEIGHT, DIM = 24, 18, 112
"""The grid and the length of features of `netvlad-o-lite`."""

NOISE = 1.0
"""Spread of what differs between two photos of a cell, beside 1 of what they share."""

STRAY = 0.1
"""Share of candidates that are from anywhere."""

RING = 24


def described(store: Store, side: int, rng: np.random.Generator) -> list[str]:
    """Describe side x side photos, each a quarter of a photo's size after the one before."""
    step_x, step_y = WIDTH // 4, HEIGHT // 4
    shape = (side * step_y + HEIGHT, side * step_x + WIDTH, DIM)
    ground = rng.standard_normal(shape, np.float32).astype(np.float16)
    names = []
    for y in range(side):
        batch, local = [], []
        for x in range(side):
            cut = ground[y * step_y : y * step_y + HEIGHT, x * step_x : x * step_x + WIDTH]
            seen = cut + NOISE * rng.standard_normal(cut.shape, np.float32)
            turned = np.rot90(seen, int(rng.integers(4)))
            batch.append(f"{y:03d}-{x:03d}.jpg")
            local.append(Cells.of(turned.transpose(2, 0, 1)))
        store.add_descriptors("m", batch, batch, np.zeros((side, 1)), 0, local)
        names += batch
    return names


def candidates(names: list[str], side: int, rng: np.random.Generator) -> Ranking:
    """Photos near each photo, the nearest not surely first, some from anywhere among them."""
    place = np.array([[i // side, i % side] for i in range(len(names))], np.float64)
    rows = []
    for i in range(len(names)):
        apart = np.linalg.norm(place - place[i], axis=1) + rng.exponential(2.0, len(names))
        apart[i] = np.inf
        near = np.argsort(apart)[:COMPARED]
        stray = rng.random(COMPARED) < STRAY
        others = np.setdiff1d(np.arange(len(names)), [*near, i])
        near[stray] = rng.choice(others, stray.sum(), replace=False)
        rows.append(near)
    partners = np.array(rows, np.int32)
    scores = np.tile(np.linspace(1, 0, COMPARED, dtype=np.float32), (len(names), 1))
    return Ranking(tuple(names), partners, scores, "simulated")


def recall(partners: NDArray[np.int32], side: int) -> float:
    """Share of each photo's ring of `RING` photos around it among its first `RING` partners."""
    found = total = 0
    for i, row in enumerate(partners[:, :RING].tolist()):
        y, x = divmod(i, side)
        for j in row:
            found += max(abs(j // side - y), abs(j % side - x)) <= 2
        rows = min(y + 2, side - 1) - max(y - 2, 0) + 1
        total += rows * (min(x + 2, side - 1) - max(x - 2, 0) + 1) - 1
    return found / total


def measure(images: int, folder: Path) -> dict[str, float]:
    """Describe, compare, and return figures and the peak memory of this process, GiB."""
    rng = np.random.default_rng(0)
    side = round(images**0.5)
    path = folder / "scale.netvlad.db"
    with Store(path) as store:
        names = described(store, side, rng)
        ranking = candidates(names, side, rng)
        start = time.perf_counter()
        compared = rerank(ranking, store, "m", RING)
        seconds = time.perf_counter() - start
        start = time.perf_counter()
        rerank(ranking, store, "m", RING)
        again = time.perf_counter() - start
        pairs = len(store.agreements()[0])
    return {
        "images": len(names),
        "pairs": pairs,
        "seconds": seconds,
        "again": again,
        "before": recall(ranking.partners, side),
        "after": recall(compared.partners, side),
        "cache": path.stat().st_size / 2**20,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, nargs="+", default=[1000, 5000])
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(measure(options.images[0], Path(folder))))
        return
    print("images     pairs  seconds  ms/pair  again, s  recall before  after  cache MiB  peak GiB")
    for images in options.images:
        command = [sys.executable, __file__, "--one", "--images", str(images)]
        output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        found = json.loads(output)
        print(
            f"{found['images']:6,} {found['pairs']:9,} {found['seconds']:8.1f} "
            f"{1000 * found['seconds'] / found['pairs']:8.2f} {found['again']:9.1f} "
            f"{found['before']:14.1%} {found['after']:6.1%} {found['cache']:10.0f} "
            f"{found['peak']:9.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
