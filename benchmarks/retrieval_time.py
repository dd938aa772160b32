"""Seconds a photo for retrieval, side by side in one run, on one real flight.

    python benchmarks/retrieval_time.py [--scene ../shared/data/sheffield_cross]

COLMAP's vocabulary tree (index and query; the tree is built from the flight itself, its building
is listed apart), VLAD on SIFT (its codebook learned as well), the VGG-16 model and the
EfficientNet-Lite0 model, each from photos or features to the neighbours, nothing cached; and the
share of plain photo decoding in the deep models' time. The last column is how many times faster
than the vocabulary tree.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from colmap_netvlad.colmap.features import extract_features
from colmap_netvlad.flight import open_flight
from colmap_netvlad.models.catalogue import CATALOGUE
from colmap_netvlad.models.checkpoint import load_model
from colmap_netvlad.photos.decode import load_batches
from colmap_netvlad.photos.files import find_photos
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods import bow
from colmap_netvlad.retrieval.methods.deep import BATCH_SIZE
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project

SCENE = Path(__file__).parents[1] / ".." / "shared" / "data" / "sheffield_cross"
MODELS = ("netvlad-o", "netvlad-o-lite")


def decoding_seconds(images: Path, names: list[str], long_side: int) -> float:
    """Decode all photos as the deep methods do, and nothing else."""
    start = time.perf_counter()
    for _ in load_batches(images, names, long_side, BATCH_SIZE):
        pass
    return time.perf_counter() - start


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, default=SCENE, help="a folder with images/ in it")
    parser.add_argument("--db", type=Path, help="its database with features, to save extraction")
    parser.add_argument("--vocab-tree", type=Path, help="the flight's tree, to save building it")
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--k", type=int, default=30)
    options = parser.parse_args()
    images = options.scene / "images"
    if not images.is_dir():
        sys.exit(f"{images} is not here; name a flight with --scene.")
    names = find_photos(images)
    with tempfile.TemporaryDirectory() as folder:
        database = options.db or Path(folder) / "features.db"
        if not options.db:
            extract_features(images, database)
        project = Project(database, images, Path(folder) / "cache.netvlad.db")
        start = time.perf_counter()
        with open_flight(project) as flight:
            tree, note = bow.find_tree(flight, options.vocab_tree, 0)
        print(f"{len(names)} photos, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
        print(f"{note}: {time.perf_counter() - start:.0f} s\n")
        print("method                  describe   search    total   of it decoding   BoW / total")
        print("                          s/photo  s/photo  s/photo")
        reference = 0.0
        for method in ("bow", "vlad", *options.models):
            if method in CATALOGUE and not CATALOGUE[method].available:
                print(f"{method:22}  its weights are not here")
                continue
            ranking = rank_project(project, method, RetrievalOptions(k=options.k, vocab_tree=tree))
            described = ranking.seconds_describe / len(names)
            searched = ranking.seconds_search / len(names)
            total = described + searched
            reference = reference or total
            share = ""
            if method in CATALOGUE:
                long_side = load_model(method).long_side
                share = f"{decoding_seconds(images, names, long_side) / len(names) / total:.0%}"
            print(
                f"{method:22} {described:9.4f} {searched:8.4f} {total:8.4f} {share:>16} "
                f"{reference / total:13.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
