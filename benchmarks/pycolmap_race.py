"""pycolmap alone: does k-means in several threads build the same tree each time?

    python benchmarks/pycolmap_race.py --builds 900 --threads 4

Builds a vocabulary tree from the same descriptors with the same seed again and again, and counts
the trees by their content; docs/pycolmap-race.md is the report it belongs to. It needs pycolmap
and numpy, nothing of this project.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pycolmap


def build(descriptors: np.ndarray, words: int, threads: int, folder: Path) -> str:
    """Return the sha256 of a tree of these (N, 128) descriptors."""
    pycolmap.set_random_seed(0)
    index = pycolmap.VisualIndex.create(descriptors.shape[1], 64)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = words
    options.num_iterations = 10
    options.num_rounds = 1
    options.num_threads = threads
    index.build(
        options, pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, descriptors)
    )
    index.write(folder / "tree.bin")
    return hashlib.sha256((folder / "tree.bin").read_bytes()).hexdigest()


def main() -> None:
    """Build and count."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--builds", type=int, default=900)
    parser.add_argument("--threads", type=int, default=4)
    parser.add_argument("--words", type=int, default=128)
    chosen = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    values = np.random.default_rng(0).integers(0, 256, (25 * chosen.words, 128))
    descriptors = values.astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        trees = Counter(
            build(descriptors, chosen.words, chosen.threads, Path(folder))
            for _ in range(chosen.builds)
        )
    print(f"pycolmap {pycolmap.__version__}, {chosen.threads} threads: {chosen.builds} builds")
    for tree, count in trees.most_common():
        print(f"{count:6} {tree[:16]}")


if __name__ == "__main__":
    main()
