"""From the same features to the model: COLMAP's own way beside ours.

    python benchmarks/whole_job.py DATABASE:PHOTOS
    python benchmarks/whole_job.py --photos 500

COLMAP's way: its vocabulary tree (30 partners of each image), its matcher, incremental mapping.
Ours: `pairs` with the default method and k = 30, `reconstruct --matcher guided` with the mapper
that it chooses. Each runs in a process of its own on a copy of the database, one after the other;
`--photos` renders a flight first. The vocabulary tree is made before and costs nothing here, as
COLMAP downloads its own. Peak memory is of all processes together (proportional set size), looked
at five times a second; Linux only.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import numpy as np
import pycolmap
from mappers import centres, offsets
from rich.console import Console
from rich.table import Table
from watched import watch

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.colmap.features import extract_features
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.commands.reconstruct import ReconstructOptions, reconstruct
from colmap_netvlad.demo.render import FlightOptions, render_flight
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.verified import correct_pairs, verified_by_name
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.output import numbered
from colmap_netvlad.mapping.summary import combine
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods.bow import find_tree
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.terminal import Command

K = 30


def colmap_way(project: Project, tree: Path) -> dict[str, float]:
    """Retrieve, match and map as COLMAP's own commands do; return seconds by stage."""
    engine.silence()
    start = time.monotonic()
    pairing = pycolmap.VocabTreePairingOptions()
    pairing.num_images = K + 1  # COLMAP counts the image itself
    pairing.vocab_tree_path = tree
    pycolmap.match_vocabtree(project.database, pairing_options=pairing)
    matched = time.monotonic()
    map_incremental(project.database, project.images, project.sparse)
    return {"pairs and matching": matched - start, "mapping": time.monotonic() - matched}


def our_way(project: Project, matcher: str) -> dict[str, float]:
    """Run `pairs` and `reconstruct`; return seconds by stage."""
    start = time.monotonic()
    pairs = make_pairs(project, options=RetrievalOptions(k=K))
    seconds = {"pairs": time.monotonic() - start}
    options = ReconstructOptions(matching=MatchOptions(matcher))
    return {**seconds, **reconstruct(project, pairs, options=options).seconds}


def run_side(side: str, project: Project, tree: Path) -> dict[str, Any]:
    """Run one side in a process of its own, and return its figures."""
    arguments = [sys.executable, __file__, f"{project.database}:{project.images}"]
    took = watch([*arguments, "--side", side, "--tree", str(tree)])
    stages = json.loads((project.folder / "seconds.json").read_text())
    models = [pycolmap.Reconstruction(path) for path in numbered(project.sparse)]
    pairs = verified_by_name(project.database)
    return {
        "wall": took.wall,
        "cpu": took.cpu,
        "peak": took.peak,
        "stages": stages,
        "models": models,
        "pairs": len(pairs),
        "correct": len(correct_pairs(pairs)),
    }


def rendered(photos: int, folder: Path) -> tuple[Project, float]:
    """Render a flight of about so many photos and extract features; return the seconds of that."""
    rows = max(2, round(math.sqrt(photos / 1.25)))
    options = FlightOptions(rows=rows, columns=-(-photos // rows), width=800, height=600)
    flight = render_flight(folder / "flight", options)
    start = time.monotonic()
    extract_features(flight.images, folder / "flight" / "project.db")
    return Project(folder / "flight" / "project.db", flight.images), time.monotonic() - start


@click.command(cls=Command)
@click.argument("scene", required=False, metavar="[DATABASE:PHOTOS]")
@click.option("--photos", type=int, help="Render a flight of so many photos instead.")
@click.option("--ours", multiple=True, default=("guided",), help="Matchers of our way.")
@click.option("--side", hidden=True)
@click.option("--tree", type=click.Path(path_type=Path), help="COLMAP's vocabulary tree.")
def main(
    scene: str | None,
    photos: int | None,
    ours: tuple[str, ...],
    side: str | None,
    tree: Path | None,
) -> None:
    """Run both ways one after the other and print one table."""
    if side is not None and scene is not None and tree is not None:
        database, _, folder = scene.partition(":")
        project = Project(Path(database), Path(folder))
        way = colmap_way(project, tree) if side == "COLMAP" else our_way(project, side)
        (project.folder / "seconds.json").write_text(json.dumps(way))
        return
    table = Table(
        "way", "wall min", "CPU min", "peak GiB", "stages, min", "pairs", "correct",
        "models", "registered", "points", "error px", "centres off, % of extent: median", "max",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch:
        if scene is None:
            source, seconds = rendered(photos or 500, Path(scratch))
            print(f"Features took {seconds / 60:.1f} min, the same for both.", flush=True)
        else:
            database, _, folder = scene.partition(":")
            source = Project(Path(database), Path(folder))
        beside = Project(source.database, source.images, Path(scratch, "tree.db"))
        if tree is None:
            with open_flight(beside) as flight:
                tree, note = find_tree(flight, None, seed=0)
            print(note, flush=True)
        reference: dict[str, np.ndarray] | None = None
        for name in ("COLMAP", *ours):
            project = Project(Path(scratch, name, "project.db"), source.images)
            project.folder.mkdir()
            copy_database(source.database, project.database, matches=False)
            figures = run_side(name, project, tree)
            total, found = combine(figures["models"]), centres(figures["models"])
            reference = reference or found
            away = 100 * offsets(found, reference)
            print(name, json.dumps({**asdict(total), "seconds": figures["stages"]}), flush=True)
            table.add_row(
                name if name == "COLMAP" else f"ours, {name}",
                f"{figures['wall'] / 60:.2f}",
                f"{figures['cpu'] / 60:.2f}",
                f"{figures['peak'] / 2**30:.2f}",
                ", ".join(f"{stage} {s / 60:.2f}" for stage, s in figures["stages"].items()),
                f"{figures['pairs']:,}",
                f"{figures['correct']:,}",
                f"{len(figures['models'])}",
                f"{total.registered}",
                f"{total.points:,}",
                f"{total.mean_reprojection_error:.4f}",
                f"{np.median(away):.4f}",
                f"{away.max():.4f}",
            )
    Console(width=200).print(table)


if __name__ == "__main__":
    main()
