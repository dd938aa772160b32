"""Ray on one machine beside its own processes, and how many machines a driver can serve.

    python benchmarks/cluster.py stages PHOTOS [--most 40] [--k 10] [--cluster-size 15]
    python benchmarks/cluster.py growth DATABASE:PHOTOS [--photos 50 400] [--pairs 600 3000]
    python benchmarks/cluster.py driver DATABASE:PHOTOS [--images 100] [--pairs 200] [--pairs 1000]

`stages` runs each stage on this machine's processes and then as tasks of a Ray cluster that is
this machine: wall, and CPU seconds of all processes together (looked at five times a second; Linux
only). What Ray's own daemons take is in it, starting the cluster is not. Each stage is a command of
its own: connecting and starting processes is in it on both sides, where the stage starts any.
Extracting and describing do not on this machine; Ray does them once more with its processes there.

`growth` runs describing and matching as commands of their own for few and for many items, this
machine's processes and Ray in turn: what a command costs by itself, and what each item costs. CPU
seconds of the command and, for Ray, of the cluster. A database's matches are left as they are.

`driver` takes the driver's part of a task alone, for shares as large as 30 seconds of work are:
making the part of the database, handing it to Ray, taking a result from Ray, writing it. CPU
seconds of this process, whose threads carry Ray's data too. The results are real ones.
"""

from __future__ import annotations

import importlib.util
import os
import pickle
import shutil
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import (
    AbstractContextManager,
    ExitStack,
    closing,
    contextmanager,
    nullcontext,
    suppress,
)
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
import ray
from ray.cluster_utils import Cluster
from rich.console import Console
from rich.table import Table

from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.copies import FEATURES, read_rows, write_rows
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.colmap.parts import PartsOfImport, part_of_pairs, rows_of_pairs
from colmap_netvlad.colmap.results import write_results
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.viewgraph import read_view_graph
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.parallel import map_clusters
from colmap_netvlad.mapping.partition import partition
from colmap_netvlad.matching.blocks import Photos, match_block
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import in_tiles, match_pairs
from colmap_netvlad.models.catalogue import CATALOGUE, DEFAULT
from colmap_netvlad.models.checkpoint import load_model
from colmap_netvlad.photos.folders import photo_folders
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods import deep
from colmap_netvlad.retrieval.methods.deep import _describe_share
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.cluster import on_cluster
from colmap_netvlad.runtime.jobs import Enclosed
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.runtime.ray_files import Parcels
from colmap_netvlad.runtime.ray_tasks import Call, _part
from colmap_netvlad.terminal import Group

REPEATS = 3

LOCAL, RAY, WARM = "local", "Ray", "Ray, processes there"

PARTNERS = 8

LOOK_SECONDS = 0.2
TICK = os.sysconf("SC_CLK_TCK")


@dataclass
class Cost:
    """What a stage took, s: wall, and CPU of all processes."""

    wall: float
    cpu: float


class Family:
    """The CPU seconds of processes and of all that they started, those gone included.

    Args:
        heads: their numbers; default: this process.
    """

    def __init__(self, *heads: int) -> None:
        self._heads = heads or (os.getpid(),)
        self._seen: dict[int, float] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def seconds(self) -> float:
        """Return the CPU seconds until now."""
        self._look()
        return sum(self._seen.values())

    def _watch(self) -> None:
        while not self._stop.wait(LOOK_SECONDS):
            self._look()

    def _look(self) -> None:
        parents, used = {}, {}
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                fields = stat.read_text().rpartition(")")[2].split()
            except OSError:
                continue
            number = int(stat.parent.name)
            parents[number] = int(fields[1])
            used[number] = (int(fields[11]) + int(fields[12])) / TICK
        family, size = set(self._heads), 0
        while len(family) != size:
            size = len(family)
            family |= {process for process, parent in parents.items() if parent in family}
        self._seen.update({process: used[process] for process in family if process in used})


def measured(family: Family, stage: Callable[[], object]) -> Cost:
    wall, cpu = time.monotonic(), family.seconds()
    stage()
    return Cost(time.monotonic() - wall, family.seconds() - cpu)


def without_matches(source: Path, target: Path) -> Path:
    shutil.copy(source, target)
    with closing(sqlite3.connect(target)) as connection, connection:
        for name in ("matches", "two_view_geometries"):
            connection.execute(f"DELETE FROM {name}")
    return target


def describe(project: Project) -> None:
    with open_flight(project) as flight:
        deep.describe_photos(flight, RetrievalOptions(), DEFAULT)


@click.group(cls=Group)
def cli() -> None:
    """Measure Ray."""


@cli.command()
@click.argument("photos", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--most", default=40, show_default=True, help="Photos at most.")
@click.option("--k", default=10, show_default=True, help="Neighbours by name that are matched.")
@click.option("--max-features", default=8192, show_default=True)
@click.option("--cluster-size", default=15, show_default=True)
def stages(photos: Path, most: int, k: int, max_features: int, cluster_size: int) -> None:
    """Run every stage both ways and print a table."""
    load_model(DEFAULT)  # what it imports is no stage's cost
    # Processes start as the command's do: without what this script imports.
    sys.modules["__main__"].__spec__ = importlib.util.find_spec("colmap_netvlad.cli")
    family = Family()
    costs: dict[str, tuple[int, str, dict[str, Cost]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        images = folder / "images"
        images.mkdir()
        for photo in sorted(path for path in photos.rglob("*") if path.is_file())[:most]:
            shutil.copy(photo, images / photo.name)

        def run(side: str, connected: Callable[[], AbstractContextManager[None]]) -> None:
            own = folder / side
            own.mkdir()
            database = own / "project.db"
            options = FeatureOptions(max_features=max_features)

            def note(
                stage: str,
                units: int,
                unit: str,
                work: Callable[[], object],
                again: Callable[[], object] | None = None,
            ) -> None:
                with ExitStack() as stack:
                    found = {
                        side: measured(family, lambda: (stack.enter_context(connected()), work()))
                    }
                    if again is not None and side == RAY:
                        found[WARM] = measured(family, again)
                costs.setdefault(stage, (units, unit, {}))[2].update(found)
                print(f"{stage}, {units:,} {unit}s: {found}", flush=True)

            count = len(list(images.iterdir()))
            other = own / "again.db"
            note(
                "features",
                count,
                "photo",
                lambda: extract_features(images, database, options),
                lambda: extract_features(images, other, options),
            )
            names = image_names(database)
            note(
                "describe",
                count,
                "photo",
                lambda: describe(Project(database, images)),
                lambda: describe(Project(other, images)),
            )
            pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 : i + 1 + k]]
            guided = without_matches(database, own / "guided.db")
            note(
                "match, colmap",
                len(pairs),
                "pair",
                lambda: match_pairs(database, pairs, MatchOptions("colmap")),
            )
            note(
                "match, guided",
                len(pairs),
                "pair",
                lambda: match_pairs(guided, pairs, MatchOptions("guided")),
            )
            clusters = partition(read_view_graph(database), cluster_size)
            state = own / "state"
            state.mkdir()
            note(
                "map clusters", sum(len(c.images) for c in clusters), "photo",
                lambda: map_clusters(database, clusters, state, MappingOptions()),
            )  # fmt: skip

        run(LOCAL, nullcontext)
        cluster = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": usable_processors(), "include_dashboard": False},
        )
        try:
            run(RAY, lambda: on_cluster(cluster.address))
        finally:
            cluster.shutdown()
    table = Table("stage", "units", *(f"{side}: wall s, CPU s" for side in (LOCAL, RAY, WARM)))
    for stage, (units, unit, sides) in costs.items():
        cells = [shown(sides[side], sides[LOCAL]) for side in (LOCAL, RAY, WARM) if side in sides]
        table.add_row(stage, f"{units:,} {unit}s", *cells)
    Console(width=160).print(table)


DESCRIBE = """
import sys
from contextlib import nullcontext
from pathlib import Path
from colmap_netvlad import on_cluster
from colmap_netvlad.cache.photos import contents
from colmap_netvlad.cache.store import Store
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.retrieval.methods import deep
from colmap_netvlad.retrieval.options import RetrievalOptions

photos, cache, *names = sys.argv[1].split("|")
with on_cluster(sys.argv[2]) if len(sys.argv) > 2 else nullcontext(), Store(Path(cache)) as store:
    known, _ = contents(store, {name: Path(photos, name) for name in names})
    file = deep.checkpoint_file(DEFAULT)
    assert not deep._describe(store, "", file, Path(photos), names, known, RetrievalOptions())
"""
"""`pairs`, as far as to the descriptors; so that processes do not start with this script."""


def describe_command(scene: Project, count: int, folder: Path, address: str) -> list[str]:
    names = image_names(scene.database)[:count]
    listed = "|".join([str(scene.images), str(folder / "cache.db"), *names])
    return [sys.executable, "-c", DESCRIBE, listed, *([address] if address else [])]


def match_command(
    matcher: str, scene: Project, count: int, folder: Path, address: str
) -> list[str]:
    database, listed = folder / "project.db", folder / "pairs.txt"
    without_matches(scene.database, database)
    names = image_names(database)
    # The same partners for few photos and for many: what a pair takes depends on its overlap.
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 : i + 1 + PARTNERS]][:count]
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    command = ["match", "--db", database, "--pairs", listed, "--matcher", matcher]
    cluster = ["--cluster", address] if address else []
    return [sys.executable, "-m", "colmap_netvlad", *map(str, command), *cluster]


GROWING: dict[str, Callable[[Project, int, Path, str], list[str]]] = {
    "describe": describe_command,
    "guided": partial(match_command, "guided"),
    "colmap": partial(match_command, "colmap"),
}


def run_command(command: list[str], *heads: int) -> Cost:
    """Run a command; its CPU seconds and, meanwhile, those of the processes `heads`."""
    others = Family(*heads) if heads else None
    before = others.seconds() if others else 0.0
    start = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        own = Family(process.pid)
        if process.wait():
            raise click.ClickException(f"{' '.join(command)[:200]} failed.")
    wall = time.monotonic() - start
    return Cost(wall, own.seconds() + (others.seconds() - before if others else 0.0))


@contextmanager
def cluster_of_processes() -> Iterator[tuple[str, int]]:
    """Yield the address of a cluster that is this machine, and the process that holds it."""
    host, port = "127.0.0.1", 6399
    options = ["--head", "--block", f"--node-ip-address={host}", f"--port={port}"]
    options += [f"--num-cpus={usable_processors()}", "--include-dashboard=false"]
    ray_start = [str(Path(sys.executable).with_name("ray")), "start", *options]
    with subprocess.Popen(ray_start, stdout=subprocess.DEVNULL) as head:
        try:
            for _ in range(60):
                with suppress(OSError), socket.create_connection((host, port), 1.0):
                    break
                time.sleep(1.0)
            time.sleep(5.0)  # its workers
            yield f"{host}:{port}", head.pid
        finally:
            head.terminate()


@cli.command()
@click.argument("scene", metavar="DATABASE:PHOTOS")
@click.option("--photos", nargs=2, default=(50, 400), show_default=True)
@click.option("--pairs", nargs=2, default=(600, 3000), show_default=True)
@click.option("--stages", default="describe,guided,colmap", show_default=True)
@click.option("--repeats", default=2, show_default=True)
def growth(
    scene: str, photos: tuple[int, int], pairs: tuple[int, int], stages: str, repeats: int
) -> None:
    """Print what commands cost by themselves, and what each item costs, both ways."""
    database, _, folder = scene.partition(":")
    project = Project(Path(database), Path(folder))
    table = Table("stage", "items", *(f"{side}: wall s, CPU s" for side in (LOCAL, RAY)), "ratio")
    with cluster_of_processes() as (address, head):
        for stage in stages.split(","):
            sizes = photos if stage == "describe" else pairs
            cpu = dict[tuple[str, int], float]()
            for size in sizes:
                costs: dict[str, list[Cost]] = {LOCAL: [], RAY: []}
                for _ in range(repeats):
                    for side in costs:
                        with tempfile.TemporaryDirectory() as scratch:
                            where = address if side == RAY else ""
                            command = GROWING[stage](project, size, Path(scratch), where)
                            costs[side].append(run_command(command, *([head] if where else [])))
                        print(f"{stage}, {size:,}, {side}: {costs[side][-1]}", flush=True)
                cells = []
                for side, found in costs.items():
                    cpu[side, size] = sum(cost.cpu for cost in found) / repeats
                    wall = sum(cost.wall for cost in found) / repeats
                    cells.append(f"{wall:.1f}, {cpu[side, size]:.1f}")
                table.add_row(
                    stage, f"{size:,}", *cells, f"{cpu[RAY, size] / cpu[LOCAL, size]:.2f}"
                )
            few, many = sizes
            each = {side: (cpu[side, many] - cpu[side, few]) / (many - few) for side in costs}
            alone = {side: cpu[side, few] - few * each[side] for side in costs}
            table.add_row(
                "", "alone, each",
                *(f"{alone[side]:.1f} s, {1000 * each[side]:.1f} ms" for side in costs),
                f"{each[RAY] / each[LOCAL]:.2f}",
            )  # fmt: skip
    Console(width=160).print(table)


def shown(cost: Cost, local: Cost) -> str:
    """Return a cost, and the ratio of its CPU seconds to the local ones."""
    ratio = "" if cost is local else f" ({cost.cpu / local.cpu:.2f})"
    return f"{cost.wall:.1f}, {cost.cpu:.1f}{ratio}"


@cli.command()
@click.argument("scene", metavar="DATABASE:PHOTOS")
@click.option("--images", default=100, show_default=True, help="Photos at most.")
@click.option("--pairs", multiple=True, default=(200, 1000), show_default=True, help="Of a share.")
def driver(scene: str, images: int, pairs: tuple[int, ...]) -> None:
    """Print what one item of each stage costs the driver."""
    database, _, photos = scene.partition(":")
    table = Table(
        "stage", "items of a share", "MiB there", "MiB back", "driver ms an item", "items/s"
    )
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    with tempfile.TemporaryDirectory() as scratch:
        source = without_matches(Path(database), Path(scratch, "project.db"))
        names = image_names(source)[:images]
        with open_database(source) as colmap:
            ids = [row.image_id for row in colmap.images()][:images]
        unsent = Parcels[str]((), names)
        near = in_tiles([(a, b) for i, a in enumerate(ids) for b in ids[i + 1 : i + 21]])

        def row(
            stage: str,
            count: int,
            there: Callable[[], bytes],
            back: object,
            keep: Callable[[Any], None],
            parcels: Parcels[str] = unsent,
        ) -> None:
            result = ray.put(back)
            files = list(parcels.files(names))
            sent = len(there()) + sum(file.size for file in files)
            start = time.process_time()
            for _ in range(REPEATS):
                held = ray.put(there()), list(parcels.packed(files))
                keep(ray.get(result))
                del held
            each = (time.process_time() - start) / REPEATS / count
            sizes = [f"{size / 2**20:.1f}" for size in (sent, len(pickle.dumps(back)))]
            table.add_row(stage, f"{count:,}", *sizes, f"{1000 * each:.2f}", f"{1 / each:,.0f}")

        for count in pairs:
            share = near[:count]
            part = partial(_part, Call(share, partial(part_of_pairs, source)))
            report = match_block(Photos(), source, MatchOptions("guided"), share)
            row("match, guided", len(share), part, report.results, partial(write_results, source))
            row(
                "match, colmap",
                len(share),
                part,
                rows_of_pairs(source, share),
                partial(write_rows, source),
            )
        parts = PartsOfImport(source, names)
        part = partial(_part, Call(names, partial(parts.part, source)))
        features = read_rows(source, dict.fromkeys(FEATURES, ("image_id", ids)))
        sent = Parcels(photo_folders(Path(photos), None), names)
        for title, parcels in (("features", unsent), ("features, photos sent", sent)):
            row(title, len(names), part, features, partial(write_rows, source), parcels)
        described = list(
            _describe_share(
                Enclosed(CATALOGUE[DEFAULT].file()), RetrievalOptions(), Path(photos), None, names
            )
        )
        with Store(Path(scratch, "cache.db")) as store:

            def keep(batches: list[Any]) -> None:
                for batch in batches:
                    store.add_descriptors(
                        "model", batch.names, batch.names, batch.vectors, 1.0, batch.cells
                    )

            row("describe", len(names), lambda: b"", described, keep)
    Console(width=160).print(table)


if __name__ == "__main__":
    cli()
