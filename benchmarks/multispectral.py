"""What pairing shots instead of bands does for a multispectral flight.

    python benchmarks/multispectral.py [--k 8] [--wide 40]

A flight of 24 photos is rendered, and five bands are made of each by grey mixes, each through a
lens of its own; infrared turns the contrast of plants and roofs. Pairs are made as the program
makes them, as for photos of no shot, and without those in a shot; all are matched and mapped.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from PIL import Image

from colmap_netvlad.colmap.engine import silence
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.demo.render import FlightOptions, render_flight
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.project import Project

BANDS = {
    "Blue": (0.1, 0.1, 0.8, 0),
    "Green": (0.1, 0.8, 0.1, 0),
    "Red": (0.8, 0.1, 0.1, 0),
    "RedEdge": (0.2, 1.1, -0.3, 0),
    "NIR": (-1.2, 2.2, 0, 60),
}
"""Shares of red, green and blue, and what is added."""

NOISE = 2.5
"""Of a grey value, 0..255."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--k", type=int, default=8)
    parser.add_argument("--wide", type=int, default=40, help="k of photos of no shot, once more.")
    arguments = parser.parse_args()
    silence()
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder, "images")
        make_bands(Path(folder), images)
        extract_features(images, Path(folder, "project.db"), FeatureOptions(max_features=4096))
        for name, k, naive, within in (
            ("shots", arguments.k, False, True),
            ("shots, none in a shot", arguments.k, False, False),
            ("bands as photos", arguments.k, True, True),
            ("bands as photos", arguments.wide, True, True),
        ):
            run(Path(folder), images, name, k, naive=naive, within=within)


def make_bands(folder: Path, images: Path) -> None:
    flight = render_flight(folder / "colour", FlightOptions(rows=4, columns=6))
    images.mkdir()
    rng = np.random.default_rng(0)
    for number, name in enumerate(flight.names, 1):
        shutil.copy(flight.images / name, images / f"DJI_{number:03d}0.JPG")
        pixels = np.asarray(Image.open(flight.images / name), np.float32)
        for band, (*shares, base) in enumerate(BANDS.values(), 1):
            turn = cv2.getRotationMatrix2D((0, 0), -0.15 * band, 1)
            turn[:, 2] += [1.5 * band, -1.0 * band]
            grey = cv2.warpAffine(
                pixels @ np.array(shares, np.float32) + base,
                turn,
                (flight.width, flight.height),
                borderMode=cv2.BORDER_REFLECT,
            )
            grey += rng.normal(0, NOISE, grey.shape)
            photo = Image.fromarray(np.clip(grey, 0, 255).astype(np.uint8))
            photo.save(images / f"DJI_{number:03d}{band}.TIF")


def run(folder: Path, images: Path, name: str, k: int, *, naive: bool, within: bool) -> None:
    project = Project(folder / "run/project.db", images)
    shutil.rmtree(folder / "run", ignore_errors=True)
    project.folder.mkdir()
    shutil.copy(folder / "project.db", project.database)
    nobody: Callable[[object], None] = lambda flight: None  # noqa: E731
    if naive:
        with patch("colmap_netvlad.retrieval.rank.multispectral_shots", nobody):
            report = make_pairs(project, "vlad", k=k)
    else:
        report = make_pairs(project, "vlad", k=k)
    pairs = [(p.name1, p.name2) for p in report.pairs if within or kind(p.name1, p.name2) != "shot"]
    kinds = Counter(kind(*pair) for pair in pairs)
    shots = {frozenset((a[:7], b[:7])) for a, b in pairs if a[:7] != b[:7]}
    matches = match_pairs(project.database, pairs)
    models = map_incremental(project.database, None, folder / "run/sparse", MappingOptions())
    sizes = sorted((model.num_reg_images() for model in models), reverse=True)
    print(
        f"{name}, k {k}: {len(pairs):,} pairs {dict(kinds)}, {matches.verified:,} verified, "
        f"{len(shots):,} pairs of shots; models of {sizes} images",
        flush=True,
    )


def kind(one: str, other: str) -> str:
    if one[:7] == other[:7]:
        return "shot"
    return "same band" if one[7] == other[7] else "other bands"


if __name__ == "__main__":
    main()
