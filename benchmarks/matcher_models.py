"""Models from the same pairs by both matchers, and what is wrong with the pairs of each.

    python benchmarks/matcher_models.py DATABASE:PHOTOS [...] --k 20

Pairs are the union of each image's k nearest under the default method. COLMAP's matcher and the
guided one match them, each into a copy of the database, one thread each; COLMAP's incremental
mapper makes a model of both, and a second one of COLMAP's matches with another seed: what differs
between those two is chance. Models are compared with COLMAP's after a similarity alignment. Points
of both models that join the same features tell whether the ones we share have become less exact.

A verified pair (more than 15 inliers) is wrong where COLMAP's model has both images and the
inliers lie in the median further from their epipolar lines than 6 px, or than 4 times what pairs
of more than 100 inliers do. Pairs with an image that the model lacks are not judged. Databases are
only read.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import pycolmap
from mappers import centres, cpu_seconds, offsets
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.terminal import Command

STRONG = 100
LIMIT = 6.0
TIMES = 4.0
"""Wrong is a pair whose median error exceeds both `LIMIT` px and so many times that of pairs with
more than `STRONG` inliers."""

IdPair = tuple[int, int]


@dataclass(frozen=True)
class Outcome:
    """What a matcher's matches came to."""

    name: str
    seconds: float
    inliers: dict[IdPair, NDArray[np.uint32]]
    model: pycolmap.Reconstruction

    @property
    def errors(self) -> NDArray[np.float64]:
        return np.array([point.error for point in self.model.points3D.values()])

    def verified(self) -> set[IdPair]:
        return {pair for pair, rows in self.inliers.items() if len(rows) > CORRECT_MATCHES}

    def tracks(self) -> dict[frozenset[IdPair], float]:
        """Return the error of each point by the features that it joins."""
        return {
            frozenset((part.image_id, part.point2D_idx) for part in point.track.elements): (
                point.error
            )
            for point in self.model.points3D.values()
        }


def inliers_of(database: Path) -> dict[IdPair, NDArray[np.uint32]]:
    with pycolmap.Database.open(database) as colmap:
        ids, geometries = colmap.read_two_view_geometries()
    pairs = [pycolmap.pair_id_to_image_pair(number) for number in ids]
    return {pair: geometry.inlier_matches for pair, geometry in zip(pairs, geometries, strict=True)}


def outcome(
    name: str, matched: Path, folder: Path, seconds: float, photos: Path | None, seed: int = 0
) -> Outcome:
    models = map_incremental(matched, photos, folder, MappingOptions(seed=seed, threads=1))
    if not models:
        raise SystemExit(f"{name}: no model.")
    largest = max(models, key=lambda model: model.num_reg_images())
    return Outcome(name, seconds, inliers_of(matched), largest)


def outcomes(project: Project, k: int, scratch: Path, chance: bool) -> list[Outcome]:
    """Match with both, and map what each found; with `chance`, COLMAP's matches twice."""
    beside = Project(project.database, project.images, scratch / "cache.db")
    made = make_pairs(beside, k=k, output=scratch / "pairs.txt")
    names = tuple(image_names(project.database))
    listed = read_pairs(made.output, names)
    found = []
    for name in ("colmap", "guided"):
        folder = scratch / name
        folder.mkdir()
        matched = folder / "project.db"
        copy_database(project.database, matched, matches=False)
        start = cpu_seconds()
        match_pairs(matched, listed, MatchOptions(name, processes=1))
        seconds = cpu_seconds() - start
        found.append(outcome(name, matched, folder / "sparse", seconds, None))
        if chance and name == "colmap":
            again = outcome("colmap, seed 1", matched, folder / "again", seconds, None, seed=1)
            found.append(again)
    return found


class Judge:
    """Tells wrong pairs by a model."""

    def __init__(self, truth: Outcome, keypoints: dict[int, NDArray[np.float64]]) -> None:
        self._model, self._keypoints = truth.model, keypoints
        strong = [rows for rows in truth.inliers.items() if len(rows[1]) > STRONG]
        errors = [error for error in (self.error(*pair) for pair in strong) if error is not None]
        self._limit = max(LIMIT, TIMES * float(np.median(errors)) if errors else 0.0)

    def error(self, pair: IdPair, matches: NDArray[np.uint32]) -> float | None:
        """Return the median distance of matches from their epipolar lines, px; the larger one of
        both images. None where the model lacks one."""
        if any(not self._model.exists_image(image_id) for image_id in pair):
            return None
        images = [self._model.image(image_id) for image_id in pair]
        if not all(image.has_pose for image in images):
            return None
        cameras = [self._model.cameras[image.camera_id] for image in images]
        rays = []
        for side, (camera, image_id) in enumerate(zip(cameras, pair, strict=True)):
            at = self._keypoints[image_id][matches[:, side]]
            rays.append(np.column_stack([camera.cam_from_img(at), np.ones(len(at))]))
        moved = images[1].cam_from_world() * images[0].cam_from_world().inverse()
        x, y, z = moved.translation
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ moved.rotation.matrix()
        lines = rays[1] @ essential, rays[0] @ essential.T
        off = np.abs((rays[1] * lines[1]).sum(axis=1))
        away = [
            off / np.hypot(line[:, 0], line[:, 1]) * camera.mean_focal_length()
            for line, camera in zip(lines, cameras, strict=True)
        ]
        return float(np.median(np.maximum(*away)))

    def count(self, found: Outcome, pairs: set[IdPair]) -> str:
        """Return how many pairs are wrong, of how many that can be judged."""
        errors = [self.error(pair, found.inliers[pair]) for pair in sorted(pairs)]
        judged = [error for error in errors if error is not None]
        return f"{sum(error > self._limit for error in judged)} of {len(judged)}"


def keypoints_of(database: Path) -> dict[int, NDArray[np.float64]]:
    with pycolmap.Database.open(database) as colmap:
        return {
            image.image_id: colmap.read_keypoints(image.image_id)[:, :2].astype(float)
            for image in colmap.read_all_images()
        }


def rows(scene: str, found: Sequence[Outcome], judge: Judge) -> list[list[str]]:
    truth = found[0]
    theirs, reference, shared = truth.verified(), centres([truth.model]), truth.tracks()
    table = []
    for each in found:
        ours, away = each.verified(), 100 * offsets(centres([each.model]), reference)
        both = [(error, shared[key]) for key, error in each.tracks().items() if key in shared]
        counts = [sum(len(one.inliers.get(pair, ())) for pair in theirs) for one in (each, truth)]
        table.append(
            [
                scene,
                each.name,
                f"{each.seconds:.0f}",
                f"{len(ours)} ({judge.count(each, ours)})",
                f"{len(theirs - ours)}",
                f"{len(ours - theirs)} ({judge.count(each, ours - theirs)})",
                f"{counts[0] / counts[1]:.3f}",
                f"{each.model.num_reg_images()}",
                f"{each.model.num_points3D():,}",
                f"{each.errors.mean():.4f}",
                f"{each.errors.mean() / truth.errors.mean():.3f}",
                f"{len(both):,}: {np.mean([pair[0] for pair in both]):.4f},"
                f" {np.mean([pair[1] for pair in both]):.4f}",
                f"{np.median(away):.3f}",
                f"{away.max():.3f}",
            ]
        )
    return table


@click.command(cls=Command)
@click.argument("scenes", nargs=-1, required=True, metavar="DATABASE:PHOTOS...")
@click.option("--k", default=20, show_default=True)
@click.option("--chance/--no-chance", default=True, help="Map COLMAP's matches twice.")
@click.option("--keep", type=click.Path(path_type=Path), help="Keep what is made in this folder.")
def main(scenes: tuple[str, ...], k: int, chance: bool, keep: Path | None) -> None:
    """Match and map with both and print one table."""
    engine.silence()
    table = Table(
        "flight", "matched by", "CPU s", "verified (wrong, of judged)", "missed",
        "extra (wrong, of judged)", "inliers, share of COLMAP's", "registered", "points",
        "error px", "of COLMAP's", "points in both: error here, in COLMAP's",
        "centres off, % of extent: median", "max",
    )  # fmt: skip
    for scene in scenes:
        database, _, photos = scene.partition(":")
        project, name = Project(Path(database), Path(photos)), Path(database).parent.name
        with tempfile.TemporaryDirectory() as scratch:
            found = outcomes(project, k, Path(scratch), chance)
            if keep is not None:
                shutil.copytree(scratch, keep / name)
        for row in rows(name, found, Judge(found[0], keypoints_of(project.database))):
            table.add_row(*row)
            print(" | ".join(row), flush=True)
    Console(width=240).print(table)


if __name__ == "__main__":
    main()
