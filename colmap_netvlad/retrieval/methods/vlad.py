"""VLAD on SIFT, the paper's baseline: 256 words, residuals, normalised three times.

Jegou et al., Aggregating local descriptors into a compact image representation, CVPR 2010;
intra-normalisation from Arandjelovic and Zisserman, All about VLAD, CVPR 2013. COLMAP's SIFT is
already RootSIFT (its default normalisation is L1_ROOT), so the bytes are taken as they are.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Codebook, Store
from colmap_netvlad.colmap.database import SIFT_BYTES, Database
from colmap_netvlad.flight import Flight
from colmap_netvlad.retrieval.described import cache_note, missing, rank_described
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.progress import step

WORDS = 256
"""Size of the codebook in the paper's section 4.2."""

SAMPLE_IMAGES = 1000
SAMPLE_DESCRIPTORS = 256 * WORDS
"""The codebook is learned on this many descriptors of this many images; more than 256 a word
change k-means little (faiss subsamples to that as well)."""

OUTGROWN = 1.5
"""The codebook is learned again when the project has this many times the images it had."""

BATCH = 64
NO_FEATURES = "has no SIFT features"


def candidates(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
    """Rank by VLAD of the SIFT features in the database.

    Its codebook is learned on them: the seconds of that are among those of describing, whether it
    was learned now or in an earlier run.

    Raises:
        InputError: the database has no features, or not SIFT.
    """
    database, store = flight.database, flight.store
    ids = {i.name: i.image_id for i in flight.images if i.image_id in flight.descriptors}
    if not ids:
        raise InputError(
            f"{flight.project.database} has no SIFT features, which VLAD needs; extract them with "
            "`colmap-netvlad features`."
        )
    features = {name: flight.features[image_id] for name, image_id in ids.items()}
    codebook, learned = _codebook(store, database, ids, features, options.seed)
    words = codebook.words
    model = _model(words)
    to_do = missing(store, model, features)
    _describe(store, database, model, words, ids, features, to_do)
    left_out = {name: NO_FEATURES for name in flight.names if name not in ids}
    when = "" if learned else " in an earlier run"
    notes = [
        cache_note(len(to_do), len(ids)),
        f"learning the codebook of {len(words)} words took {codebook.seconds:.1f} s{when}, which"
        " are part of describing",
    ]
    ranking = rank_described(store, model, flight.names, left_out, options, depth, "vlad", notes)
    return replace(ranking, seconds_describe=ranking.seconds_describe + codebook.seconds)


def describe(descriptors: NDArray[np.uint8], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the VLAD of one image.

    Args:
        descriptors: (n, 128) SIFT as COLMAP keeps it.
        words: (K, 128) codebook.

    Returns:
        (K * 128,) L2-normalised; zeros where n is 0.
    """
    from scipy.sparse import csr_matrix

    values = descriptors.astype(np.float32)
    nearest = _nearest_words(values, words)
    members = csr_matrix(
        (np.ones(len(values), np.float32), (nearest, np.arange(len(values)))),
        shape=(len(words), len(values)),
    )
    counts = np.bincount(nearest, minlength=len(words)).astype(np.float32)
    residuals = members @ values - counts[:, None] * words
    rooted = np.sign(residuals) * np.sqrt(np.abs(residuals))
    rows = _normalised(rooted, axis=1)
    return _normalised(rows.ravel(), axis=0)


def learn_words(
    database: Database, image_ids: list[int], seed: int, count: int = WORDS
) -> NDArray[np.float32]:
    """Return (count, 128) words: k-means on a sample of the database's descriptors."""
    import faiss

    sample = sample_descriptors(database, image_ids, SAMPLE_IMAGES, SAMPLE_DESCRIPTORS, seed)
    count = min(count, len(sample))
    kmeans = faiss.Kmeans(
        sample.shape[1], count, niter=20, seed=seed + 1, min_points_per_centroid=1
    )
    kmeans.train(sample.astype(np.float32))
    return np.ascontiguousarray(kmeans.centroids, np.float32)


def sample_descriptors(
    database: Database, image_ids: list[int], num_images: int, num_descriptors: int, seed: int
) -> NDArray[np.uint8]:
    """Return up to `num_descriptors` SIFT descriptors, evenly from up to `num_images` images."""
    generator = np.random.default_rng(seed)
    chosen = generator.permutation(np.array(sorted(image_ids)))[:num_images]
    quota = -(-num_descriptors // len(chosen))
    parts = []
    for image_id in chosen.tolist():
        descriptors = database.sift_descriptors(image_id)
        keep = generator.permutation(len(descriptors))[:quota]
        parts.append(descriptors[keep])
    return np.concatenate(parts)


def _codebook(
    store: Store, database: Database, ids: dict[str, int], features: dict[str, str], seed: int
) -> tuple[Codebook, bool]:
    """Return the codebook, from the cache where it is of this project's features and the project
    has not outgrown it, and whether it was learned now."""
    key = f"vlad-{WORDS}-seed-{seed}"
    kept = store.codebook(key)
    if kept is not None and kept.words.shape[1] == SIFT_BYTES and kept.images <= len(ids):
        # The words of another project, or of features that were extracted again, describe none
        # or few of these.
        described = len(ids) - len(missing(store, _model(kept.words), features))
        if len(ids) <= OUTGROWN * min(described, kept.images):
            return kept, False
    start = time.perf_counter()
    words = learn_words(database, list(ids.values()), seed)
    codebook = Codebook(words, len(ids), time.perf_counter() - start)
    store.keep_codebook(key, codebook)
    return codebook, True


def _model(words: NDArray[np.float32]) -> str:
    """Return the key of the descriptors by these words."""
    return "vlad-" + hashlib.sha256(words.tobytes()).hexdigest()


def _describe(
    store: Store,
    database: Database,
    model: str,
    words: NDArray[np.float32],
    ids: dict[str, int],
    features: dict[str, str],
    to_do: list[str],
) -> None:
    with step("Aggregating SIFT (VLAD)", len(to_do)) as bar:
        for first in range(0, len(to_do), BATCH):
            names = to_do[first : first + BATCH]
            start = time.perf_counter()
            vectors = np.stack(
                [describe(database.sift_descriptors(ids[name]), words) for name in names]
            )
            seconds = time.perf_counter() - start
            store.add_descriptors(model, names, [features[n] for n in names], vectors, seconds)
            bar.advance(len(names))


def _nearest_words(values: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.intp]:
    # |x - w|^2 without |x|^2, which is the same for all words.
    return np.argmin((words**2).sum(axis=1) - 2 * values @ words.T, axis=1)


def _normalised(values: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    norms = np.linalg.norm(values, axis=axis, keepdims=True)
    return values / np.maximum(norms, 1e-12)
