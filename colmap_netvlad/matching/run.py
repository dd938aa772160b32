"""Pairs -> matches and two-view geometries in the database, through pycolmap.

Pairs are matched in chunks of half a minute, each written when done: a stopped run loses one
chunk a process at most, and the next run goes on with the rest.

COLMAP's CPU matcher searches with faiss, whose k-means in several threads of one process at
times gives an image a wrong index (pycolmap 4.2.1: about one image in 1,500 lost up to all its
matches). So each process here matches with one thread, in a database of its own that holds the
features of its chunk, and there are as many processes as processors.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_features, copy_matches
from colmap_netvlad.colmap.database import open_database, pair_id
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.machine import usable_processors

FIRST_CHUNK = 32
"""Pairs of the first chunk; the next ones are sized to take `CHUNK_SECONDS`."""

CHUNK_SECONDS = 30.0
MAX_CHUNK = 4096

TILE = 16
"""Pairs between the same two groups of this many images are matched together: COLMAP indexes an
image once a chunk, which takes longer than to match a pair."""

BLOCK = 128
"""Processes take turns by blocks of this many pairs, so that all get their share of slow ones."""

WORTH_A_PROCESS = 128
"""Fewer pairs than this take less time than a process takes to start."""


@dataclass(frozen=True)
class MatchOptions:
    """How pairs are matched; the rest is COLMAP's default.

    Attributes:
        seed: seed of the robust estimation, so that a pair always gives the same inliers.
        processes: how many work at once; None: all processors.
    """

    seed: int = 0
    processes: int | None = None


@dataclass(frozen=True)
class MatchReport:
    """What `match_pairs` did.

    Attributes:
        requested: distinct pairs asked for.
        already: those matched before.
        matched: those matched now.
        verified: those of `requested` with a verified two-view geometry.
        seconds: time of matching and verification, s.
    """

    requested: int
    already: int
    matched: int
    verified: int
    seconds: float


def match_pairs(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    options: MatchOptions = MatchOptions(),
) -> MatchReport:
    """Match image pairs and verify them geometrically, writing into `database`.

    pycolmap brings a database of COLMAP 3.x to the schema of COLMAP 4. A script that calls this
    needs Python's `if __name__ == "__main__":`, as the processes import it again.

    Raises:
        InputError: an unknown image name, no features at all, or a database that cannot be
            written; a process that failed: what was matched by then stays.
    """
    engine.check_writable(database)
    with open_database(database) as colmap:
        ids = {row.name: row.image_id for row in colmap.images()}
        with_features = colmap.keypoint_counts()
        done = colmap.matched_pairs()
    unknown = sorted({name for pair in pairs for name in pair} - set(ids))
    if unknown:
        raise InputError(f"{database} has no image {unknown[0]}; make the pairs list again.")
    if pairs and not with_features:
        raise InputError(
            f"No image in {database} has features; extract them with `colmap-netvlad features`."
        )
    requested = sorted({_sorted_ids(ids[a], ids[b]) for a, b in pairs if a != b})
    todo = [pair for pair in requested if pair not in done]
    start = time.monotonic()
    if todo:
        pycolmap.Database.open(database).close()  # brings an old schema up to date
        with progress.step("Matching pairs", len(todo)) as bar:
            _match_all(database, _in_tiles(todo), options, bar.advance)
    seconds = time.monotonic() - start
    with open_database(database) as colmap:
        verified = colmap.verified_matches()
    return MatchReport(
        requested=len(requested),
        already=len(requested) - len(todo),
        matched=len(todo),
        verified=sum(verified.get(pair, 0) > 0 for pair in requested),
        seconds=seconds,
    )


def _sorted_ids(id1: int, id2: int) -> IdPair:
    return (id1, id2) if id1 < id2 else (id2, id1)


def _in_tiles(pairs: Sequence[IdPair]) -> list[IdPair]:
    """Return the pairs in an order in which neighbours in the list share images."""
    ids = np.unique(pairs)
    ends = np.searchsorted(ids, pairs)
    graph = sparse.coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(len(ids), len(ids)))
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    place = np.empty(len(ids), np.int64)
    place[order] = np.arange(len(ids))
    tiles = np.sort(place[ends], axis=1) // TILE
    return [pairs[i] for i in np.lexsort((ends[:, 1], ends[:, 0], tiles[:, 1], tiles[:, 0]))]


def _match_all(
    database: Path, pairs: Sequence[IdPair], options: MatchOptions, advance: Callable[[int], None]
) -> None:
    most = 1 if pycolmap.has_cuda else options.processes or usable_processors()
    count = max(1, min(most, len(pairs) // WORTH_A_PROCESS))
    blocks = [pairs[at : at + BLOCK] for at in range(0, len(pairs), BLOCK)]
    with tempfile.TemporaryDirectory(prefix="colmap-netvlad-") as folder:
        jobs = []
        for number in range(count):
            own = Path(folder, f"{number}")
            own.mkdir()
            share = [pair for block in blocks[number::count] for pair in block]
            jobs.append(workers.Job(_match_in_chunks, (database, own, share, options.seed)))
        if count == 1:
            _match_in_chunks(advance, *jobs[0].arguments)
            return
        for outcome in workers.run(jobs, count, advance, initialiser=engine.initialiser()):
            if outcome.fault:
                raise InputError(
                    f"Matching stopped: {outcome.fault.rstrip('.')}. What is matched stays in "
                    f"{database}; run the command again to go on."
                )


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
    pycolmap.Database.open(scratch).close()
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
