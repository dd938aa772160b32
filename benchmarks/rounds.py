"""Rounds against one round at equal numbers of matched pairs, replayed on exhaustive matches.

    python benchmarks/rounds.py --methods hybrid,vlad SCENE.db:PHOTOS [SCENE.db:PHOTOS ...]
    python benchmarks/rounds.py --methods hybrid --unpaid SCENE.db:PHOTOS [SCENE.db:PHOTOS ...]

Each flight's database holds every pair matched, so a choice of pairs is judged without matching
anything. For each k: accuracy and recall of the union of each image's k nearest (one round, the
paper's), of 3 rounds with the same number of pairs, and the share of those pairs with which
3 rounds reach the one round's recall. With `--unpaid` instead: 3 rounds as they are, and with
pairs that the matcher `guided` gives up at a glance not counted against the budget. Databases are
only read.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy import sparse

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.graph.pair import IndexPair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.matching.blocks import Photos
from colmap_netvlad.matching.guided import Stage, match
from colmap_netvlad.matching.run import in_tiles
from colmap_netvlad.pairs.rounds import FITTED, replay
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.fusion import similarity_matrix
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
from fit_rounds import read_scene, truth_of

ROUNDS = 3
SHARES = np.arange(0.3, 1.01, 0.05)


def one_round(ranking: Ranking, k: int) -> set[IndexPair]:
    return {
        (min(i, int(j)), max(i, int(j)))
        for i, row in enumerate(ranking.partners[:, :k])
        for j in row
        if j != NO_PARTNER
    }


def correct(pairs: set[IndexPair], truth: dict[IndexPair, int]) -> int:
    return sum(truth.get(pair, 0) > CORRECT_MATCHES for pair in pairs)


def spend(
    similarity: sparse.csr_array, ranking: Ranking, truth: dict[IndexPair, int], budget: int
) -> set[IndexPair]:
    weights = FITTED[ranking.compared]
    *_, last = replay(similarity, truth, ranking.names, budget, ROUNDS, weights)
    return set(last)


def unpaid(project: Project, methods: list[str], ks: list[int], options: RetrievalOptions) -> None:
    names, truth, given_up = image_names(project.database), truth_of(project), glances(project)
    total = correct(set(truth), truth)
    print(f"\n{project.database.parent.name}: {len(given_up):,} of all pairs are given up")
    print("| method | budget | pairs | given up | recall | unpaid: pairs | given up | recall |")
    print("|---|---|---|---|---|---|---|---|")
    for method in methods:
        ranking = rank_project(project, method, replace(options, k=len(names) - 1))
        similarity, weights = similarity_matrix(ranking), FITTED[ranking.compared]
        for k in ks:
            budget, cells = len(one_round(ranking, k)), []
            for free in (set[IndexPair](), given_up):
                *_, tested = replay(similarity, truth, names, budget, ROUNDS, weights, free)
                recall = correct(set(tested), truth) / total
                cells += [f"{len(tested):,}", f"{len(given_up & tested.keys())}", f"{recall:.1%}"]
            print(f"| {method} | {budget:,} | {' | '.join(cells)} |", flush=True)


def glances(project: Project) -> set[IndexPair]:
    """Return the pairs that the matcher `guided` gives up."""
    photos = Photos()
    with open_database(project.database) as database:
        ids = [image.image_id for image in database.images()]
        pairs = in_tiles(list(combinations(range(len(ids)), 2)))
        return {
            (i, j)
            for i, j in pairs
            if match(*(photos.get(database, ids[k]).features for k in (i, j))).stage
            is Stage.GIVEN_UP
        }


def table(project: Project, methods: list[str], ks: list[int], options: RetrievalOptions) -> None:
    names, truth = image_names(project.database), truth_of(project)
    total = correct(set(truth), truth)
    print(f"\n{project.database.parent.name}: {len(names)} images, {total:,} true pairs")
    print(
        "| method | k | pairs | accuracy | recall | 3 rounds: accuracy | recall | same recall at |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for method in methods:
        ranking = rank_project(project, method, replace(options, k=len(names) - 1))
        similarity = similarity_matrix(ranking)
        for k in ks:
            chosen = one_round(ranking, k)
            hits = correct(chosen, truth)
            rounds = spend(similarity, ranking, truth, len(chosen))
            hits_of_rounds = correct(rounds, truth)
            share = next(
                (
                    f"{share:.0%}"
                    for share in SHARES
                    if correct(spend(similarity, ranking, truth, int(share * len(chosen))), truth)
                    >= hits
                ),
                "more",
            )
            print(
                f"| {method} | {k} | {len(chosen):,} | {hits / len(chosen):.1%} "
                f"| {hits / total:.1%} | {hits_of_rounds / len(rounds):.1%} "
                f"| {hits_of_rounds / total:.1%} | {share} |",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", default="hybrid,vlad")
    parser.add_argument("--k", default="5,10,20")
    parser.add_argument("--gps", help="auto, off or require")
    parser.add_argument("--unpaid", action="store_true")
    parser.add_argument("scenes", nargs="+", metavar="DATABASE:PHOTOS")
    arguments = parser.parse_args()
    options = RetrievalOptions(gps=arguments.gps)
    for scene in arguments.scenes:
        ks = [int(k) for k in arguments.k.split(",")]
        play = unpaid if arguments.unpaid else table
        play(read_scene(scene), arguments.methods.split(","), ks, options)


if __name__ == "__main__":
    main()
