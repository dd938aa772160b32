"""Fit the weights of `colmap_netvlad.pairs.rounds` on exhaustively matched training flights.

    python scripts/fit_rounds.py --method hybrid SCENE.db:PHOTOS [SCENE.db:PHOTOS ...]

Rounds are replayed on each flight with several budgets; every untested candidate after a round
is an example, labelled by whether the pair verifies. Each flight weighs the same. Prints the
`FITTED` of `colmap_netvlad/pairs/rounds.py`. Databases are only read; descriptors are kept in a
cache beside them.
"""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.graph.pair import IndexPair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.pairs.rounds import FITTED, Weights, find_candidates, replay
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.fusion import similarity_matrix
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project

BUDGETS = (2, 4, 6, 10)
"""Pairs for each image."""

ROUNDS = (2, 3)


def read_scene(argument: str) -> Project:
    database, _, photos = argument.partition(":")
    return Project(Path(database), Path(photos))


def truth_of(project: Project) -> dict[IndexPair, int]:
    """Return the verified matches of every pair, by positions in the database's image order."""
    with open_database(project.database) as database:
        place = {image.image_id: i for i, image in enumerate(database.images())}
        found = database.verified_matches()
    return {
        (min(place[a], place[b]), max(place[a], place[b])): count for (a, b), count in found.items()
    }


def examples(
    project: Project, method: str, options: RetrievalOptions
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    names = image_names(project.database)
    ranking = rank_project(project, method, replace(options, k=20))
    similarity, truth = similarity_matrix(ranking), truth_of(project)
    weights = FITTED[ranking.compared]
    evidence, labels = [], []
    for budget in BUDGETS:
        for rounds in ROUNDS:
            played = replay(similarity, truth, names, budget * len(names), rounds, weights)
            for tested in list(played)[:-1]:
                left = find_candidates(similarity, tested)
                evidence.append(left.evidence)
                pairs = zip(left.first.tolist(), left.second.tolist(), strict=True)
                labels.append([truth.get(pair, 0) > CORRECT_MATCHES for pair in pairs])
    return np.concatenate(evidence), np.concatenate(labels).astype(bool)


def fit(scenes: list[tuple[NDArray[np.float64], NDArray[np.bool_]]]) -> Weights:
    evidence = np.concatenate([x for x, _ in scenes])
    labels = np.concatenate([y for _, y in scenes])
    weight = np.concatenate(
        [np.full(len(y), len(labels) / len(scenes) / len(y)) for _, y in scenes]
    )
    mean, spread = evidence.mean(axis=0), evidence.std(axis=0)
    model = LogisticRegression(max_iter=1000)
    model.fit((evidence - mean) / spread, labels, sample_weight=weight)
    slopes = model.coef_[0] / spread
    intercept = float(model.intercept_[0] - slopes @ mean)
    return Weights(*(float(s) for s in slopes), intercept)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="hybrid")
    parser.add_argument("--model", help="deep model of hybrid")
    parser.add_argument("--gps", help="auto, off or require")
    parser.add_argument("scenes", nargs="+", metavar="DATABASE:PHOTOS")
    arguments = parser.parse_args()
    options = RetrievalOptions(model=arguments.model, gps=arguments.gps)
    projects = [read_scene(scene) for scene in arguments.scenes]
    data = []
    for project in projects:
        data.append(examples(project, arguments.method, options))
        evidence, labels = data[-1]
        name = project.database.parent.name
        print(f"{name}: {len(evidence):,} examples, {labels.mean():.0%} verify")
    weights = fit(data)
    print("Weights(")
    for field in fields(Weights):
        print(f"    {field.name}={getattr(weights, field.name):.3g},")
    print(")")


if __name__ == "__main__":
    main()
