"""Ray on one machine beside its own processes, stage by stage, and how much a driver can serve.

    python benchmarks/cluster.py PHOTOS [--most 40] [--k 10] [--max-features 8192]

Each stage runs on this machine's processes and as tasks of a Ray cluster that is this machine, in
turn, on copies of the same database: wall, and CPU seconds of all processes together (looked at
five times a second; Linux only). What Ray's own daemons take is in it, starting the cluster is not.

The driver's limit is its own CPU time on the cluster: units (photos, pairs) a second that one
processor's driver can send and take back. Processors at work per unit over the driver's tell how
many processors it keeps busy.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import click
from ray.cluster_utils import Cluster
from rich.console import Console
from rich.table import Table

from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.viewgraph import read_view_graph
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.parallel import map_clusters
from colmap_netvlad.mapping.partition import partition
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.models.checkpoint import load_model
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods import deep
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.cluster import on_cluster
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.terminal import Command

LOOK_SECONDS = 0.2
TICK = os.sysconf("SC_CLK_TCK")


@dataclass
class Cost:
    """What a stage took, s: wall, CPU of all processes, and of this one alone."""

    wall: float
    cpu: float
    driver: float


class Family:
    """The CPU seconds of this process and of all that it started, those gone included."""

    def __init__(self) -> None:
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
        family, size = {os.getpid()}, 0
        while len(family) != size:
            size = len(family)
            family |= {process for process, parent in parents.items() if parent in family}
        self._seen.update({process: used[process] for process in family if process in used})


def measured(family: Family, stage: Callable[[], object]) -> Cost:
    wall, cpu, driver = time.monotonic(), family.seconds(), time.process_time()
    stage()
    return Cost(time.monotonic() - wall, family.seconds() - cpu, time.process_time() - driver)


def without_matches(source: Path, target: Path) -> Path:
    shutil.copy(source, target)
    with closing(sqlite3.connect(target)) as connection, connection:
        for name in ("matches", "two_view_geometries"):
            connection.execute(f"DELETE FROM {name}")
    return target


def describe(project: Project) -> None:
    with open_flight(project) as flight:
        deep.describe_photos(flight, RetrievalOptions(), DEFAULT)


@click.command(cls=Command)
@click.argument("photos", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--most", default=40, show_default=True, help="Photos at most.")
@click.option("--k", default=10, show_default=True, help="Neighbours by name that are matched.")
@click.option("--max-features", default=8192, show_default=True)
@click.option("--cluster-size", default=15, show_default=True)
def main(photos: Path, most: int, k: int, max_features: int, cluster_size: int) -> None:
    """Run every stage both ways and print two tables."""
    load_model(DEFAULT)  # what it imports is no stage's cost
    family = Family()
    costs: dict[str, tuple[int, str, dict[str, Cost]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        images = folder / "images"
        images.mkdir()
        for photo in sorted(path for path in photos.rglob("*") if path.is_file())[:most]:
            shutil.copy(photo, images / photo.name)

        def run(side: str) -> None:
            own = folder / side
            own.mkdir()
            database = own / "project.db"
            options = FeatureOptions(max_features=max_features)

            def note(stage: str, units: int, unit: str, work: Callable[[], object]) -> None:
                cost = measured(family, work)
                costs.setdefault(stage, (units, unit, {}))[2][side] = cost
                print(f"{side:7} {stage:20} {cost.wall:7.1f} s, CPU {cost.cpu:7.1f}", flush=True)

            count = len(list(images.iterdir()))
            note("features", count, "photo", lambda: extract_features(images, database, options))
            names = image_names(database)
            note("describe", count, "photo", lambda: describe(Project(database, images)))
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

        run("local")
        cluster = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": usable_processors(), "include_dashboard": False},
        )
        try:
            with on_cluster(cluster.address):
                run("Ray")
        finally:
            cluster.shutdown()
    overhead = Table(
        "stage", "units", "local wall s", "Ray wall s", "ratio", "local CPU s", "Ray CPU s", "ratio"
    )
    limit = Table(
        "stage", "driver ms a unit", "units a second", "work ms a unit", "processors kept busy"
    )
    total: dict[str, Cost] = {side: Cost(0, 0, 0) for side in ("local", "Ray")}
    for stage, (units, unit, sides) in costs.items():
        for side, cost in sides.items():
            total[side].wall += cost.wall
            total[side].cpu += cost.cpu
        overhead.add_row(stage, f"{units:,} {unit}s", *ratio(sides))
        driver = sides["Ray"].driver / units
        work = (sides["Ray"].cpu - sides["Ray"].driver) / units
        limit.add_row(
            stage, f"{1000 * driver:.2f}", f"{1 / driver:,.0f} {unit}s", f"{1000 * work:.0f}",
            f"{work / driver:,.0f}",
        )  # fmt: skip
    overhead.add_row("all", "", *ratio(total))
    console = Console(width=160)
    console.print(overhead)
    console.print(limit)


def ratio(sides: dict[str, Cost]) -> list[str]:
    local, ray = sides["local"], sides["Ray"]
    return [
        f"{local.wall:.1f}", f"{ray.wall:.1f}", f"{ray.wall / local.wall:.2f}",
        f"{local.cpu:.1f}", f"{ray.cpu:.1f}", f"{ray.cpu / local.cpu:.2f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
