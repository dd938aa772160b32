"""Copies of COLMAP databases, and of rows from one to another.

Rows are copied by column name: a migrated database has the same columns in another order, and
older versions lack some columns and tables. The source is only read.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from colmap_netvlad.colmap.database import Database, open_database, pair_id
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path, scratch_folder
from colmap_netvlad.runtime.sequences import listed

MATCHES = ("matches", "two_view_geometries")
"""Tables of image pairs."""

FEATURES = ("keypoints", "descriptors")
"""Tables of local features."""

CAMERAS = ("cameras", "rigs", "rig_sensors")
"""Small tables that every subset of images needs whole."""

SETTINGS = (*CAMERAS, "images", "frames", "frame_data", "pose_priors")
"""Tables of all that is neither features nor matches."""

COPY_ID = 0x636E7663
"""sqlite's `application_id` of the copies made here; COLMAP leaves it as it is."""

LOCK_SECONDS = 60.0
"""How long a process waits for the others' writing, a fraction of a second each."""

Rows = dict[str, tuple[list[str], list[tuple[Any, ...]]]]
"""Table -> its columns, and rows of values."""

AT_ONCE = 500
"""Keys in one query: sqlite takes 999 in its oldest versions."""


def copy_database(source: Path, target: Path, *, matches: bool) -> None:
    """Copy a database consistently; a waiting write-ahead log is included.

    Args:
        matches: False leaves matches and two-view geometries out, so that nothing one method
            matched leaks into another's result. They are not copied first: the matches of a
            large flight take gigabytes.

    Raises:
        InputError: the source cannot be read, or the target not be written.
    """
    with open_database(source) as old, _new_database(target) as new:
        if matches:
            old.connection.backup(new)
        else:
            _copy_tables(old.connection, new, but=MATCHES)
        new.execute("PRAGMA journal_mode = DELETE")
        new.execute(f"PRAGMA application_id = {COPY_ID}")


def renew_copy(source: Path, copy: Path) -> None:
    """Make a copy of a database, or bring it up to date: all is as in the source, and matches that
    only the copy has stay, where they are of unchanged features.

    Raises:
        InputError: the copy was not made by `copy_database` or has got images of its own, and is
            left as it is; or it cannot be written.
    """
    if not copy.exists():
        copy_database(source, copy, matches=True)
        return
    with open_database(source) as old, open_database(copy) as made:
        if made.connection.execute("PRAGMA application_id").fetchone() != (COPY_ID,):
            raise InputError(
                f"{copy} is there already, was not made as the copy of {source}, and is left as it "
                "is: rename it, or name it as `database`."
            )
        theirs, ours = _features(old), _features(made)
        if ours == theirs and _settings(old) == _settings(made):
            return
        own = sorted({name for name, *_ in ours.values()} - {name for name, *_ in theirs.values()})
        if own:
            raise InputError(
                f"{copy} has photos that {source} does not have ({listed(own)}), and is left as it "
                "is: name it as `database` to go on with it, or delete it for a new copy."
            )
        same = {image_id for image_id, features in ours.items() if theirs.get(image_id) == features}
        pairs = [
            pair_id(*pair)
            for pair in made.matched_pairs() - old.matched_pairs()
            if same.issuperset(pair)
        ]
    with scratch_folder(copy.parent) as folder:
        fresh = folder / copy.name
        copy_database(source, fresh, matches=True)
        copy_matches(copy, fresh, pairs)
        try:
            for log in ("-wal", "-shm"):  # of a killed run: sqlite would play it into the new file
                copy.with_name(copy.name + log).unlink(missing_ok=True)
            fresh.replace(copy)
        except OSError as fault:
            raise InputError(f"Cannot write {copy}: {fault.strerror or fault}.") from fault


def copy_with_pairs(source: Path, target: Path, pairs: Collection[tuple[str, str]]) -> None:
    """Copy a database with the matches of these pairs of image names only.

    Local descriptors are left out: mapping does not read them, and they are most of the file.

    Raises:
        InputError: the source cannot be read, or the target not be written.
    """
    with open_database(source) as old, _new_database(target) as new:
        ids = {row.name: row.image_id for row in old.images()}
        wanted = [pair_id(ids[a], ids[b]) for a, b in pairs]
        _copy_tables(old.connection, new, but=("descriptors",), pairs=wanted)


def copy_images(source: Path, target: Path, names: Iterable[str]) -> None:
    """Write what mapping needs of some images: keypoints and verified matches, same ids.

    Images of one rig frame stay together: the frame's other images come along. Descriptors,
    raw matches and position priors are left out.

    Raises:
        InputError: the source cannot be read, or the target not be written.
    """
    with open_database(source) as old, _new_database(target) as new:
        wanted = set(names)
        ids = old.with_frames({row.image_id for row in old.images() if row.name in wanted})
        pairs = [
            pair_id(*pair)
            for pair, count in old.verified_matches().items()
            if count and ids.issuperset(pair)
        ]
        frames = {frame for image, frame in old.frames().items() if image in ids}
        _create(old.connection, new, tables=True)
        for table in CAMERAS:
            _copy_rows(old.connection, new, table)
        for table in ("images", "keypoints"):
            _copy_rows(old.connection, new, table, "image_id", ids)
        _copy_rows(old.connection, new, "two_view_geometries", "pair_id", pairs)
        for table in ("frames", "frame_data"):
            _copy_rows(old.connection, new, table, "frame_id", frames)
        _create(old.connection, new, tables=False)


def copy_features(source: Path, target: Path, aliases: Mapping[int, str]) -> None:
    """Copy images under other names, with cameras and local features, to an empty database.

    Args:
        aliases: the name in `target` by image id.

    Raises:
        InputError: the source cannot be read.
    """
    with (
        open_database(source, LOCK_SECONDS) as old,
        closing(sqlite3.connect(target, timeout=LOCK_SECONDS)) as new,
    ):
        _copy_rows(old.connection, new, "cameras")
        new.executemany(
            "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, ?)",
            [
                (row.image_id, aliases[row.image_id], row.camera_id)
                for row in old.images()
                if row.image_id in aliases
            ],
        )
        for table in FEATURES:
            _copy_rows(old.connection, new, table, "image_id", aliases)
        new.commit()


def keep_images(copy: Path, ids: Collection[int]) -> None:
    """Delete all images but some, with their features, from a copy that is to be searched."""
    with closing(sqlite3.connect(copy)) as database:
        database.execute("CREATE TEMP TABLE kept (image_id INTEGER PRIMARY KEY)")
        database.executemany("INSERT INTO kept VALUES (?)", [(i,) for i in ids])
        for table in (*FEATURES, "images"):
            database.execute(f"DELETE FROM {table} WHERE image_id NOT IN kept")
        database.commit()


def copy_matches(source: Path, target: Path, pairs: Collection[int]) -> None:
    """Copy the results of some pairs, by their ids, whole or not at all.

    What `target` has of these pairs is replaced; other processes may be writing it as well.

    Raises:
        InputError: the source cannot be read.
    """
    with (
        open_database(source) as old,
        closing(sqlite3.connect(target, timeout=LOCK_SECONDS, isolation_level=None)) as new,
    ):
        # A transaction that reads before it writes fails at once where another process has
        # written in between; one that starts as a writer waits for its turn.
        new.execute("BEGIN IMMEDIATE")
        for table in MATCHES:
            _copy_rows(old.connection, new, table, "pair_id", pairs)
        new.commit()


def read_rows(source: Path, tables: Mapping[str, tuple[str, Iterable[int]] | None]) -> Rows:
    """Return rows for `write_rows`.

    Args:
        tables: table -> a column and its values; None for all rows. Absent tables are passed over.

    Raises:
        InputError: the source cannot be read.
    """
    with open_database(source) as old:
        return {table: _read_rows(old.connection, table, keys) for table, keys in tables.items()}


def write_rows(target: Path, rows: Rows) -> None:
    """Write rows whole or not at all; what `target` has under their keys is replaced."""
    with closing(sqlite3.connect(target, timeout=LOCK_SECONDS, isolation_level=None)) as new:
        new.execute("BEGIN IMMEDIATE")
        for table, (columns, values) in rows.items():
            there = _columns(new, table)
            kept = [i for i, column in enumerate(columns) if column in there]
            names = ", ".join(f'"{columns[i]}"' for i in kept)
            places = ", ".join("?" * len(kept))
            if kept:
                new.executemany(
                    f'INSERT OR REPLACE INTO "{table}" ({names}) VALUES ({places})',
                    [[row[i] for i in kept] for row in values],
                )
        new.commit()


@contextmanager
def _new_database(target: Path) -> Iterator[sqlite3.Connection]:
    with atomic_path(target) as temporary, closing(sqlite3.connect(temporary)) as new:
        yield new
        new.commit()


def _copy_tables(
    old: sqlite3.Connection,
    new: sqlite3.Connection,
    *,
    but: Collection[str],
    pairs: Collection[int] | None = None,
) -> None:
    """Copy the schema, and the rows of all tables `but` some; of `pairs` only where given."""
    old.execute("BEGIN")  # all tables as they are at one moment
    for table in _create(old, new, tables=True):
        if table in but:
            continue
        if pairs is not None and table in MATCHES:
            _copy_rows(old, new, table, "pair_id", pairs)
        else:
            _copy_rows(old, new, table)
    _create(old, new, tables=False)
    old.execute("ROLLBACK")


def _create(old: sqlite3.Connection, new: sqlite3.Connection, *, tables: bool) -> list[str]:
    """Create the tables, or the indices and whatever else stands on filled ones."""
    names = []
    for name, statement in old.execute(
        "SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL"
        f" AND name NOT LIKE 'sqlite_%' AND type {'=' if tables else '<>'} 'table'"
    ).fetchall():
        new.execute(statement)
        names.append(name)
    (version,) = old.execute("PRAGMA user_version").fetchone()
    new.execute(f"PRAGMA user_version = {version}")
    return names


def _copy_rows(
    old: sqlite3.Connection,
    new: sqlite3.Connection,
    table: str,
    key: str | None = None,
    values: Iterable[int] = (),
) -> None:
    """Copy a table whole, or the rows with a key; a table or column that one lacks is skipped."""
    there = _columns(new, table)
    names = [f'"{name}"' for name in _columns(old, table) if name in there]
    if not names:
        return
    columns = ", ".join(names)
    places = ", ".join("?" * len(names))
    insert = f'INSERT OR REPLACE INTO "{table}" ({columns}) VALUES ({places})'
    select = f'SELECT {columns} FROM "{table}"'
    if key is None:
        new.executemany(insert, old.execute(select))
        return
    keys = sorted(values)
    for at in range(0, len(keys), AT_ONCE):
        some = keys[at : at + AT_ONCE]
        wanted = f" WHERE {key} IN ({', '.join('?' * len(some))}) ORDER BY {key}"
        new.executemany(insert, old.execute(select + wanted, some))


def _read_rows(
    connection: sqlite3.Connection, table: str, keys: tuple[str, Iterable[int]] | None
) -> tuple[list[str], list[tuple[Any, ...]]]:
    columns, rows = _columns(connection, table), []
    if columns and keys is None:
        rows = connection.execute(f'SELECT * FROM "{table}"').fetchall()
    elif columns and keys is not None:
        values = sorted(keys[1])
        for at in range(0, len(values), AT_ONCE):
            some = values[at : at + AT_ONCE]
            wanted = f"{keys[0]} IN ({', '.join('?' * len(some))}) ORDER BY {keys[0]}"
            rows += connection.execute(f'SELECT * FROM "{table}" WHERE {wanted}', some).fetchall()
    return columns, rows


def _features(database: Database) -> dict[int, tuple[str, int | None, str | None]]:
    """Return each image's name, number of keypoints and fingerprint of descriptors, by image id."""
    counts, fingerprints = database.keypoint_counts(), database.feature_fingerprints()
    return {
        row.image_id: (row.name, counts.get(row.image_id), fingerprints.get(row.image_id))
        for row in database.images()
    }


def _settings(database: Database) -> Rows:
    return {table: _read_rows(database.connection, table, None) for table in SETTINGS}


def _columns(connection: sqlite3.Connection, table: str) -> list[str]:
    return [row[1] for row in connection.execute(f'PRAGMA table_info("{table}")')]
