"""Choose the weights of `hybrid` and of GPS nearness on exhaustively matched training flights.

    python scripts/fit_hybrid.py SCENE.db:PHOTOS [SCENE.db:PHOTOS ...]

Prints the mean average precision of every combination's candidates (nothing is compared place by
place), per flight and on the mean, the best one first. Flights without GPS count in the first table
only. Databases are only read; descriptors are kept in a cache beside them.
"""

from __future__ import annotations

import argparse
from itertools import product

from fit_rounds import read_scene

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.verified import correct_pairs, verified_by_name
from colmap_netvlad.metrics import mean_average_precision
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.photos.positions import Positions
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval import gps
from colmap_netvlad.retrieval.fusion import expand, fuse, ranking_of
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project

DEEP = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0)
NEIGHBOURS = (5, 8, 12)
SHARES = (0.3, 0.5)
NEARNESS = (1.0, 2.0, 4.0, 6.0, 8.0)


def fused(rankings: list[Ranking], deep: float, neighbours: int, share: float) -> Ranking:
    names = rankings[0].names
    similarity = expand(fuse(rankings, [deep, 1.0]), neighbours, share, len(names))
    return ranking_of(similarity, names, "hybrid", len(names) - 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default=DEFAULT)
    parser.add_argument("scenes", nargs="+", metavar="DATABASE:PHOTOS")
    arguments = parser.parse_args()
    projects = [read_scene(scene) for scene in arguments.scenes]
    truths = [correct_pairs(verified_by_name(project.database)) for project in projects]
    rankings = [_both(project, arguments.model) for project in projects]
    header = " | ".join(project.database.stem for project in projects)

    print(f"| method | mean | {header} |\n|---|---|{'---|' * len(projects)}")
    for place, name in enumerate(("deep", "vlad")):
        _row(
            name,
            [
                100 * mean_average_precision(r[place], t)
                for r, t in zip(rankings, truths, strict=True)
            ],
        )
    results = []
    for setting in product(DEEP, NEIGHBOURS, SHARES):
        scores = [
            100 * mean_average_precision(fused(both, *setting), truth)
            for both, truth in zip(rankings, truths, strict=True)
        ]
        results.append((sum(scores) / len(scores), setting, scores))
    results.sort(reverse=True)
    for _, setting, scores in results[:8]:
        _row("deep {} x, {} neighbours, share {}".format(*setting), scores)

    best = results[0][1]
    where = [(p, both, t) for p, both, t in zip(projects, rankings, truths, strict=True)]
    known = [(_positions(p), fused(both, *best), t) for p, both, t in where]
    known = [entry for entry in known if entry[0].useful]
    print(f"\nGPS nearness beside the best of them, {len(known)} flights with GPS:")
    for weight in NEARNESS:
        gps.WEIGHT = weight
        scores = [100 * mean_average_precision(gps.near_first(r, p), t) for p, r, t in known]
        _row(f"weight {weight}", scores)


def _both(project: Project, model: str) -> list[Ranking]:
    options = RetrievalOptions(k=len(image_names(project.database)) - 1, gps="off", rerank=0)
    return [rank_project(project, model, options), rank_project(project, "vlad", options)]


def _positions(project: Project) -> Positions:
    with open_flight(project) as flight:
        return flight.positions


def _row(name: str, scores: list[float]) -> None:
    cells = " | ".join(f"{score:.1f}" for score in scores)
    print(f"| {name} | {sum(scores) / len(scores):.2f} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
