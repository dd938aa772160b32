"""COLMAP's own matcher, in chunks.

Pairs are matched in chunks of half a minute, each written when done: a stopped run loses one
chunk a process at most, and the next run goes on with the rest.

COLMAP's CPU matcher searches with faiss, whose k-means in several threads of one process at
times gives an image a wrong index (pycolmap 4.2.1: about one image in 1,500 lost up to all its
matches). So each process here matches with one thread, in a database of its own that holds the
features of its chunk, and there are as many processes as processors.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_features, copy_matches
from colmap_netvlad.colmap.database import pair_id
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.matching.options import MatchOptions, Work
from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import scratch_folder
from colmap_netvlad.runtime.machine import usable_processors

FIRST_CHUNK = 32
"""Pairs of the first chunk; the next ones are sized to take `CHUNK_SECONDS`."""

CHUNK_SECONDS = 30.0
MAX_CHUNK = 4096

BLOCK = 128
"""Processes take turns by blocks of this many pairs, so that all get their share of slow ones."""

WORTH_A_PROCESS = 128
"""Fewer pairs than this take less time than a process takes to start."""


def match_by_colmap(
    database: Path, pairs: Sequence[IdPair], options: MatchOptions, advance: Callable[[int], None]
) -> Work:
    """Match and verify pairs with COLMAP's matcher, as `matchers.Match`."""
    most = 1 if pycolmap.has_cuda else options.processes or usable_processors()
    count = max(1, min(most, len(pairs) // WORTH_A_PROCESS))
    blocks = [pairs[at : at + BLOCK] for at in range(0, len(pairs), BLOCK)]
    with scratch_folder() as folder:
        jobs = []
        for number in range(count):
            own = Path(folder, f"{number}")
            own.mkdir()
            share = [pair for block in blocks[number::count] for pair in block]
            jobs.append(workers.Job(_match_in_chunks, (database, own, share, options.seed)))
        if count == 1:
            start = time.monotonic()
            _match_in_chunks(advance, *jobs[0].arguments)
            return Work(even_seconds=(time.monotonic() - start) / most)
        outcomes = workers.run(jobs, count, advance, initialiser=engine.initialiser())
    for outcome in outcomes:
        if outcome.fault:
            raise InputError(
                f"Matching stopped: {outcome.fault.rstrip('.')}. What is matched stays in "
                f"{database}; run the command again to go on."
            )
    return Work(even_seconds=sum(outcome.seconds for outcome in outcomes) / most)


def _match_in_chunks(
    advance: Callable[[int], None],
    database: Path,
    folder: Path,
    pairs: Sequence[IdPair],
    seed: int,
) -> None:
    """Match all pairs in chunks that take about `CHUNK_SECONDS`, each kept when done."""
    size, at = FIRST_CHUNK, 0
    while at < len(pairs):
        chunk = pairs[at : at + size]
        start = time.monotonic()
        _match_apart(database, folder, chunk, seed)
        advance(len(chunk))
        at += len(chunk)
        rate = len(chunk) / max(time.monotonic() - start, 1e-3)
        size = int(min(max(rate * CHUNK_SECONDS, 1), 4 * size, MAX_CHUNK))


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
        _match(scratch, listed, database.parent, seed)
        copy_matches(scratch, database, [pair_id(*pair) for pair in pairs])
    finally:
        for used in folder.glob("matches.db*"):
            used.unlink()


def _match(scratch: Path, listed: Path, watched: Path, seed: int) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    if not pycolmap.has_cuda:
        matching.num_threads = 1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    engine.call(
        pycolmap.match_image_pairs,
        watched,
        scratch,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
    )
