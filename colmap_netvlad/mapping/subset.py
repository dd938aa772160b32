"""A small COLMAP database of some images of a large one, for a mapper in its own process.

COLMAP's mapper loads the matches of the whole database whatever images it is to map; a cluster's
own database keeps a worker's memory to that of its cluster, and leaves the user's file alone.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

from colmap_netvlad.colmap.database import Database, open_database, pair_id
from colmap_netvlad.runtime.files import atomic_path

COPIED_WHOLE = ("cameras", "rigs", "rig_sensors")
"""Small tables that every subset needs."""


def write_subset(source: Path, target: Path, names: Iterable[str]) -> None:
    """Write what mapping needs of some images: keypoints and verified matches, same ids.

    Images of one rig frame stay together: the frame's other images come along. Descriptors,
    raw matches and position priors are left out.

    Raises:
        InputError: the source cannot be read, or the target not be written.
    """
    with open_database(source) as database, atomic_path(target) as temporary:
        wanted = set(names)
        ids = _with_frames(database, {i.image_id for i in database.images() if i.name in wanted})
        pairs = [
            pair_id(*pair)
            for pair, count in database.verified_matches().items()
            if count and ids.issuperset(pair)
        ]
        frames = {frame for image, frame in database.frames().items() if image in ids}
        with (
            closing(sqlite3.connect(source.resolve().as_uri() + "?mode=ro", uri=True)) as old,
            closing(sqlite3.connect(temporary)) as new,
        ):
            _copy_schema(old, new)
            for table in COPIED_WHOLE:
                _copy_rows(old, new, table)
            _copy_rows(old, new, "images", "image_id", sorted(ids))
            _copy_rows(old, new, "keypoints", "image_id", sorted(ids))
            _copy_rows(old, new, "two_view_geometries", "pair_id", sorted(pairs))
            _copy_rows(old, new, "frames", "frame_id", sorted(frames))
            _copy_rows(old, new, "frame_data", "frame_id", sorted(frames))
            new.commit()


def _with_frames(database: Database, ids: set[int]) -> set[int]:
    frames = database.frames()
    touched = {frames[image] for image in ids if image in frames}
    return ids | {image for image, frame in frames.items() if frame in touched}


def _copy_schema(old: sqlite3.Connection, new: sqlite3.Connection) -> None:
    for (sql,) in old.execute(
        "SELECT sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%'"
        " ORDER BY type = 'table' DESC"
    ).fetchall():
        new.execute(sql)
    (version,) = old.execute("PRAGMA user_version").fetchone()
    new.execute(f"PRAGMA user_version = {version}")


def _copy_rows(
    old: sqlite3.Connection,
    new: sqlite3.Connection,
    table: str,
    key: str | None = None,
    values: Sequence[int] = (),
) -> None:
    """Copy a table whole, or the rows with a key; a table older COLMAPs lack is skipped."""
    columns = len(old.execute(f"PRAGMA table_info({table})").fetchall())
    if not columns:
        return
    insert = f"INSERT INTO {table} VALUES ({', '.join('?' * columns)})"
    if key is None:
        new.executemany(insert, old.execute(f"SELECT * FROM {table}"))
        return
    select = f"SELECT * FROM {table} WHERE {key} = ?"
    for value in values:
        new.executemany(insert, old.execute(select, (value,)))
