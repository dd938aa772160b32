"""COLMAP's vocabulary tree (bag of words), run through pycolmap without matching.

Schoenberger et al., A vote-and-verify strategy for fast spatial verification in image
retrieval, ACCV 2016. The tree is, in this order: the one given by path; COLMAP's published one
where COLMAP has cached it; one built from the project's own descriptors, kept beside the cache.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.flight import Flight
from colmap_netvlad.retrieval.methods.vlad import NO_FEATURES, sample_descriptors
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path

PUBLISHED = "vocab_tree_faiss_flickr100K_words256K.bin"
PUBLISHED_SHA256 = "96ca8ec8ea60b1f73465aaf2c401fd3b3ca75cdba2d3c50d6a2f6f760f275ddc"
"""COLMAP's SIFT tree since 3.12 (release 3.11.1), in `~/.cache/colmap/<sha256>-<name>`."""

EMBEDDING = 64
"""Bits of the Hamming embedding, as in COLMAP's own trees."""

DESCRIPTORS_A_WORD = 25
MOST_WORDS = 16_384
BUILD_ITERATIONS = 10
"""A tree of our own has one word for 25 sampled descriptors and at most 16,384 words; k-means
stops after 10 iterations. That bounds its building to some minutes on 2 cores."""

FULL_DEPTH = 2000
LEAST_DEPTH = 1000
"""Up to 2,000 images every image ranks all others; above, at least 1,000."""


def candidates(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
    """Rank by COLMAP's vocabulary tree.

    Works on a temporary copy of the features (disk space and time of one copy: about 0.7 MB an
    image), since pycolmap migrates and locks what it opens. COLMAP gives no scores: they are
    1 / rank.

    Raises:
        InputError: no SIFT features, no such tree, or a tree that COLMAP cannot read.
    """
    images, described = flight.images, flight.descriptors
    if not described:
        raise InputError(
            f"{flight.project.database} has no SIFT features, which a vocabulary tree needs; "
            "extract them with `colmap-netvlad features`."
        )
    tree, note = find_tree(flight, options.vocab_tree, options.seed)
    rows = {image.image_id: i for i, image in enumerate(images)}
    depth = len(images) - 1 if len(images) <= FULL_DEPTH else max(depth, LEAST_DEPTH)
    with tempfile.TemporaryDirectory(prefix="colmap-netvlad-") as folder:
        features = Path(folder) / "features.db"
        copy_database(flight.project.database, features, matches=False)
        partners, seconds_index, seconds_query = _query(features, tree, rows, described, depth)
    scores = 1 / np.arange(1, depth + 1, dtype=np.float32)
    return Ranking(
        flight.names,
        partners,
        np.where(partners == NO_PARTNER, -np.inf, scores).astype(np.float32),
        "bow",
        seconds_describe=seconds_index,
        seconds_search=seconds_query,
        notes=(note,),
        left_out=tuple((i.name, NO_FEATURES) for i in images if i.image_id not in described),
    )


def find_tree(flight: Flight, given: Path | None, seed: int) -> tuple[Path, str]:
    """Return the vocabulary tree to use, and a sentence that says which it is.

    Raises:
        InputError: the given tree is not there or not one that COLMAP 4 reads.
    """
    if given is not None:
        _check_tree(given)
        return given, f"vocabulary tree {given}"
    published = Path.home() / ".cache" / "colmap" / f"{PUBLISHED_SHA256}-{PUBLISHED}"
    if published.is_file():
        return published, f"COLMAP's published vocabulary tree {PUBLISHED}"
    return _own_tree(flight, seed)


def _own_tree(flight: Flight, seed: int) -> tuple[Path, str]:
    counts, cache = flight.descriptors, flight.project.cache
    words = int(min(MOST_WORDS, max(sum(counts.values()) // DESCRIPTORS_A_WORD, 1)))
    content = f"{sorted(flight.features.items())} {words} {seed}"
    key = hashlib.sha256(content.encode()).hexdigest()[:12]
    tree = cache.with_suffix(f".words-{key}.bin")
    note = (
        f"vocabulary tree of {words} words built from this project's own descriptors "
        "(COLMAP's published tree is not in its cache)"
    )
    if tree.is_file():
        return tree, note
    sample = sample_descriptors(
        flight.database, list(counts), len(counts), words * DESCRIPTORS_A_WORD, seed
    )
    start = time.perf_counter()
    for old in tree.parent.glob(cache.with_suffix(".words-*.bin").name):
        old.unlink()
    _build(tree, sample.astype(np.float32), words, seed)
    return tree, f"{note}, in {time.perf_counter() - start:.0f} s"


def _build(tree: Path, sample: NDArray[np.float32], words: int, seed: int) -> None:
    import pycolmap

    from colmap_netvlad.colmap.engine import silence

    silence()
    pycolmap.set_random_seed(seed)
    index = pycolmap.VisualIndex.create(sample.shape[1], EMBEDDING)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = words
    options.num_iterations = BUILD_ITERATIONS
    options.num_rounds = 1
    options.num_threads = 1  # with several, faiss's k-means now and then gives another tree
    with progress.step(f"Building a vocabulary tree of {words} words", 1) as bar:
        index.build(
            options,
            pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, sample),
        )
        bar.advance()
    with atomic_path(tree) as temporary:
        index.write(temporary)


def _query(
    features: Path, tree: Path, rows: dict[int, int], described: Mapping[int, int], depth: int
) -> tuple[NDArray[np.int32], float, float]:
    """Index all images and query each; return partners (N, depth) and the seconds of both."""
    import pycolmap

    from colmap_netvlad.colmap.engine import silence

    silence()
    partners = np.full((len(rows), depth), NO_PARTNER, np.int32)
    database = pycolmap.Database.open(features)
    try:
        options = pycolmap.VocabTreePairingOptions()
        options.num_images = depth + 1  # COLMAP counts the image itself
        options.vocab_tree_path = tree
        # In several threads pycolmap 4.2.1 answers one query in twenty differently from run to
        # run, from the first partner on.
        options.num_threads = 1
        start = time.perf_counter()
        with progress.step("Indexing with the vocabulary tree", 1) as bar:
            generator = pycolmap.VocabTreePairGenerator(options, database)
            bar.advance()
        indexed = time.perf_counter()
        with progress.step("Querying the vocabulary tree", len(rows)) as bar:
            while not generator.has_finished():
                _keep(generator.next(), rows, described, partners)
                bar.advance()
    finally:
        database.close()
    return partners, indexed - start, time.perf_counter() - indexed


def _keep(
    pairs: list[tuple[int, int]],
    rows: dict[int, int],
    described: Mapping[int, int],
    partners: NDArray[np.int32],
) -> None:
    """Write one query's answer, (query, partner) best first, into its row."""
    found = [rows[b] for a, b in pairs if a != b and b in described]
    if found and pairs[0][0] in described:
        row = list(dict.fromkeys(found))[: partners.shape[1]]
        partners[rows[pairs[0][0]], : len(row)] = row


def _check_tree(tree: Path) -> None:
    import pycolmap

    from colmap_netvlad.colmap.engine import silence

    silence()
    if not tree.is_file():
        raise InputError(f"The vocabulary tree {tree} does not exist.")
    try:
        pycolmap.VisualIndex.read(tree)
    except Exception as fault:
        raise InputError(
            f"{tree} is not a vocabulary tree that COLMAP 4 reads (FLANN trees of COLMAP 3.11 and "
            f"older are not): {str(fault).splitlines()[0]}"
        ) from fault
