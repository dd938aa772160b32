"""The cache beside the database: photos seen, descriptors, cells, settings, in one file.

Descriptors are kept by image name, content fingerprint of the photo and fingerprint of the
model, so that a second run computes nothing, ten new photos cost ten photos, and a photo
changed on disk is described again. Every batch is one transaction: a killed run goes on where
it stopped, and two processes at once wait for each other instead of losing rows.

Descriptors are kept a byte a value: a quarter of the space, and for L2-normalised vectors of 4,096
to 32,768 values the inner product changes by less than 1e-3 (a test). Of the 100 nearest of 996
photos one in a thousand changed (docs/training-log.md, section 15).
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
import sqlite_utils
from numpy.typing import NDArray

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.codes import decode, encode
from colmap_netvlad.runtime.errors import InputError

FORMAT = 3
"""Version of the tables below, kept in `PRAGMA user_version`."""

READ_FORMATS = (1, 2, FORMAT)
"""Versions that are read. An older one forgets descriptors and cells, which were twice as long."""

APPLICATION = 0x4E56_4C44
"""`PRAGMA application_id` that marks the file as ours ("NVLD")."""

BUSY_SECONDS = 60.0
"""How long one process waits for another's transaction."""

ORPHANS_SETTING = "orphans"
"""Set where cells were replaced: what was counted for the old ones is pruned at the next open."""

IMAGES_SETTING = "images"
"""The photo folder: absolute, or relative to the cache where it lies below it."""

PLACE_SETTING = "place"
"""Where the cache was when it was told an absolute photo folder: copied to another project, it says
nothing of that one's photos."""


@dataclass(frozen=True)
class SeenPhoto:
    """What is known of a photo file as long as its size and time stay the same.

    Attributes:
        stamp: size and time of the file.
        content: fingerprint of what is in it, or None where it was not needed yet.
        gps: latitude, longitude, height as JSON; "" where the photo has none; None where nobody
            looked yet.
    """

    stamp: str
    content: str | None = None
    gps: str | None = None


@dataclass(frozen=True, eq=False)
class Codebook:
    """Words learned on a project.

    Attributes:
        words: (K, dim) float32.
        images: how many images they were learned on.
        seconds: what learning them took, s.
    """

    words: NDArray[np.float32]
    images: int
    seconds: float


class Store:
    """The cache file of a project; made when it is not there. Use it as a context manager.

    Raises:
        InputError: the file is damaged, of another version, not a cache, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._faults():
            connection = sqlite3.connect(path, timeout=BUSY_SECONDS, isolation_level=None)
            self._db = sqlite_utils.Database(connection)
            try:
                self._open()
            except BaseException:
                self.close()
                raise

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        fault: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._db.conn.close()

    # Photos

    def photos(self) -> dict[str, SeenPhoto]:
        """Return what is known of photo files, by the key they were kept under."""
        with self._faults():
            rows = self._db.execute("SELECT file, stamp, content, gps FROM photos").fetchall()
            return {
                file: SeenPhoto(
                    _text_or_none(stamp) or "", _text_or_none(content), _text_or_none(gps)
                )
                for file, stamp, content, gps in rows
            }

    def keep_photos(self, seen: Mapping[str, SeenPhoto]) -> None:
        """Keep what is known of photo files in one transaction."""
        if seen:
            rows = ({"file": file, **asdict(photo)} for file, photo in seen.items())
            with self._transaction():
                self._db["photos"].insert_all(rows, replace=True)

    # Descriptors

    def described(self, model: str) -> dict[str, str]:
        """Return the photo's fingerprint by image name, of all images described by a model."""
        with self._faults():
            rows = self._db.execute("SELECT image, photo FROM descriptors WHERE model = ?", [model])
            return dict(rows.fetchall())

    def add_descriptors(
        self,
        model: str,
        names: Sequence[str],
        photos: Sequence[str],
        vectors: NDArray[np.floating],
        seconds: float,
        cells: Sequence[Cells] = (),
    ) -> None:
        """Keep a batch of descriptors in one transaction; older ones of these images go, but cells
        of the same photo stay, and keep their number.

        Args:
            model: the model's fingerprint.
            names: B image names.
            photos: B fingerprints of the photos the vectors were computed from.
            vectors: (B, D) descriptors, L2-normalised.
            seconds: what describing the batch took, s.
            cells: of the B photos, or none.
        """
        share = seconds / max(len(names), 1)
        rows = (
            {
                "model": model,
                "image": name,
                "photo": photo,
                "seconds": share,
                "vector": encode(vector).tobytes(),
            }
            for name, photo, vector in zip(names, photos, vectors, strict=True)
        )
        codes = [
            {
                "model": model,
                "image": name,
                "photo": photo,
                "height": grid.codes.shape[0],
                "width": grid.codes.shape[1],
                "codes": grid.codes.tobytes(),
            }
            for name, photo, grid in zip(names, photos, cells, strict=False)
        ]
        with self._transaction():
            self._db["descriptors"].insert_all(rows, replace=True)
            self._add_cells(codes)

    def _add_cells(self, rows: Sequence[Mapping[str, object]]) -> None:
        # Cells of the same photo stay: another run may be comparing by their number.
        gone = self._db.conn.executemany(
            "DELETE FROM cells WHERE model = :model AND image = :image AND photo <> :photo", rows
        )
        if gone.rowcount > 0:
            self._db["settings"].insert({"key": ORPHANS_SETTING, "value": "1"}, replace=True)
        self._db["cells"].insert_all(rows, ignore=True)

    def seconds(self, model: str, names: Iterable[str]) -> float:
        """Return what describing these images, which are described, took when it was done, s."""
        with self._faults():
            rows = self._db.execute(
                "SELECT image, seconds FROM descriptors WHERE model = ?", [model]
            )
            spent = dict(rows.fetchall())
            unknown = [name for name in names if name not in spent]
            if unknown:
                raise ValueError(f"it has no descriptor of {unknown[0]}")
            return float(sum(spent[name] for name in names))

    def vectors(self, model: str, names: Sequence[str]) -> StoredVectors:
        """Return the descriptors of these images as rows that are read when they are sliced."""
        return StoredVectors(self, model, tuple(names))

    def read_vectors(self, model: str, names: Sequence[str]) -> NDArray[np.float32]:
        """Return (B, D) descriptors of these images, L2-normalised.

        Raises:
            InputError: one of them is not described.
        """
        query = "SELECT vector FROM descriptors WHERE model = ? AND image = ?"
        blobs = []
        with self._faults():
            for name in names:
                row = self._db.execute(query, [model, name]).fetchone()
                if row is None:
                    raise ValueError(f"it has no descriptor of {name}")
                blobs.append(row[0])
            if len({len(blob) for blob in blobs}) > 1:
                raise ValueError("descriptors of different lengths")
            return decode(np.frombuffer(b"".join(blobs), np.int8).reshape(len(blobs), -1))

    # Cells: what networks saw, place by place

    def described_in_cells(self, model: str) -> dict[str, str]:
        """Return the photo's fingerprint by image name, of all images with cells."""
        with self._faults():
            rows = self._db.execute("SELECT image, photo FROM cells WHERE model = ?", [model])
            return dict(rows.fetchall())

    def cell_numbers(self, model: str) -> dict[str, int]:
        """Return the number of each image's cells, by image name.

        A number is never given again: the cells of a changed photo have another one.
        """
        with self._faults():
            rows = self._db.execute("SELECT image, number FROM cells WHERE model = ?", [model])
            return dict(rows.fetchall())

    def number(self, kind: str, photos: Mapping[str, str]) -> None:
        """Give images a number under a kind of features that are not kept here but read where they
        lie; where they changed, another one.

        Args:
            kind: as `model` of cells.
            photos: name -> fingerprint of the features.
        """
        known = self.described_in_cells(kind)
        rows = [
            {"model": kind, "image": name, "photo": photo, "height": 0, "width": 0, "codes": b""}
            for name, photo in photos.items()
            if known.get(name) != photo
        ]
        if rows:
            with self._transaction():
                self._add_cells(rows)

    def read_cells(self, number: int) -> Cells:
        """Return the cells of that number.

        Raises:
            InputError: there are none any more.
        """
        with self._faults():
            row = self._db.execute(
                "SELECT height, width, codes FROM cells WHERE number = ?", [number]
            ).fetchone()
            if row is None:
                raise InputError(
                    f"Another run has changed the cache {self.path} meanwhile; run the command "
                    "again: what was computed is kept."
                )
            height, width, codes = row
            return Cells(np.frombuffer(codes, np.int8).reshape(height, width, -1))

    def agreements(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return what was counted so far, in the order of the numbers.

        Returns:
            (M, 2) numbers of two photos' cells, lower first; (M,) their agreeing matches;
            (M,) what counting them took, s.
        """
        row = np.dtype([("pair", np.int64, 2), ("matches", np.int64), ("seconds", np.float64)])
        with self._faults():
            found = self._db.execute(
                "SELECT first, second, matches, seconds FROM agreements ORDER BY first, second"
            )
            # Row by row: 20,000 images have a million pairs.
            table = np.fromiter((((a, b), count, spent) for a, b, count, spent in found), row)
        return table["pair"], table["matches"], table["seconds"]

    def add_agreements(self, rows: Iterable[tuple[int, int, int, float]]) -> None:
        """Keep (first, second, matches, seconds) of compared pairs in one transaction."""
        with self._transaction():
            self._db.conn.executemany("INSERT OR REPLACE INTO agreements VALUES (?, ?, ?, ?)", rows)

    # Codebooks

    def codebook(self, key: str) -> Codebook | None:
        """Return a codebook, or None: also where it was kept before its seconds were."""
        with self._faults():
            row = next(self._db["codebooks"].rows_where("key = ?", [key]), None)
            if row is None or row.get("seconds") is None:
                return None
            words = np.frombuffer(row["words"], np.float32).reshape(-1, row["dim"])
            return Codebook(words, int(row["images"]), float(row["seconds"]))

    def keep_codebook(self, key: str, codebook: Codebook) -> None:
        """Keep a codebook under a key."""
        row = {
            "key": key,
            "images": codebook.images,
            "dim": codebook.words.shape[1],
            "words": codebook.words.tobytes(),
            "seconds": codebook.seconds,
        }
        with self._transaction():
            # The table of an earlier version has no seconds.
            self._db["codebooks"].insert(row, replace=True, alter=True)

    # Settings

    def setting(self, key: str) -> str | None:
        """Return a remembered value, or None."""
        with self._faults():
            row = self._db.execute("SELECT value FROM settings WHERE key = ?", [key]).fetchone()
            return None if row is None else _text_or_none(row[0])

    def remember(self, key: str, value: str) -> None:
        """Remember a value under a key; writes only where it differs."""
        if self.setting(key) != value:
            with self._transaction():
                self._db["settings"].insert({"key": key, "value": value}, replace=True)

    # The file

    def remember_images(self, folder: Path) -> None:
        """Keep the photo folder; as part of the workspace it moves with it."""
        folder, base = folder.resolve(), self.path.parent.resolve()
        inside = folder.is_relative_to(base)
        self.remember(IMAGES_SETTING, os.path.relpath(folder, base) if inside else str(folder))
        self.remember(PLACE_SETTING, str(base))

    def _open(self) -> None:
        application, tables, version = self._header()
        if application != APPLICATION and tables:
            raise InputError(
                f"{self.path} is not a cache of colmap-netvlad; name another file with `cache`."
            )
        if tables and version not in READ_FORMATS:
            raise InputError(
                f"The cache {self.path} has format {version}, this version of colmap-netvlad reads "
                f"format {FORMAT}; delete the file (it is made again), or name another with "
                "`cache`."
            )
        if not tables:
            # Large pages: a descriptor of 32 KiB then lies in few of them.
            self._db.execute("PRAGMA page_size = 32768")
            self._log_ahead()
        if version != FORMAT:
            self._create()
        if self.setting(ORPHANS_SETTING):
            self._prune()

    def _create(self) -> None:
        """Make the tables, or bring those of an older version up to date."""
        with self._transaction():
            if self._pragma("user_version") == FORMAT:
                return  # another process was quicker: what it keeps by now must stay
            for old in ("rankings", "descriptors", "local_features", "cells", "agreements"):
                self._db.execute(f"DROP TABLE IF EXISTS {old}")
            self._db["descriptors"].create(
                {"model": str, "image": str, "photo": str, "seconds": float, "vector": bytes},
                pk=("model", "image"),
                not_null={"photo", "seconds", "vector"},
                if_not_exists=True,
            )
            self._db["codebooks"].create(
                {"key": str, "images": int, "dim": int, "words": bytes, "seconds": float},
                pk="key",
                if_not_exists=True,
            )
            self._db["settings"].create({"key": str, "value": str}, pk="key", if_not_exists=True)
            self._db["photos"].create(
                {"file": str, "stamp": str, "content": str, "gps": str},
                pk="file",
                not_null={"stamp"},
                if_not_exists=True,
            )
            # AUTOINCREMENT: the number of cells that are gone is not given again.
            self._db.execute(
                "CREATE TABLE IF NOT EXISTS cells (number INTEGER PRIMARY KEY AUTOINCREMENT,"
                " model TEXT NOT NULL, image TEXT NOT NULL, photo TEXT NOT NULL,"
                " height INTEGER NOT NULL, width INTEGER NOT NULL, codes BLOB NOT NULL,"
                " UNIQUE (model, image))"
            )
            self._db.execute(
                "CREATE TABLE IF NOT EXISTS agreements (first INTEGER, second INTEGER,"
                " matches INTEGER NOT NULL, seconds REAL NOT NULL, PRIMARY KEY (first, second))"
                " WITHOUT ROWID"
            )
            self._db.execute(f"PRAGMA application_id = {APPLICATION}")
            self._db.execute(f"PRAGMA user_version = {FORMAT}")

    def _prune(self) -> None:
        """Forget what was counted for cells that have been replaced since."""
        with self._transaction():
            self._db.execute(
                "DELETE FROM agreements WHERE first NOT IN (SELECT number FROM cells)"
                " OR second NOT IN (SELECT number FROM cells)"
            )
            self._db.execute("DELETE FROM settings WHERE key = ?", [ORPHANS_SETTING])

    def _header(self) -> tuple[int, int, int]:
        """Return application, schema version (0: no tables) and format, all of one moment."""
        names = ("application_id", "schema_version", "user_version")
        self._db.execute("BEGIN")
        try:
            first, second, third = (self._pragma(name) for name in names)
        finally:
            if self._db.conn.in_transaction:
                self._db.execute("ROLLBACK")
        return first, second, third

    def _pragma(self, name: str) -> int:
        return int(self._db.execute(f"PRAGMA {name}").fetchone()[0])

    def _log_ahead(self) -> None:
        """Turn the write-ahead log on; here alone SQLite does not wait for another process."""
        deadline = time.monotonic() + BUSY_SECONDS
        while True:
            try:
                self._db.execute("PRAGMA journal_mode = WAL")
                return
            except sqlite3.OperationalError as fault:
                if "locked" not in str(fault) or time.monotonic() > deadline:
                    raise
                time.sleep(0.02)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._faults():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.conn.in_transaction:
                    self._db.execute("ROLLBACK")
                raise

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as fault:
            raise InputError(_sentence(self.path, str(fault))) from fault
        except (sqlite3.DatabaseError, TypeError, ValueError, OverflowError) as fault:
            raise InputError(
                f"The cache {self.path} is damaged ({fault}); delete it: descriptors are computed "
                "again, nothing else is lost."
            ) from fault


class StoredVectors:
    """(N, D) descriptors in a store, read from the file as they are sliced: `vectors[10:20]`.

    Attributes:
        shape: (N, D).
    """

    def __init__(self, store: Store, model: str, names: tuple[str, ...]) -> None:
        self._store, self._model, self._names = store, model, names
        dim = store.read_vectors(model, names[:1]).shape[1] if names else 0
        self.shape = (len(names), dim)

    def __getitem__(self, rows: slice) -> NDArray[np.float32]:
        return self._store.read_vectors(self._model, self._names[rows])


def remembered_images(cache: Path) -> Path | None:
    """Return the photo folder that a cache remembers, or None; makes no file."""
    if not cache.is_file():
        return None
    with Store(cache) as store:
        folder, place = store.setting(IMAGES_SETTING), store.setting(PLACE_SETTING)
    if folder is None:
        return None
    moved = place is not None and place != str(cache.parent.resolve())
    return None if moved and Path(folder).is_absolute() else cache.parent / folder


def _text_or_none(value: object) -> str | None:
    if value is None or isinstance(value, str):
        return value
    raise TypeError(f"{type(value).__name__} in place of a text")


def _sentence(path: Path, fault: str) -> str:
    if "locked" in fault:
        return (
            f"The cache {path} has been locked by another process for {BUSY_SECONDS:.0f} s; "
            "wait for it to finish."
        )
    if "full" in fault:
        return f"Cannot write the cache {path}: the disk is full. What was computed so far is kept."
    if "malformed" in fault or "not a database" in fault:
        return f"The cache {path} is damaged ({fault}); delete it: nothing else is lost."
    folder = "" if os.access(path.parent, os.W_OK) else " (the folder cannot be written)"
    return (
        f"Cannot use the cache {path}: {fault}{folder}; name a file in a folder that can be "
        "written with `cache`."
    )
