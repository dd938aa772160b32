"""One round, fused, in rounds: what the same number of matched pairs gives.

    python benchmarks/equal_pairs.py --k 10 SCENE.db:PHOTOS [SCENE.db:PHOTOS ...]

Each flight's database holds every pair matched. Every approach spends the same number of pairs,
that of the union of each image's k nearest under `hybrid`; matches are copied from the database
instead of made again (the same result), and a model is mapped from them. Matching minutes are
the number of pairs times the seconds of a pair, measured on a sample of the same pairs.
Databases are only read.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from colmap_netvlad.colmap.copies import copy_database, copy_with_pairs
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.graph.pair import IndexPair, as_pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES, correct_pairs, verified_by_name
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.summary import combine
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.metrics import mean_average_precision
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.pairs.rounds import FITTED, find_candidates, replay, take_turns
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.fusion import similarity_matrix
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
from fit_rounds import read_scene, truth_of

ROUNDS = 3
SAMPLE = 60
"""Pairs matched anew to measure the seconds of one."""

APPROACHES = (
    ("BoW, one round", "bow", "off", 1),
    ("VLAD, one round", "vlad", "off", 1),
    (f"{DEFAULT}, one round", DEFAULT, "off", 1),
    ("hybrid without GPS, one round", "hybrid", "off", 1),
    (f"hybrid without GPS, {ROUNDS} rounds", "hybrid", "off", ROUNDS),
    ("hybrid, one round", "hybrid", "auto", 1),
    (f"hybrid, {ROUNDS} rounds", "hybrid", "auto", ROUNDS),
)


def seconds_of_a_pair(project: Project, pairs: list[tuple[str, str]]) -> float:
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "sample.db")
        copy_database(project.database, copy, matches=False)
        sample = pairs[:: max(1, len(pairs) // SAMPLE)]
        return match_pairs(copy, sample).seconds / len(sample)


def model_row(project: Project, pairs: list[tuple[str, str]]) -> tuple[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "pairs.db")
        copy_with_pairs(project.database, copy, {as_pair(*pair) for pair in pairs})
        start = time.monotonic()
        models = map_incremental(copy, None, Path(folder, "sparse"), MappingOptions())
        seconds = time.monotonic() - start
        if not models:
            return "0 | 0 | - | 0", seconds
        total = combine(models)
        return (
            f"{total.registered} | {total.points:,} | {total.mean_reprojection_error:.3f} "
            f"| {len(models)}",
            seconds,
        )


def measure(project: Project, k: int, vocab_tree: Path | None) -> None:
    names, truth = image_names(project.database), truth_of(project)
    total = sum(count > CORRECT_MATCHES for count in truth.values())
    correct_names = correct_pairs(verified_by_name(project.database))
    options = RetrievalOptions(k=len(names) - 1, vocab_tree=vocab_tree)
    rankings = {
        (method, gps): rank_project(project, method, replace(options, gps=gps))
        for _, method, gps, _ in APPROACHES
    }
    hybrid = rankings["hybrid", "auto"]
    budget = len(
        {
            (min(i, j), max(i, j))
            for i, row in enumerate(hybrid.partners[:, :k].tolist())
            for j in row
        }
    )
    per_pair: float | None = None
    print(f"\n{project.database.stem}: {len(names)} images, {total:,} true pairs, k = {k}")
    print(
        "| approach | mAP | pairs | accuracy | recall | registered | points | error px | models "
        "| matching min | mapping min |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for title, method, gps, rounds in APPROACHES:
        similarity = similarity_matrix(rankings[method, gps])
        precision = "-"
        if rounds == 1:
            precision = f"{mean_average_precision(rankings[method, gps], correct_names):.1%}"
            left = find_candidates(similarity, {})
            chosen: list[IndexPair] = take_turns(
                left.first, left.second, left.evidence[:, 0], names, budget
            )
        else:
            weights = FITTED[rankings[method, gps].compared]
            *_, tested = replay(similarity, truth, names, budget, rounds, weights)
            chosen = list(tested)
        correct = sum(truth.get(pair, 0) > CORRECT_MATCHES for pair in chosen)
        pairs = [(names[i], names[j]) for i, j in chosen]
        per_pair = per_pair or seconds_of_a_pair(project, pairs)
        figures, seconds = model_row(project, pairs)
        print(
            f"| {title} | {precision} | {len(pairs):,} "
            f"| {correct / len(pairs):.1%} | {correct / total:.1%} "
            f"| {figures} | {per_pair * len(pairs) / 60:.1f} | {seconds / 60:.1f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--k", type=int, default=10)
    parser.add_argument("--vocab-tree", type=Path, help="the flight's tree, to save building it")
    parser.add_argument("scenes", nargs="+", metavar="DATABASE:PHOTOS")
    arguments = parser.parse_args()
    for scene in arguments.scenes:
        measure(read_scene(scene), arguments.k, arguments.vocab_tree)


if __name__ == "__main__":
    main()
