"""Memory and time of the descriptor store and the neighbour search, on simulated descriptors.

    python benchmarks/search_scale.py                      # 20,000 images, 4,096-d and 32,768-d
    python benchmarks/search_scale.py --switch             # exact against HNSW, 1,000 images on

Each line is measured in a process of its own, so that the peak memory is its own. The switch
between exact and HNSW search (`retrieval.search.EXACT_UP_TO`) is the number of images at which
the ratio of the two passes 1; recall is the share of HNSW's partners that exact search gives.
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

from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.search import nearest

BATCH = 64
GROUP = 16  # photos that see the same ground


def simulated(start: int, count: int, dim: int) -> np.ndarray:
    """Descriptors of `count` images from number `start`: groups that share half their content."""
    vectors = np.empty((count, dim), np.float32)
    for i in range(count):
        group = np.random.default_rng([(start + i) // GROUP, 0])
        own = np.random.default_rng([start + i, 1])
        vectors[i] = group.standard_normal(dim, np.float32) + own.standard_normal(dim, np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def measure(images: int, dim: int, k: int, search: str, folder: Path) -> dict[str, float]:
    """Fill a store, search it, and return seconds and the peak memory of this process, GiB."""
    names = [f"{i:06d}.jpg" for i in range(images)]
    writing = 0.0
    with Store(folder / "scale.netvlad.db") as store:
        for first in range(0, images, BATCH):
            batch = names[first : first + BATCH]
            vectors = simulated(first, len(batch), dim)
            made = time.perf_counter()
            store.add_descriptors("simulated", batch, batch, vectors, 0)
            writing += time.perf_counter() - made
        found = {"store": writing}
        partners = {}
        for name in ("exact", "hnsw") if search == "both" else (search,):
            start = time.perf_counter()
            stored = store.vectors("simulated", names)
            partners[name], _ = nearest(stored, k, exact=name == "exact")
            found[name] = time.perf_counter() - start
    if search == "both":
        same = [
            len(set(a) & set(b)) / len(a)
            for a, b in zip(partners["exact"], partners["hnsw"], strict=True)
        ]
        found["recall"] = float(np.mean(same))
    found["peak"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return found


def in_own_process(images: int, dim: int, k: int, search: str) -> dict[str, float]:
    """Run `measure` in a process of its own."""
    command = [sys.executable, __file__, "--one", search, "--images", str(images)]
    command += ["--dim", str(dim), "--k", str(k)]
    result: dict[str, float] = json.loads(
        subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    )
    return result


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=20_000)
    parser.add_argument("--dim", type=int, nargs="+", default=[4096, 32_768])
    parser.add_argument("--k", type=int, default=30)
    parser.add_argument("--switch", action="store_true", help="exact against HNSW, growing")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        with tempfile.TemporaryDirectory() as folder:
            (dim,) = options.dim
            figures = measure(options.images, dim, options.k, options.one, Path(folder))
        print(json.dumps(figures))
    elif options.switch:
        print("images     dim   exact s    HNSW s   HNSW / exact   HNSW recall")
        for dim in options.dim:
            size = 1000
            while size <= options.images:
                f = in_own_process(size, dim, options.k, "both")
                ratio = f["hnsw"] / f["exact"]
                print(
                    f"{size:6d} {dim:7d} {f['exact']:9.1f} {f['hnsw']:9.1f} {ratio:14.2f} "
                    f"{f['recall']:13.3f}",
                    flush=True,
                )
                size *= 2
    else:
        print("images     dim  search  store s  search s  peak GiB")
        for dim in options.dim:
            for search in ("exact", "hnsw"):
                f = in_own_process(options.images, dim, options.k, search)
                print(
                    f"{options.images:6d} {dim:7d}  {search:6} {f['store']:8.1f} "
                    f"{f[search]:9.1f} {f['peak']:9.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
