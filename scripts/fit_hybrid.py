"""Choose VLAD's share in `hybrid` and the weight of GPS nearness on matched training flights.

    python scripts/fit_hybrid.py SCENE.db:PHOTOS [SCENE.db:PHOTOS ...]

The truth is exhaustive matching. Prints the mean average precision of every setting's candidates
(nothing is compared place by place), per flight and on the mean, the best one first. Flights
without GPS count in the first table only. Databases are only read; descriptors are kept in a
cache beside them.
"""

from __future__ import annotations

import argparse

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
from colmap_netvlad.retrieval.methods import hybrid
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project

SHARES = (0.1, 0.25, 0.5, 1.0)
NEARNESS = (1.0, 2.0, 4.0, 6.0, 8.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default=DEFAULT)
    parser.add_argument("scenes", nargs="+", metavar="DATABASE:PHOTOS")
    arguments = parser.parse_args()
    projects = [read_scene(scene) for scene in arguments.scenes]
    truths = [correct_pairs(verified_by_name(project.database)) for project in projects]
    header = " | ".join(project.database.stem for project in projects)

    print(f"| method | mean | {header} |\n|---|---|{'---|' * len(projects)}")

    def scores_of(rankings: list[Ranking]) -> list[float]:
        both = zip(rankings, truths, strict=True)
        return [100 * mean_average_precision(ranking, truth) for ranking, truth in both]

    for name in (arguments.model, "vlad"):
        _row(name, scores_of([_ranking(project, name) for project in projects]))
    results = []
    for share in SHARES:
        hybrid.VLAD_SHARE = share
        rankings = [_ranking(project, "hybrid", arguments.model) for project in projects]
        scores = scores_of(rankings)
        results.append((sum(scores) / len(scores), share, scores, rankings))
    results.sort(key=lambda result: -result[0])
    for _, share, scores, _ in results:
        _row(f"hybrid, VLAD x {share}", scores)

    best = results[0][3]
    where = zip(projects, best, truths, strict=True)
    known = [(_positions(project), ranking, truth) for project, ranking, truth in where]
    known = [entry for entry in known if entry[0].useful]
    print(f"\nGPS nearness beside the best of them, {len(known)} flights with GPS:")
    for weight in NEARNESS:
        gps.WEIGHT = weight
        scores = [100 * mean_average_precision(gps.near_first(r, p), t) for p, r, t in known]
        _row(f"weight {weight}", scores)


def _ranking(project: Project, method: str, model: str | None = None) -> Ranking:
    k = len(image_names(project.database)) - 1
    return rank_project(project, method, RetrievalOptions(k=k, gps="off", rerank=0, model=model))


def _positions(project: Project) -> Positions:
    with open_flight(project) as flight:
        return flight.positions


def _row(name: str, scores: list[float]) -> None:
    cells = " | ".join(f"{score:.1f}" for score in scores)
    print(f"| {name} | {sum(scores) / len(scores):.2f} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
