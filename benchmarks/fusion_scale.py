"""How fusion, GPS nearness and rounds grow: time and peak memory up to 20,000 simulated images.

    python benchmarks/fusion_scale.py --sizes 1000,5000,20000

A flight is simulated as a grid; two rankings of it list each photo's nearest with noise, as deep
as `hybrid` asks for at k = 30. Each size runs in a process of its own, so that its peak memory is
its own. The search that makes such rankings from descriptors is measured by `search_scale.py`.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.pairs.rounds import next_round
from colmap_netvlad.photos.positions import Positions
from colmap_netvlad.retrieval.fusion import expand, fuse, ranking_of, similarity_matrix
from colmap_netvlad.retrieval.gps import near_first
from colmap_netvlad.retrieval.methods.hybrid import (
    DEEP_WEIGHT,
    EXPANSION_NEIGHBOURS,
    EXPANSION_SHARE,
    VLAD_WEIGHT,
)
from colmap_netvlad.retrieval.options import SEARCH_DEPTH

K = 30
OVERLAP = 3.0
"""Photos closer than this many grid steps overlap."""


def simulated(ground: NDArray[np.float64], depth: int, seed: int) -> Ranking:
    """Return a ranking by distance with noise: near photos first, many mistakes among them."""
    rng = np.random.default_rng(seed)
    distance, near = cKDTree(ground).query(ground, k=depth + 1)
    scores = -distance[:, 1:] + rng.normal(0, OVERLAP, (len(ground), depth))
    order = np.argsort(-scores, axis=1)
    return Ranking(
        tuple(f"{i:06d}.jpg" for i in range(len(ground))),
        np.take_along_axis(near[:, 1:], order, 1).astype(np.int32),
        np.take_along_axis(scores, order, 1).astype(np.float32),
        f"simulated-{seed}",
    )


def measure(size: int) -> None:
    side = int(np.ceil(np.sqrt(size)))
    ground = np.array([(i % side, i // side) for i in range(size)], dtype=np.float64)
    depth = min(SEARCH_DEPTH, size - 1)
    rankings = [simulated(ground, depth, seed) for seed in (1, 2)]
    seconds: dict[str, float] = {}

    start = time.perf_counter()
    fused = fuse(rankings, [DEEP_WEIGHT, VLAD_WEIGHT])
    seconds["fuse"] = time.perf_counter() - start

    start = time.perf_counter()
    expanded = expand(fused, EXPANSION_NEIGHBOURS, EXPANSION_SHARE, depth)
    ranking = ranking_of(expanded, rankings[0].names, "hybrid", depth)
    seconds["expand"] = time.perf_counter() - start

    start = time.perf_counter()
    positions = Positions(np.column_stack([ground, np.zeros(size)]), ())
    ranking = near_first(ranking, positions)
    seconds["GPS"] = time.perf_counter() - start

    start = time.perf_counter()
    similarity = similarity_matrix(ranking)
    first = next_round(similarity, {}, ranking.names, K * size // 3)
    seconds["round 1"] = time.perf_counter() - start

    distance = np.linalg.norm(ground[[i for i, _ in first]] - ground[[j for _, j in first]], axis=1)
    tested = {
        pair: 60 if d < OVERLAP else 0 for pair, d in zip(first, distance.tolist(), strict=True)
    }
    start = time.perf_counter()
    next_round(similarity, tested, ranking.names, K * size // 3)
    seconds["round 2"] = time.perf_counter() - start

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    cells = " | ".join(f"{value:.1f}" for value in seconds.values())
    print(f"| {size:,} | {cells} | {sum(seconds.values()):.1f} | {peak:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default="1000,2000,5000,10000,20000")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        measure(arguments.one)
        return
    print("| images | fuse s | expand s | GPS s | round 1 s | round 2 s | together s | peak GiB |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for size in arguments.sizes.split(","):
        subprocess.run([sys.executable, __file__, "--one", size], check=True)


if __name__ == "__main__":
    main()
