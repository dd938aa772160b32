"""SIFT's settings, side by side in one run: what they cost and what the model loses.

    python benchmarks/sift_settings.py PHOTOS --pairs pairs.txt [--setting default --setting ...]

Every setting extracts the same photos anew (one thread, processor seconds of pycolmap and of what
decodes the photo), matches the same pairs with COLMAP's matcher, and maps them incrementally. The
pairs list is one of `colmap-netvlad pairs`, made from features of the default. OpenCV's SIFT is
written as COLMAP keeps it: RootSIFT in bytes, the pixel's centre at 0.5.
"""

from __future__ import annotations

import resource
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import click
import cv2
import numpy as np
import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.summary import combine
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.photos.files import find_photos
from colmap_netvlad.terminal import Command

MOST = 8192
"""Features asked of a photo, as `features` does."""

COLMAP = {
    "default": {},
    "first octave 0": {"first_octave": 0},
    "first octave 0, peaks / 2": {"first_octave": 0, "peak_threshold": 0.02 / 3 / 2},
    "one orientation": {"max_num_orientations": 1},
}
"""Name -> what differs from COLMAP's options."""


def processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def extract(database: Path, images: Path, settings: dict[str, float]) -> None:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.sift.max_num_features = MOST
    for name, value in settings.items():
        setattr(extraction.sift, name, value)
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction
    )


def strongest(keypoints: list[cv2.KeyPoint]) -> np.ndarray:
    return np.argsort([-k.response for k in keypoints], kind="stable")[:MOST]


def largest(keypoints: list[cv2.KeyPoint]) -> np.ndarray:
    """Return the features of the largest scales, as COLMAP chooses them."""
    return np.argsort([-k.size for k in keypoints], kind="stable")[:MOST]


def extract_opencv(
    database: Path, images: Path, choose: Callable[[list[cv2.KeyPoint]], np.ndarray]
) -> None:
    """Fill a database that has COLMAP's images and cameras with OpenCV's SIFT."""
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE)
    cv2.setNumThreads(1)
    detector = cv2.SIFT_create(contrastThreshold=0.02, enable_precise_upscale=True)
    opened = pycolmap.Database.open(database)
    try:
        for image in opened.read_all_images():
            grey = cv2.imread(str(images / image.name), cv2.IMREAD_GRAYSCALE)
            found = detector.detect(grey, None)
            kept = [found[i] for i in choose(found)]
            kept, values = detector.compute(grey, kept)
            root = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-12))
            places = np.array([(*k.pt, k.size / 2, np.radians(k.angle)) for k in kept], np.float32)
            places[:, :2] += 0.5
            opened.write_keypoints(image.image_id, places)
            codes = np.clip(np.round(512 * root), 0, 255).astype(np.uint8)
            descriptors = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, codes)
            opened.write_descriptors(image.image_id, descriptors)
    finally:
        opened.close()


OPENCV = {"OpenCV, strongest": strongest, "OpenCV, largest": largest}


@click.command(cls=Command)
@click.argument("images", type=click.Path(path_type=Path, exists=True))
@click.option("--pairs", required=True, type=click.Path(path_type=Path, exists=True))
@click.option("--setting", "names", multiple=True, default=(*COLMAP, *OPENCV))
def main(images: Path, pairs: Path, names: tuple[str, ...]) -> None:
    engine.silence()
    photos = len(find_photos(images))
    head = (
        "setting features a photo,CPU s a photo,ratio,verified,inliers,registered,points,error px"
    )
    print(f"| {' | '.join(head.split(',')).replace('setting ', 'setting | ')} |\n|{'---|' * 9}")
    reference = 0.0
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            database = Path(folder) / "project.db"
            start = processor_seconds()
            if name in OPENCV:
                extract_opencv(database, images, OPENCV[name])
            else:
                extract(database, images, COLMAP[name])
            seconds = (processor_seconds() - start) / photos
            reference = reference or seconds
            chosen = read_pairs(pairs, image_names(database))
            match_pairs(database, chosen, MatchOptions(processes=1))
            with open_database(database) as opened:
                counts = opened.keypoint_counts()
                inliers = [count for count in opened.verified_matches().values() if count > 15]
            model = combine(map_incremental(database, None, Path(folder) / "sparse"))
        print(
            f"| {name} | {sum(counts.values()) / photos:,.0f} | {seconds:.2f} |"
            f" {reference / seconds:.1f} | {len(inliers)} of {len(chosen)} | {sum(inliers):,} |"
            f" {model.registered} of {photos} | {model.points:,} |"
            f" {model.mean_reprojection_error:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    sys.exit(main())
