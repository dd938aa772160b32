"""COLMAP's own matcher, in chunks.

Pairs are matched in chunks of half a minute, each written when done: a stopped run loses one
chunk a process at most, and the next run goes on with the rest.

COLMAP's CPU matcher searches with faiss, whose k-means in several threads of one process at
times gives an image a wrong index (pycolmap 4.2.1: about one image in 1,500 lost up to all its
matches). So each process here matches with one thread, in a database of its own that holds the
features of its chunk, and there are as many processes as processors.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_features, copy_matches, write_rows
from colmap_netvlad.colmap.database import pair_id
from colmap_netvlad.colmap.parts import part_of_pairs, rows_of_pairs
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.matching.options import MatchOptions, Work
from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import scratch_folder
from colmap_netvlad.runtime.jobs import Shares, Source

FIRST_CHUNK = 32
"""Pairs of the first chunk; the next ones are sized to take `CHUNK_SECONDS`."""

CHUNK_SECONDS = 30.0
WORTH_A_PROCESS = 128
"""Fewer pairs than this take less time than a process takes to start."""


def match_by_colmap(
    database: Path, pairs: Sequence[IdPair], options: MatchOptions, advance: Callable[[int], None]
) -> Work:
    """Match and verify pairs with COLMAP's matcher, as `matchers.Match`."""
    most = 1 if pycolmap.has_cuda else options.processes or workers.capacity().processors
    count = max(1, min(most, len(pairs) // WORTH_A_PROCESS))
    busy = 0.0
    with closing(_chunks(database, pairs, options.seed, count)) as chunks:
        for matched, seconds in chunks:
            advance(matched)
            busy += seconds
    return Work(even_seconds=busy / most)


def _chunks(
    database: Path, pairs: Sequence[IdPair], seed: int, count: int
) -> Generator[tuple[int, float], None, None]:
    """Match all pairs in chunks; yield how many each had and how long it took, s."""
    if count > 1:
        return workers.results(
            partial(_match_chunk, seed),
            pairs,
            count,
            engine.initialiser(),
            Source(database, part_of_pairs, rows_of_pairs, write_rows),
            first=FIRST_CHUNK,
            seconds=CHUNK_SECONDS,
        )
    return _chunks_here(database, Shares(pairs, FIRST_CHUNK, CHUNK_SECONDS), seed)


def _chunks_here(
    database: Path, shares: Shares[IdPair], seed: int
) -> Generator[tuple[int, float], None, None]:
    while shares:
        matched, seconds = _match_chunk(seed, database, shares.next(1))
        shares.learn(matched, seconds)
        yield matched, seconds


def _match_chunk(seed: int, database: Path, pairs: Sequence[IdPair]) -> tuple[int, float]:
    start = time.monotonic()
    try:
        with scratch_folder() as folder:
            _match_apart(database, folder, pairs, seed)
    except (OSError, sqlite3.OperationalError) as fault:
        raise InputError(
            f"Matching stopped: {fault}. What is matched stays in {database}; run the command "
            "again to go on."
        ) from fault
    return len(pairs), time.monotonic() - start


def _match_apart(database: Path, folder: Path, pairs: Sequence[IdPair], seed: int) -> None:
    """Match pairs in a database of their features alone and copy the results to `database`.

    Images have aliases there: COLMAP's pairs list splits a line on the spaces of names.
    """
    aliases = {image_id: f"image{image_id}" for pair in pairs for image_id in pair}
    scratch, listed = folder / "matches.db", folder / "pairs.txt"
    engine.make_or_migrate(scratch)
    try:
        copy_features(database, scratch, aliases)
        listed.write_text("".join(f"{aliases[a]} {aliases[b]}\n" for a, b in pairs))
        _match(scratch, listed, seed)
        copy_matches(scratch, database, [pair_id(*pair) for pair in pairs])
    finally:
        for used in folder.glob("matches.db*"):
            used.unlink()


def _match(scratch: Path, listed: Path, seed: int) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    if not pycolmap.has_cuda:
        matching.num_threads = 1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    engine.call(
        pycolmap.match_image_pairs,
        scratch.parent,
        scratch,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
    )
