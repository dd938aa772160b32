"""Pairs -> matches and two-view geometries in the database, through pycolmap.

Pairs are matched in chunks of a few seconds, each written when done: a stopped run loses one
chunk at most, and the next run goes on with the rest, since COLMAP never matches a pair twice.
"""

from __future__ import annotations

import sqlite3
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from colmap_netvlad import engine, progress
from colmap_netvlad.database import open_database, pair_id
from colmap_netvlad.errors import InputError
from colmap_netvlad.pairs import in_colmap_list

FIRST_CHUNK = 32
"""Pairs of the first chunk; the next ones are sized to take `CHUNK_SECONDS`."""

CHUNK_SECONDS = 5.0
MAX_CHUNK = 4096


@dataclass(frozen=True)
class MatchOptions:
    """How pairs are matched; the rest is COLMAP's default.

    Attributes:
        seed: seed of the robust estimation, so that a pair always gives the same inliers.
        threads: threads; None: all processors.
    """

    seed: int = 0
    threads: int | None = None


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

    pycolmap brings a database of COLMAP 3.x to the schema of COLMAP 4. COLMAP's pairs list splits
    a line on spaces, so pairs of names with spaces are matched in a temporary database under
    other names and their results copied, in one transaction a chunk.

    Raises:
        InputError: an unknown image name, no features at all, or a database that cannot be
            written.
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
    # In the order of ids, neighbours in the list share an image that COLMAP then has in memory.
    requested = sorted({_sorted_ids(ids[a], ids[b]) for a, b in pairs if a != b})
    todo = [pair for pair in requested if pair not in done]
    names = {image_id: name for name, image_id in ids.items()}
    start = time.monotonic()
    with progress.step("Matching pairs", len(todo)) as bar:
        listed = [pair for pair in todo if all(in_colmap_list(names[i]) for i in pair)]
        aliased = [pair for pair in todo if not all(in_colmap_list(names[i]) for i in pair)]
        _in_chunks(listed, bar, lambda chunk: _match(database, chunk, names, options))
        if aliased:
            pycolmap.Database.open(database).close()  # brings an old schema up to date
        _in_chunks(aliased, bar, lambda chunk: _match_under_aliases(database, chunk, options))
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


IdPair = tuple[int, int]


def _sorted_ids(id1: int, id2: int) -> IdPair:
    return (id1, id2) if id1 < id2 else (id2, id1)


def _in_chunks(
    pairs: Sequence[IdPair], bar: progress.Step, match: Callable[[Sequence[IdPair]], None]
) -> None:
    """Match all pairs in chunks that take about `CHUNK_SECONDS`."""
    size, at = FIRST_CHUNK, 0
    while at < len(pairs):
        chunk = pairs[at : at + size]
        start = time.monotonic()
        match(chunk)
        bar.advance(len(chunk))
        at += len(chunk)
        rate = len(chunk) / max(time.monotonic() - start, 1e-3)
        size = int(min(max(rate * CHUNK_SECONDS, 1), 4 * size, MAX_CHUNK))


def _match(
    database: Path, pairs: Sequence[IdPair], names: dict[int, str], options: MatchOptions
) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    if options.threads is not None:
        matching.num_threads = options.threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    with tempfile.TemporaryDirectory(prefix="colmap-netvlad-") as folder:
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = Path(folder, "pairs.txt")
        lines = (f"{names[a]} {names[b]}\n" for a, b in pairs)
        pairing.match_list_path.write_text("".join(lines), encoding="utf-8")
        engine.call(
            pycolmap.match_image_pairs,
            database.parent,
            database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
        )


def _match_under_aliases(database: Path, pairs: Sequence[IdPair], options: MatchOptions) -> None:
    """Match pairs whose names COLMAP's list cannot hold, in a database of their features alone."""
    images = sorted({image_id for pair in pairs for image_id in pair})
    aliases = {image_id: f"image{image_id}" for image_id in images}
    with tempfile.TemporaryDirectory(prefix="colmap-netvlad-") as folder:
        scratch = Path(folder, "aliases.db")
        pycolmap.Database.open(scratch).close()
        _copy_features(database, scratch, aliases)
        _match(scratch, pairs, aliases, options)
        _copy_matches(scratch, database, [pair_id(*pair) for pair in pairs])


def _copy_features(source: Path, target: Path, aliases: dict[int, str]) -> None:
    with closing(sqlite3.connect(target)) as connection:
        connection.execute("ATTACH ? AS source", (f"{source.resolve()}",))
        connection.execute("CREATE TEMP TABLE wanted (image_id INTEGER PRIMARY KEY, alias TEXT)")
        connection.executemany("INSERT INTO wanted VALUES (?, ?)", aliases.items())
        _copy_rows(connection, "cameras")
        connection.execute(
            "INSERT INTO images (image_id, name, camera_id)"
            " SELECT image_id, alias, camera_id FROM source.images JOIN wanted USING (image_id)"
        )
        for table in ("keypoints", "descriptors"):
            _copy_rows(connection, table, "WHERE image_id IN (SELECT image_id FROM wanted)")
        connection.commit()


def _copy_matches(source: Path, target: Path, pairs: Sequence[int]) -> None:
    """Copy the results of some pairs whole or not at all."""
    with closing(sqlite3.connect(target, timeout=engine.LOCK_SECONDS)) as connection:
        connection.execute("ATTACH ? AS source", (f"{source.resolve()}",))
        connection.execute("CREATE TEMP TABLE wanted (pair_id INTEGER PRIMARY KEY)")
        connection.executemany("INSERT INTO wanted VALUES (?)", [(pair,) for pair in pairs])
        for table in ("matches", "two_view_geometries"):
            _copy_rows(connection, table, "WHERE pair_id IN (SELECT pair_id FROM wanted)")
        connection.commit()


def _copy_rows(connection: sqlite3.Connection, table: str, where: str = "") -> None:
    """Copy rows by column name: a migrated database has the same columns in another order."""
    columns = ", ".join(row[1] for row in connection.execute(f"PRAGMA main.table_info({table})"))
    connection.execute(
        f"INSERT OR REPLACE INTO main.{table} ({columns})"
        f" SELECT {columns} FROM source.{table} {where}"
    )
