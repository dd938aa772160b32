#!/usr/bin/env python3
"""Cluster SIFT descriptors into the few words among which `retrieval.confirm` looks for matches.

    python scripts/make_sift_words.py --output colmap_netvlad/retrieval/sift_words.npy \
        flights/scene1/project.db flights/scene2/project.db

Each DATABASE gives equally many descriptors, those of its photos' largest features.
"""

from __future__ import annotations

import io
from pathlib import Path

import click
import faiss
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.graph.oriented import largest_first, scales, usable
from colmap_netvlad.retrieval.confirm import LARGEST
from colmap_netvlad.runtime.files import write_atomically
from colmap_netvlad.terminal import Command


@click.command(cls=Command, help=__doc__)
@click.argument("databases", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option("--words", default=8, show_default=True)
@click.option("--descriptors", default=20_000, show_default=True, help="Of each database.")
@click.option("--seed", default=0, show_default=True)
@click.option("--output", required=True, type=click.Path(path_type=Path))
def make_sift_words(
    databases: tuple[Path, ...], words: int, descriptors: int, seed: int, output: Path
) -> None:
    generator = np.random.default_rng(seed)
    drawn = np.concatenate([draw(file, descriptors, generator) for file in databases])
    drawn = drawn.astype(np.float32)
    faiss.normalize_L2(drawn)
    kmeans = faiss.Kmeans(
        drawn.shape[1],
        words,
        niter=50,
        seed=seed,
        spherical=True,
        max_points_per_centroid=len(drawn),
    )
    kmeans.train(drawn)
    # Cosines decide, so all words are stretched alike.
    mean = np.rint(127 / kmeans.centroids.max() * kmeans.centroids)
    file = io.BytesIO()
    np.save(file, mean.astype(np.int8))
    write_atomically(output, file.getvalue())
    share = np.bincount((drawn @ mean.T).argmax(axis=1), minlength=words) / len(drawn)
    click.echo(f"{output}: {words} words of {share.min():.0%} to {share.max():.0%} of descriptors")


def draw(file: Path, count: int, generator: np.random.Generator) -> NDArray[np.uint8]:
    """Return (count, 128) descriptors of the largest features of a database's photos."""
    largest = []
    with open_database(file) as database:
        for image_id in sorted(database.images_with_features()):
            keypoints = database.keypoint_shapes(image_id)
            scale = scales(keypoints)
            chosen = largest_first(scale, usable(keypoints, scale))[:LARGEST]
            largest.append(database.sift_descriptors(image_id)[chosen])
    together = np.concatenate(largest)
    return together[generator.permutation(len(together))[:count]]


if __name__ == "__main__":
    make_sift_words()
