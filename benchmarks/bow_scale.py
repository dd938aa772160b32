"""How COLMAP's vocabulary tree grows with the number of images, on simulated features.

    python benchmarks/bow_scale.py DATABASE TREE --sizes 1000,2000,5000 --features 2000

An image is `--features` SIFT descriptors drawn from those of a database, each value off by a
little. All images are indexed and a few are asked, in one thread, by pycolmap's visual index as
`bow` uses it; seconds are processor time. TREE is a vocabulary tree (`bow` keeps one it built
beside the cache, `*.words-*.bin`). One process indexes ever more images: each line adds to the
one before.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np
import pycolmap

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.retrieval.methods.bow import LEAST_DEPTH
from colmap_netvlad.retrieval.methods.vlad import sample_descriptors

ASKED = 20
NOISE = 8.0
"""Spread of a value of a descriptor, 0..255, about the real one it is drawn from."""

POOL = 400_000


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("database", type=Path)
    parser.add_argument("tree", type=Path)
    parser.add_argument("--sizes", default="1000,2000,5000")
    parser.add_argument("--features", type=int, default=2000)
    options = parser.parse_args()
    with open_database(options.database) as database:
        ids = list(database.descriptor_counts())
        pool = sample_descriptors(database, ids, len(ids), POOL, 0).astype(np.float32)
    rng = np.random.default_rng(0)
    keypoints = pycolmap.FeatureKeypoints([pycolmap.FeatureKeypoint()] * options.features)

    def image() -> pycolmap.FeatureDescriptorsFloat:
        drawn = pool[rng.integers(len(pool), size=options.features)]
        values = np.clip(drawn + rng.normal(0, NOISE, drawn.shape), 0, 255).astype(np.float32)
        return pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, values)

    index = pycolmap.VisualIndex.read(options.tree)
    indexing = pycolmap.VisualIndex.IndexOptions()
    asking = pycolmap.VisualIndex.QueryOptions()
    indexing.num_threads = asking.num_threads = 1
    asking.max_num_images = LEAST_DEPTH
    print(f"{index.num_visual_words()} words, {options.features} features an image")
    print("images  index s/image  query s/image  peak GiB", flush=True)
    done, spent = 0, 0.0
    for size in map(int, options.sizes.split(",")):
        for number in range(done, size):
            descriptors = image()
            start = time.process_time()
            index.add(indexing, number + 1, keypoints, descriptors)
            spent += time.process_time() - start
        done = size
        start = time.process_time()
        index.prepare()
        prepared = time.process_time() - start
        asked = [image() for _ in range(ASKED)]
        start = time.process_time()
        for descriptors in asked:
            index.query(asking, descriptors, [])
        query = (time.process_time() - start) / ASKED
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"{size:6,} {(spent + prepared) / size:13.4f} {query:13.4f} {peak:9.2f}", flush=True)


if __name__ == "__main__":
    main()
