"""Memory and time of the descriptor store and the neighbour search, on simulated descriptors.

    python benchmarks/search_scale.py                      # 20,000 images, 4,096-d and 32,768-d
    python benchmarks/search_scale.py --switch             # exact against HNSW, 1,000 images on
    python benchmarks/search_scale.py --like PROJECT.netvlad.db --images 20000 --exact
    python benchmarks/search_scale.py --like PROJECT.netvlad.db --images 100000

Each line is measured in a process of its own, so that the peak memory is its own. Recall is the
share of exact search's partners that the other search gives; with `--like`, where that is the
reduced search, of the first 100 partners of 1,000 images spread over all.

`--like` simulates from the default model's descriptors of real photos in a cache, in folders by
flight: a flight of up to six photos for each real one, all turned by one rotation of the network's
features (a ground that is not the real one, but as rich), each photo a blend of a real one and a
near one, and the difference of two real neighbours added, so that a photo's 1st, 10th and 50th
neighbour are as near as in the real flights.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from colmap_netvlad.cache.store import Store
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.retrieval.methods.deep import checkpoint_file, model_fingerprint
from colmap_netvlad.retrieval.search import _reduced, nearest

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


FEATURE = 112
"""Values of the network's features behind `netvlad-o-lite`."""

PHOTOS_OF_ONE = 6
RESIDUAL = 0.8
LOOKED_AT = 100
ASKED = 1000


def alike(cache: Path, count: int) -> Iterator[np.ndarray]:
    """Yield (n, D) descriptors of simulated flights, `count` in all; see the top of this file."""
    with Store(cache) as store:
        model = model_fingerprint(checkpoint_file(DEFAULT))
        names = sorted(store.described(model))
        real = np.asarray(store.vectors(model, names)[:], np.float32)
    flight = np.array([name.partition("/")[0] for name in names])
    cosines = real @ real.T
    cosines[flight[:, None] != flight] = -1
    np.fill_diagonal(cosines, -1)
    near = np.argsort(-cosines, axis=1)[:, :3]
    rng, made = np.random.default_rng(0), 0
    while made < count:
        for one in rng.permutation(np.unique(flight)):
            own = np.flatnonzero(flight == one)
            n = min(PHOTOS_OF_ONE * len(own), count - made)
            tilt = np.eye(FEATURE) + rng.uniform(0.05, 0.25) * rng.standard_normal((FEATURE,) * 2)
            turn, upper = np.linalg.qr(tilt)
            turn = (turn * np.sign(np.diag(upper))).astype(np.float32)
            photo, other = rng.choice(own, n), rng.integers(len(real), size=n)
            beside = near[photo, rng.integers(3, size=n)]
            share = rng.uniform(0, 0.5, (n, 1)).astype(np.float32)
            vectors = (1 - share) * real[photo] + share * real[beside]
            difference = real[other] - real[near[other, rng.integers(3, size=n)]]
            vectors += np.float32(RESIDUAL) * difference
            vectors = (vectors.reshape(n, -1, FEATURE) @ turn).reshape(n, -1)
            yield vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
            made += n
            if made == count:
                return


def measure_reduced(
    images: int, cache: Path, k: int, exact: bool, folder: Path
) -> dict[str, float]:
    """Search simulated flights by reduced descriptors; and exactly, all or `ASKED` of them."""
    names = [f"{i:06d}.jpg" for i in range(images)]
    with Store(folder / "scale.netvlad.db") as store:
        first = 0
        for vectors in alike(cache, images):
            part = names[first : first + len(vectors)]
            store.add_descriptors("simulated", part, part, vectors, 0)
            first += len(vectors)
        stored = store.vectors("simulated", names)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        start, used = time.perf_counter(), time.process_time()
        partners, _ = _reduced(stored, k)
        found = {"reduced": time.perf_counter() - start, "reduced CPU": time.process_time() - used}
        found["peak before"] = before
        found["peak"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        asked = np.unique(np.linspace(0, images - 1, ASKED).astype(int))
        start, used = time.perf_counter(), time.process_time()
        if exact:
            true = nearest(stored, k, exact=True)[0][asked, :LOOKED_AT]
        else:
            queries = np.concatenate([stored[i : i + 1] for i in asked]).astype(np.float32)
            cosines = [
                queries @ stored[i : i + 1000].astype(np.float32).T for i in range(0, images, 1000)
            ]
            scores = np.hstack(cosines)
            scores[np.arange(len(asked)), asked] = -1
            true = np.argpartition(-scores, LOOKED_AT, axis=1)[:, :LOOKED_AT]
        found["exact"] = time.perf_counter() - start
        found["exact CPU"] = time.process_time() - used
        found["asked"] = images if exact else len(asked)
    rows = zip(true.tolist(), partners[asked, :LOOKED_AT].tolist(), strict=True)
    found["recall"] = float(np.mean([len({*a} & {*b}) / LOOKED_AT for a, b in rows]))
    return found


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
    parser.add_argument("--like", type=Path, help="cache of real photos: measures reduced search")
    parser.add_argument("--exact", action="store_true", help="with --like: all images exactly too")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.like:
        with tempfile.TemporaryDirectory() as folder:
            asked = options.images, options.like, options.k, options.exact, Path(folder)
            print(json.dumps(measure_reduced(*asked), indent=1))
    elif options.one:
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
