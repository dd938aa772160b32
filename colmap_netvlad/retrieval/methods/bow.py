"""COLMAP's vocabulary tree (bag of words), run through pycolmap without matching.

Schoenberger et al., A vote-and-verify strategy for fast spatial verification in image
retrieval, ACCV 2016. The tree is, in this order: the one given by path; COLMAP's published one
where COLMAP has cached it; one built from the project's own descriptors, kept beside the cache.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.colmap.copies import copy_database, keep_images
from colmap_netvlad.flight import Flight
from colmap_netvlad.retrieval.methods.vlad import NO_FEATURES, sample_descriptors
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path, scratch_folder

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

ONE_THREAD = "indexed and asked in one thread: in several, answers differ from run to run"

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
    with scratch_folder() as folder:
        features = folder / "features.db"
        copy_database(flight.project.database, features, matches=False)
        keep_images(features, rows)
        answer = folder / "answer.npz"
        arguments = answer, features, tree, rows, frozenset(described), depth
        _apart("Asking the vocabulary tree", len(rows), _query, *arguments)
        with np.load(answer, allow_pickle=False) as kept:
            partners, (seconds_index, seconds_query) = kept["partners"], kept["seconds"].tolist()
    scores = 1 / np.arange(1, depth + 1, dtype=np.float32)
    return Ranking(
        flight.names,
        partners,
        np.where(partners == NO_PARTNER, -np.inf, scores).astype(np.float32),
        "bow",
        seconds_describe=seconds_index,
        seconds_search=seconds_query,
        notes=(note, ONE_THREAD),
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
        "(COLMAP's published tree is not in its cache); the times leave its building out"
    )
    if tree.is_file():
        return tree, note
    sample = sample_descriptors(
        flight.database, list(counts), len(counts), words * DESCRIPTORS_A_WORD, seed
    )
    start = time.perf_counter()
    for old in tree.parent.glob(cache.with_suffix(".words-*.bin").name):
        old.unlink()
    with atomic_path(tree) as temporary:
        title = f"Building a vocabulary tree of {words} words"
        _apart(title, 1, _build, temporary, sample, words, seed)
    return tree, f"{note}, {time.perf_counter() - start:.0f} s"


def _build(
    advance: Callable[[int], None], tree: Path, sample: NDArray[np.uint8], words: int, seed: int
) -> None:
    """Build a tree (in a worker)."""
    import pycolmap

    pycolmap.set_random_seed(seed)
    index = pycolmap.VisualIndex.create(sample.shape[1], EMBEDDING)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = words
    options.num_iterations = BUILD_ITERATIONS
    options.num_rounds = 1
    options.num_threads = 1  # with several, faiss's k-means now and then gives another tree
    values = sample.astype(np.float32)
    descriptors = pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, values)
    with _silent():
        index.build(options, descriptors)
    index.write(tree)
    advance(1)


@contextmanager
def _silent() -> Iterator[None]:
    """Keep from the terminal what faiss prints by itself: that it would like fewer words."""
    terminal = os.dup(2)
    with Path(os.devnull).open("wb") as nothing:
        os.dup2(nothing.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)


def _query(
    advance: Callable[[int], None],
    answer: Path,
    features: Path,
    tree: Path,
    rows: Mapping[int, int],
    described: Collection[int],
    depth: int,
) -> None:
    """Index all images and query each (in a worker).

    Writes partners (N, depth), and the seconds of both, to `answer`.
    """
    import pycolmap

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
        generator = pycolmap.VocabTreePairGenerator(options, database)
        indexed = time.perf_counter()
        while not generator.has_finished():
            _keep(generator.next(), rows, described, partners)
            advance(1)
    finally:
        database.close()
    seconds = indexed - start, time.perf_counter() - indexed
    np.savez(answer, partners=partners, seconds=seconds)


def _apart(title: str, total: int, function: Callable[..., None], *arguments: Any) -> None:
    """Run a job in a process of its own: COLMAP's trees cannot be interrupted, a process can.

    Raises:
        InputError: it failed.
    """
    from colmap_netvlad.colmap import engine

    with progress.step(title, total) as bar:
        job = workers.Job(function, arguments)
        (outcome,) = workers.run([job], 1, bar.advance, initialiser=engine.initialiser())
    if outcome.fault is not None:
        raise InputError(f"{title} failed: {outcome.fault}.")


def _keep(
    pairs: list[tuple[int, int]],
    rows: Mapping[int, int],
    described: Collection[int],
    partners: NDArray[np.int32],
) -> None:
    """Write one query's answer, (query, partner) best first, into its row."""
    found = [rows[b] for a, b in pairs if a != b and b in described]
    if found and pairs[0][0] in described:
        row = list(dict.fromkeys(found))[: partners.shape[1]]
        partners[rows[pairs[0][0]], : len(row)] = row


def _check_tree(tree: Path) -> None:
    import pycolmap

    from colmap_netvlad.colmap import engine

    engine.silence()
    if not tree.is_file():
        raise InputError(f"The vocabulary tree {tree} does not exist.")
    try:
        pycolmap.VisualIndex.read(tree)
    except Exception as fault:
        raise InputError(
            f"{tree} is not a vocabulary tree that COLMAP 4 reads (FLANN trees of COLMAP 3.11 and "
            f"older are not): {str(fault).splitlines()[0]}"
        ) from fault
