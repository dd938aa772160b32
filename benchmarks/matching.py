"""COLMAP's matcher beside the guided one, alternately on the same pairs, in one run.

    python benchmarks/matching.py DATABASE:PHOTOS [...] --k 20 [--most 320] [--features 4096]

Pairs are the union of each image's k nearest under the default method, or those of --pairs; with
--most, runs of neighbouring pairs spread over the flight. Blocks of pairs are matched by COLMAP
and by us in turn, each with one thread, and timed in CPU seconds, verification included. A pair
is verified with more than 15 inliers. Databases are only read.
"""

from __future__ import annotations

import sqlite3
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import click
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.matching import guided
from colmap_netvlad.matching.blocks import Photos
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import in_tiles, match_pairs
from colmap_netvlad.matching.verify import verify
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.terminal import Command

CHUNK = 160
"""Pairs that one matcher does before the other has its turn: about what COLMAP's matcher is given
at a time, which indexes every image of a chunk anew."""


@dataclass
class Figures:
    """What both matchers did on a flight; CPU seconds, and inliers by pair."""

    colmap: float = 0.0
    read: float = 0.0
    search: Counter[str] = field(default_factory=Counter)
    count: Counter[str] = field(default_factory=Counter)
    verify: float = 0.0
    inliers: dict[IdPair, int] = field(default_factory=dict)
    truth: dict[IdPair, int] = field(default_factory=dict)

    @property
    def guided(self) -> float:
        return self.read + sum(self.search.values()) + self.verify


def chosen_pairs(project: Project, listed: Path | None, k: int, scratch: Path) -> list[IdPair]:
    """Return the pairs to match in the order in which they are matched."""
    with open_database(project.database) as database:
        ids = {row.name: row.image_id for row in database.images()}
    if listed is None:
        beside = Project(project.database, project.images, scratch / "cache.db")
        report = make_pairs(beside, k=k, output=scratch / "pairs.txt")
        names = [(pair.name1, pair.name2) for pair in report.pairs]
    else:
        names = list(read_pairs(listed, tuple(ids)))
    pairs = {(min(ids[a], ids[b]), max(ids[a], ids[b])) for a, b in names}
    return in_tiles(sorted(pairs))


def spread(pairs: Sequence[IdPair], most: int | None) -> Iterator[list[IdPair]]:
    """Yield chunks of neighbouring pairs, spread over the list where they may not be all."""
    chunks = max(1, -(-len(pairs) // CHUNK))
    wanted = chunks if most is None else min(chunks, max(1, most // CHUNK))
    for at in np.linspace(0, chunks - 1, wanted).round().astype(int):
        yield list(pairs[at * CHUNK : (at + 1) * CHUNK])


def keep_largest(database: Path, features: int) -> None:
    """Leave each image its features of the largest scales."""
    with open_database(database) as colmap:
        counts = colmap.keypoint_counts()
        kept = {}
        for image_id, count in counts.items():
            if count > features:
                keypoints = colmap.keypoint_shapes(image_id)
                scale = np.abs(
                    keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4]
                )
                largest = np.sort(np.argsort(-scale, kind="stable")[:features])
                descriptors = colmap.sift_descriptors(image_id)
                kept[image_id] = keypoints[largest], descriptors[largest]
    with closing(sqlite3.connect(database)) as connection, connection:
        for image_id, tables in kept.items():
            for table, rows in zip(("keypoints", "descriptors"), tables, strict=True):
                connection.execute(
                    f"UPDATE {table} SET rows = ?, data = ? WHERE image_id = ?",
                    (features, rows.tobytes(), image_id),
                )


def match_both(database: Path, chunks: Iterator[list[IdPair]]) -> Figures:
    """Match by COLMAP into `database`, and by us in memory, with a clock at every stage."""
    figures, photos, clock = Figures(), Photos(), time.process_time
    with open_database(database) as colmap:
        names = {row.image_id: row.name for row in colmap.images()}
    for chunk in chunks:
        start = clock()
        named = [(names[a], names[b]) for a, b in chunk]
        match_pairs(database, named, MatchOptions("colmap", processes=1))
        figures.colmap += clock() - start
        with open_database(database) as colmap:
            for pair in chunk:
                start = clock()
                one, other = (photos.get(colmap, image_id) for image_id in pair)
                read = clock()
                matched = guided.match(one.features, other.features)
                searched = clock()
                places = one.features.at, other.features.at
                found = verify((one.camera, other.camera), places, matched.matches)
                figures.inliers[pair] = len(found.inlier_matches)
                figures.read += read - start
                figures.search[matched.stage.value] += searched - read
                figures.count[matched.stage.value] += 1
                figures.verify += clock() - searched
            verified = colmap.verified_matches()
            figures.truth.update({pair: verified.get(pair, 0) for pair in chunk})
        print(f"{len(figures.truth):,} pairs", flush=True)
    return figures


def rows(title: str, figures: Figures) -> list[str]:
    pairs = list(figures.truth)
    theirs = np.array([figures.truth[pair] for pair in pairs])
    ours = np.array([figures.inliers[pair] for pair in pairs])
    true, found = theirs > CORRECT_MATCHES, ours > CORRECT_MATCHES
    each = 1000 / len(pairs)
    stages = [
        f"{figures.count[stage.value]}: {figures.search[stage.value] * each:.1f}"
        for stage in guided.Stage
    ]
    return [
        title,
        f"{len(pairs):,}",
        f"{figures.colmap * each:.1f}",
        f"{figures.guided * each:.1f}",
        f"{figures.colmap / figures.guided:.1f}",
        f"{figures.read * each:.1f}",
        *stages,
        f"{figures.verify * each:.1f}",
        f"{true.sum():,}",
        f"{(true & ~found).sum()}",
        f"{(found & ~true).sum()}",
        f"{ours[true].sum() / max(theirs[true].sum(), 1):.3f}",
    ]


@click.command(cls=Command)
@click.argument("scenes", nargs=-1, required=True, metavar="DATABASE[:PHOTOS]...")
@click.option("--k", default=20, show_default=True)
@click.option("--pairs", type=click.Path(path_type=Path, exists=True), help="A list instead.")
@click.option("--most", type=int, help="Pairs of each flight at most.")
@click.option("--features", type=int, help="Features of a photo at most.  [default: all]")
def main(
    scenes: tuple[str, ...], k: int, pairs: Path | None, most: int | None, features: int | None
) -> None:
    """Match with both and print one table."""
    engine.silence()
    torch.set_num_threads(1)
    table = Table(
        "flight", "pairs", "COLMAP ms", "guided ms", "ratio", "reading",
        *(f"{stage.value}: pairs: ms" for stage in guided.Stage),
        "verifying", "verified by COLMAP", "missed", "extra", "inliers, share of COLMAP's",
    )  # fmt: skip
    for scene in scenes:
        database, _, folder = scene.partition(":")
        project = Project(Path(database), Path(folder) if folder else None)
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch, "project.db")
            copy_database(project.database, copy, matches=False)
            if features is not None:
                keep_largest(copy, features)
            asked = chosen_pairs(project, pairs, k, Path(scratch))
            figures = match_both(copy, spread(asked, most))
        table.add_row(*rows(Path(database).parent.name, figures))
    Console(width=200).print(table)
    print("Times are CPU milliseconds a pair, over all pairs.")


if __name__ == "__main__":
    main()
