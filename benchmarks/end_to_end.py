"""Flights of 250 to 4,000 rendered photos from photos to the adjusted model, stage by stage.

    python benchmarks/end_to_end.py --sizes 250,500,1000 --output FOLDER
    python benchmarks/end_to_end.py --sizes 2000 --output FOLDER --minutes 9    # again and again

Each stage runs in a process of its own: rendering, features, pairs (the default method), matching
(guided), mapping (parallel), and COLMAP's vocabulary tree beside it. What is measured is kept in
`FOLDER/<photos>/figures.json`, so that a run which was stopped, or ran into `--minutes`, goes on
with the same command; seconds of a stage done in several goes are added. The truth is geometry:
pairs whose photos have a fifth of their ground in common (`demo.overlap`). Seconds are of this
machine with what else runs on it; CPU seconds say more. Linux only.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pycolmap
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from watched import watch

from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.commands.match import match
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.commands.reconstruct import ReconstructOptions, reconstruct
from colmap_netvlad.demo.check import check_against_truth
from colmap_netvlad.demo.overlap import true_pairs
from colmap_netvlad.demo.render import FlightOptions, read_flight, render_flight
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.verified import correct_pairs, verified_by_name
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.metrics import mean_average_precision, recall
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.pairs.union import union_of_top
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods.bow import find_tree
from colmap_netvlad.retrieval.options import COMPARED, RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.files import write_atomically
from colmap_netvlad.terminal import Command

WIDTH, HEIGHT = 512, 384
FEATURES = 1500
K = 20
"""Small photos, few features: thousands of photos are to fit into an afternoon on two cores."""

RETRIEVAL = RetrievalOptions(k=K, gps="off")
"""Rendered positions are exact to a centimetre and would choose nearly all candidates by
themselves; what is measured is what photos show."""


def render(project: Project, photos: int) -> dict[str, Any]:
    options = FlightOptions.large(photos, WIDTH, HEIGHT)
    render_flight(project.folder, options)
    return {}


def features(project: Project, photos: int) -> dict[str, Any]:
    assert project.images is not None
    options = FeatureOptions(max_features=FEATURES)
    extract_features(project.images, project.database, options)
    with open_flight(project) as flight:
        return {"features": sum(flight.descriptors.values())}


def pairs(project: Project, photos: int) -> dict[str, Any]:
    report = make_pairs(project, options=RETRIEVAL)
    ranking = report.ranking
    return {
        "pairs": len(report.pairs),
        "describe": ranking.seconds_describe,
        "search": ranking.seconds_search,
    }


def matching(project: Project, photos: int) -> dict[str, Any]:
    report = match(project, options=MatchOptions("guided"))
    return {"verified": report.matches.verified}


def mapping(project: Project, photos: int) -> dict[str, Any]:
    options = ReconstructOptions(mapper="parallel", matching=MatchOptions("guided"))
    report = reconstruct(project, options=options)
    (project.folder / "model.txt").write_text(str(report.output))
    return {"models": len(report.models)}


def tree(project: Project, photos: int) -> dict[str, Any]:
    """Take the tree of another size where there is one: COLMAP's own comes ready-made too."""
    for made in sorted(project.folder.parent.glob("*/tree.txt")):
        (project.folder / "tree.txt").write_text(made.read_text())
        return {"tree": made.read_text()}
    with open_flight(project) as flight:
        found, note = find_tree(flight, None, 0)
    (project.folder / "tree.txt").write_text(str(found))
    return {"tree": note}


def bow(project: Project, photos: int) -> dict[str, Any]:
    words = Path((project.folder / "tree.txt").read_text())
    ranking = rank_project(project, "bow", RetrievalOptions(k=K, vocab_tree=words))
    truth = true_pairs(read_flight(project.folder))
    return {
        "describe": ranking.seconds_describe,
        "search": ranking.seconds_search,
        **retrieved(ranking, truth),
    }


def retrieval(project: Project, photos: int) -> dict[str, Any]:
    """Hold the ranking and the pairs against the truth."""
    truth = true_pairs(read_flight(project.folder))
    ranking = rank_project(project, DEFAULT, RETRIEVAL)
    chosen = read_pairs(project.pairs, ranking.names)
    return {
        **retrieved(ranking, truth),
        "true pairs": len(truth),
        "pairs recall": recall(chosen, truth),
        "pairs accuracy": len(set(chosen) & set(truth)) / len(chosen),
        "cache": project.cache.stat().st_size,
    }


def model(project: Project, photos: int) -> dict[str, Any]:
    """Hold what verified and the largest model against the truth."""
    flight = read_flight(project.folder)
    folders = Path((project.folder / "model.txt").read_text()).glob("[0-9]*")
    models = [pycolmap.Reconstruction(folder) for folder in sorted(folders)]
    largest = max(models, key=lambda model: model.num_reg_images())
    check = check_against_truth(models, flight)
    correct = correct_pairs(verified_by_name(project.database))
    return {
        "verified recall": recall(correct, true_pairs(flight)),
        "registered": check.registered,
        "off mean": check.mean,
        "off max": check.largest,
        "extent": check.extent,
        "points": largest.num_points3D(),
        "error": largest.compute_mean_reprojection_error(),
        "database": project.database.stat().st_size,
    }


def retrieved(ranking: Any, truth: list[tuple[str, str]]) -> dict[str, float]:
    candidates = [(p.name1, p.name2) for p in union_of_top(ranking, COMPARED)]
    return {
        "mAP": mean_average_precision(ranking, truth),
        "candidates recall": recall(candidates, truth),
    }


STAGES: dict[str, Callable[[Project, int], dict[str, Any]]] = {
    "render": render,
    "features": features,
    "pairs": pairs,
    "retrieval": retrieval,
    "tree": tree,
    "bow": bow,
    "matching": matching,
    "mapping": mapping,
    "model": model,
}

CHECKS = ("retrieval", "model")
"""Stages that only look at the result."""


def project_of(folder: Path) -> Project:
    return Project(folder / "project.db", folder / "images")


def run_size(photos: int, folder: Path, stages: list[str], deadline: float) -> bool:
    """Run what is not done yet of one size; return whether all is done."""
    file = folder / "figures.json"
    figures: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    for stage in stages:
        spent = figures.get(stage, {"wall": 0.0, "cpu": 0.0, "peak": 0, "done": False})
        if spent["done"]:
            continue
        left = deadline - time.monotonic()
        if left < 5:
            return False
        print(f"{photos} photos: {stage}", flush=True)
        command = [sys.executable, __file__, "--stage", stage, "--sizes", str(photos)]
        took = watch([*command, "--output", str(folder.parent)], left)
        found = folder / f"{stage}.json"
        figures[stage] = {
            "wall": spent["wall"] + took.wall,
            "cpu": spent["cpu"] + took.cpu,
            "peak": max(spent["peak"], took.peak),
            "done": took.done,
            **(json.loads(found.read_text()) if took.done else {}),
        }
        write_atomically(file, json.dumps(figures, indent=1) + "\n")
        if not took.done:
            return False
    return True


def show(output: Path) -> None:
    """Print all that was measured, and draw its growth."""
    sizes = sorted(int(f.parent.name) for f in output.glob("[0-9]*/figures.json"))
    all_figures = {n: json.loads((output / str(n) / "figures.json").read_text()) for n in sizes}
    console = Console(width=160)
    table = Table("stage", *(f"{n:,}: wall s | CPU s | CPU s a photo | peak GiB" for n in sizes))
    for stage in STAGES:
        cells = []
        for n in sizes:
            f = all_figures[n].get(stage)
            cells.append(
                f"{f['wall']:.0f} | {f['cpu']:.0f} | {f['cpu'] / n:.3f} | {f['peak'] / 2**30:.2f}"
                if f and f["done"]
                else "-"
            )
        table.add_row(stage, *cells)
    console.print(table)
    print(json.dumps(all_figures))
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for stage in STAGES:
        done = [n for n in sizes if all_figures[n].get(stage, {}).get("done")]
        if done and stage not in (*CHECKS, "tree"):  # which is made once, for all sizes
            seconds = [all_figures[n][stage]["cpu"] for n in done]
            axes.plot(done, seconds, "o-", label=stage, markersize=4)
    if sizes:
        line = np.array([sizes[0], sizes[-1]])
        axes.plot(line, line * 0.1, ":", color="grey", label="in step with the photos")
    axes.set(xscale="log", yscale="log", xlabel="photos", ylabel="CPU s")
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.minorticks_off()
    axes.legend(fontsize=8)
    figure.savefig(output / "growth.png", dpi=110)


@click.command(cls=Command)
@click.option("--sizes", default="250,500,1000", show_default=True, help="Photos, with commas.")
@click.option("--output", type=click.Path(path_type=Path), required=True)
@click.option("--minutes", type=float, default=float("inf"), help="Stop after so many minutes.")
@click.option("--stages", default=",".join(STAGES), show_default=True)
@click.option("--stage", hidden=True)
def main(sizes: str, output: Path, minutes: float, stages: str, stage: str | None) -> None:
    """Run every stage of every size, and print what was measured."""
    numbers = [int(size) for size in sizes.split(",")]
    if stage is not None:
        folder = output / str(numbers[0])
        found = STAGES[stage](project_of(folder), numbers[0])
        (folder / f"{stage}.json").write_text(json.dumps(found))
        return
    deadline = time.monotonic() + 60 * minutes
    done = [run_size(n, output / str(n), stages.split(","), deadline) for n in numbers]
    show(output)
    if not all(done):
        sys.exit(75)


if __name__ == "__main__":
    main()
