"""What the commands do between the search and the matching: time and peak memory by command.

    python benchmarks/fusion_scale.py --sizes 1000,5000,20000

Runs the product's own functions on a project of simulated images over a grid, at the depths that
they ask for themselves: `pairs` with `hybrid`, without and with GPS, `match --rounds 3` with
GPS, `add` of 500 photos with GPS. Simulated are the two searches (rankings by distance with
noise, as deep as asked), the counts of the comparison (by distance; their number and the memory
they take are the real ones) and, in rounds, what verifies. Searching and comparing themselves are
measured by `search_scale.py` and `rerank_scale.py`. Each command runs in a process of its own.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.commands import add
from colmap_netvlad.commands.match import RoundsOptions, match
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.flight import Flight
from colmap_netvlad.matching import rounds
from colmap_netvlad.matching.options import MatchReport
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval import counts
from colmap_netvlad.retrieval.methods import deep, vlad
from colmap_netvlad.retrieval.options import RetrievalOptions

K = 30
OVERLAP = 3.0
"""Photos closer than this many grid steps overlap."""

STEP = 20.0
"""m from photo to photo."""

NEW = 500
MODEL = "simulated"
BATCH = 1000


def grid(size: int) -> NDArray[np.float64]:
    side = int(np.ceil(np.sqrt(size)))
    return np.array([(i % side, i // side) for i in range(size)], dtype=np.float64)


def make_project(folder: Path, size: int) -> Project:
    """Write a database of images with positions, and a cache with a cell of each."""
    project = Project(folder / "project.db", folder)
    names = [f"{i:06d}.jpg" for i in range(size)]
    database = pycolmap.Database.open(project.database)
    with pycolmap.DatabaseTransaction(database):
        camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", 500, 640, 480)
        camera_id = database.write_camera(camera)
        for name, (x, y) in zip(names, grid(size).tolist(), strict=True):
            image = pycolmap.Image(name, camera_id=camera_id)
            image.image_id = database.write_image(image)
            database.write_keypoints(image.image_id, np.zeros((1, 2), np.float32))
            prior = pycolmap.PosePrior()
            prior.position = np.array([STEP * x, STEP * y, 100.0])
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            prior.corr_data_id = image.data_id
            database.write_pose_prior(prior)
    database.close()
    cell = Cells(np.ones((1, 1, 1), np.int8))
    with Store(project.cache) as store:
        for first in range(0, size, BATCH):
            part = names[first : first + BATCH]
            cells = [cell] * len(part)
            store.add_descriptors(MODEL, part, part, np.ones((len(part), 1)), 0, cells)
    return project


def searched(seed: int) -> Callable[..., Ranking]:
    """Return candidates by distance with noise: near photos first, many mistakes among them."""

    def candidates(flight: Flight, options: RetrievalOptions, depth: int, *_: Any) -> Ranking:
        ground = grid(len(flight.names))
        rng = np.random.default_rng(seed)
        distance, near = cKDTree(ground).query(ground, k=depth + 1)
        scores = -distance[:, 1:] + rng.normal(0, OVERLAP, (len(ground), depth))
        order = np.argsort(-scores, axis=1)
        return Ranking(
            flight.names,
            np.take_along_axis(near[:, 1:], order, 1).astype(np.int32),
            np.take_along_axis(scores, order, 1).astype(np.float32),
            MODEL,
        )

    return candidates


def compared(
    pairs: NDArray[np.intp], ids: NDArray[np.int64], store: Store, *_: Any
) -> list[tuple[int, int, int, float]]:
    """Keep counts of pairs that fall with the distance."""
    ground = grid(len(ids))
    apart = np.linalg.norm(ground[pairs[:, 0]] - ground[pairs[:, 1]], axis=1)
    counts = np.where(apart < OVERLAP, 80 - 20 * apart, 8).astype(int)
    keys = np.sort(ids[pairs], axis=1)
    rows = list(zip(*keys.T.tolist(), counts.tolist(), [0.0] * len(keys), strict=True))
    store.add_agreements(rows)
    return rows


class Verified:
    """Matching, simulated: photos that overlap verify."""

    def __init__(self, size: int) -> None:
        self.ground = grid(size)
        self.found: dict[tuple[int, int], int] = {}

    def match(self, database: Path, pairs: Sequence[tuple[str, str]], *_: Any) -> MatchReport:
        for one, other in pairs:
            i, j = sorted((int(one[:6]), int(other[:6])))
            apart = float(np.linalg.norm(self.ground[i] - self.ground[j]))
            self.found[i, j] = 60 if apart < OVERLAP else 0
        return MatchReport(len(pairs), 0, len(pairs), len(pairs), 0.0)


def measure(command: str, size: int, folder: Path) -> str:
    """Run one command on a project of `size` images; return seconds, pairs and peak memory."""
    project = make_project(folder, size)
    deep.candidates, vlad.candidates = searched(1), searched(2)
    deep.cells_key = lambda *_: MODEL
    counts._compare = compared
    verified = Verified(size)
    rounds.match_pairs = verified.match
    rounds._Run._verified = lambda _: dict(verified.found)
    options = RetrievalOptions(k=K, gps="off" if command == "pairs" else "require")
    start, used = time.perf_counter(), time.process_time()
    if command.startswith("pairs"):
        pairs = len(make_pairs(project, "hybrid", options).pairs)
    elif command == "rounds with GPS":
        verifying = match(project, rounds=RoundsOptions(retrieval=options))
        pairs = verifying.matches.requested
    else:
        new = {f"{i:06d}.jpg" for i in range(size - NEW, size)}
        pairs = len(add._pairs_of_new(project, new, add.AddOptions(retrieval=options)))
    seconds, cpu = time.perf_counter() - start, time.process_time() - used
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return f"| {size:,} | {command} | {seconds:.1f} | {cpu:.1f} | {pairs:,} | {peak:.2f} |"


COMMANDS = ("pairs", "pairs with GPS", "rounds with GPS", f"add of {NEW} with GPS")


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default="1000,5000,20000")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=COMMANDS)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        with tempfile.TemporaryDirectory() as folder:
            print(measure(options.commands[0], int(options.sizes), Path(folder)))
        return
    print(
        "| images | command | s | CPU s | pairs | peak GiB |\n|---|---|---|---|---|---|", flush=True
    )
    for size in options.sizes.split(","):
        for command in options.commands:
            one = [sys.executable, __file__, "--one", "--sizes", size, "--commands", command]
            subprocess.run(one, check=True)


if __name__ == "__main__":
    main()
