"""What is read from a COLMAP database, without changing it.

Opening a database with pycolmap 4 migrates it in place, even for a read. This module therefore
reads with plain sqlite in read-only mode, and is the only one that knows schema versions:
COLMAP 3.8 to 4.2 differ in `images.prior_*`, `pose_priors`, `frames` and
`two_view_geometries`; tables and columns are tested for, since `PRAGMA user_version` cannot
tell 3.10 from 3.13.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from colmap_netvlad.photos.files import leaves_folder
from colmap_netvlad.photos.positions import CoordinateSystem, PosePrior
from colmap_netvlad.runtime.errors import InputError

MAX_NUM_IMAGES = 2147483647
"""COLMAP's factor in `pair_id = MAX_NUM_IMAGES * min(id1, id2) + max(id1, id2)`."""

BUSY_SECONDS = 5.0
"""How long a read waits for another process's write, s; COLMAP itself waits not at all."""

FINGERPRINT_BYTES = 1024
"""Bytes of an image's descriptors that tell them from others, 8 SIFT features."""

SIFT_BYTES = 128
"""Bytes of one SIFT descriptor; `descriptors.cols` counts bytes."""

SIFT_TYPE = 0
"""`descriptors.type` of SIFT (COLMAP 4 on); -1 where a database was made before."""

MAPPED_MATCHES, DEGENERATE = 15, 1
"""COLMAP's mapper takes a pair up with at least this many verified matches (`min_num_matches`) and
a geometry of a kind (`config`) above this."""

SYSTEMS = frozenset(CoordinateSystem)

VALUE_BYTES = {"keypoints": 4, "descriptors": 1, "matches": 4, "two_view_geometries": 4}
"""Bytes of one value in a table's `data`, a blob of `rows` times `cols` values."""


@dataclass(frozen=True)
class ImageRow:
    """One image of the database. `name` is relative to the photo folder; sizes in pixels."""

    image_id: int
    name: str
    camera_id: int
    width: int
    height: int


@dataclass(frozen=True)
class InitialCamera:
    """A camera as it was before any adjustment: COLMAP's model number and parameters, and whether
    its focal length comes from EXIF (or from the user) rather than being a guess."""

    model: int
    params: tuple[float, ...]
    prior: bool


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """COLMAP's two-view geometry: its kind, and the (3, 3) matrices that were estimated."""

    config: int
    F: NDArray[np.float64] | None
    E: NDArray[np.float64] | None
    H: NDArray[np.float64] | None


def pair_id(image_id1: int, image_id2: int) -> int:
    """Return COLMAP's id of an image pair, whatever the order of its images."""
    low, high = sorted((image_id1, image_id2))
    return MAX_NUM_IMAGES * low + high


def images_of_pair(pair: int) -> tuple[int, int]:
    """Return the image ids (lower first) of COLMAP's pair id."""
    return pair // MAX_NUM_IMAGES, pair % MAX_NUM_IMAGES


class Database:
    """A COLMAP database, read only. Made by `open_database`.

    Attributes:
        connection: sqlite's, which refuses to write.
        path: the file.
    """

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self.connection = connection
        self.path = path

    def images(self) -> list[ImageRow]:
        """Return all images in the order of their ids.

        Raises:
            InputError: a row is damaged, or a name leads out of the photo folder.
        """
        rows = self.connection.execute(
            "SELECT i.image_id, i.name, i.camera_id, COALESCE(c.width, 0), COALESCE(c.height, 0)"
            " FROM images i LEFT JOIN cameras c USING (camera_id) ORDER BY i.image_id"
        )
        images = []
        for number, name, *rest in rows:
            if not (isinstance(name, str) and all(isinstance(value, int) for value in rest)):
                raise self._damaged("images", f"image {number}")
            if leaves_folder(name):
                raise InputError(
                    f"Image {number} of {self.path} is called {name!r}, which leads out of the "
                    "photo folder; rename it in the database, or restore the database."
                )
            images.append(ImageRow(number, name, *rest))
        return images

    def cameras(self) -> dict[int, InitialCamera]:
        """Return the cameras by their ids."""
        rows = self.connection.execute(
            "SELECT camera_id, model, params, prior_focal_length FROM cameras"
        )
        return {
            camera_id: InitialCamera(
                model, tuple(np.frombuffer(params or b"", np.float64).tolist()), bool(prior)
            )
            for camera_id, model, params, prior in rows
        }

    def keypoint_counts(self) -> dict[int, int]:
        """Return the number of keypoints by image id; images without features are absent.

        Raises:
            InputError: the keypoints of an image are damaged.
        """
        return self._counts("keypoints")

    def descriptor_counts(self) -> dict[int, int]:
        """Return the number of local descriptors by image id; images without are absent.

        Raises:
            InputError: the descriptors of an image are damaged.
        """
        return self._counts("descriptors")

    def images_with_features(self) -> set[int]:
        """Return the ids of images whose features COLMAP would not extract again (even if 0)."""
        rows = self.connection.execute(
            "SELECT image_id FROM keypoints INTERSECT SELECT image_id FROM descriptors"
        )
        return {image_id for (image_id,) in rows}

    def keypoints(self, image_id: int) -> NDArray[np.float32]:
        """Return (N, 2) keypoint positions x, y in pixels (COLMAP's: centre of pixel 0 is 0.5).

        Raises:
            InputError: they are damaged.
        """
        return self.keypoint_shapes(image_id)[:, :2]

    def keypoint_shapes(self, image_id: int) -> NDArray[np.float32]:
        """Return (N, 2), (N, 4) or (N, 6) keypoints: x, y; scale and orientation, or the four
        numbers of an affine shape.

        Raises:
            InputError: they are damaged.
        """
        return self._values("keypoints", "image_id", image_id, np.float32, 2)

    def sift_descriptors(self, image_id: int) -> NDArray[np.uint8]:
        """Return (N, 128) SIFT descriptors as COLMAP keeps them, 0..255.

        Raises:
            InputError: the local features are of another kind (ALIKED, say), or damaged.
        """
        values = self._values("descriptors", "image_id", image_id, np.uint8, SIFT_BYTES)
        if values.shape[1] != SIFT_BYTES:
            raise InputError(
                f"{self.path} has local features of {values.shape[1]} bytes, not SIFT's "
                f"{SIFT_BYTES}; use a method that reads the photos, or extract SIFT."
            )
        return values

    def has_sift(self) -> bool:
        """Whether there are SIFT descriptors and no others.

        Raises:
            InputError: what the database says of their kind is damaged.
        """
        known = "type" in self._columns("descriptors")
        kind = "MAX(type)" if known else str(SIFT_TYPE)
        longest, shortest, kind = self.connection.execute(
            f"SELECT MAX(cols), MIN(cols), {kind} FROM descriptors WHERE rows > 0"
        ).fetchone()
        if kind is None:
            return False  # there are none
        if not isinstance(kind, int):
            raise self._damaged("descriptors", "an image's kind of features")
        return longest == shortest == SIFT_BYTES and kind <= SIFT_TYPE

    def not_sift(self) -> set[int]:
        """Return the ids of images whose local descriptors are of another kind than SIFT."""
        kind = "type" if "type" in self._columns("descriptors") else str(SIFT_TYPE)
        rows = self.connection.execute(
            f"SELECT image_id FROM descriptors WHERE rows > 0 AND (cols <> ? OR {kind} > ?)",
            (SIFT_BYTES, SIFT_TYPE),
        )
        return {image_id for (image_id,) in rows}

    def feature_fingerprints(self) -> dict[int, str]:
        """Return a fingerprint of each image's local descriptors, by image id.

        Of their number, kind and first `FINGERPRINT_BYTES`, so that no descriptor has to be read:
        features extracted again differ there.
        """
        rows = self.connection.execute(
            "SELECT image_id, rows, cols, substr(data, 1, ?) FROM descriptors WHERE rows > 0",
            (FINGERPRINT_BYTES,),
        )
        return {
            image_id: hashlib.sha256(b"%d %d " % (count, size) + head).hexdigest()
            for image_id, count, size, head in rows
        }

    def verified_fingerprint(self) -> str:
        """Return a fingerprint of what mapping reads: images, their features, verified matches."""
        digest = hashlib.sha256()
        fingerprints = self.feature_fingerprints()
        for image in self.images():
            digest.update(f"{image} {fingerprints.get(image.image_id)}\n".encode())
        for pair, data in self.connection.execute(
            "SELECT pair_id, data FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
        ):
            digest.update(b"%d " % pair + data)
        return digest.hexdigest()

    def matched_pairs(self) -> set[tuple[int, int]]:
        """Return the pairs COLMAP's matchers would skip: those with matches and a geometry.

        Pairs of images that the database does not have (any more) are left out.
        """
        rows = self.connection.execute(
            "SELECT pair_id FROM matches INTERSECT SELECT pair_id FROM two_view_geometries"
        )
        known = self._image_ids()
        return {pair for (found,) in rows if known.issuperset(pair := images_of_pair(found))}

    def pairs_without_matches(self) -> set[tuple[int, int]]:
        """Return the pairs that were tried and have no match at all."""
        rows = self.connection.execute("SELECT pair_id FROM matches WHERE rows = 0")
        return {images_of_pair(found) for (found,) in rows}

    def verified_matches(self) -> dict[tuple[int, int], int]:
        """Return the number of verified (inlier) matches by pair of image ids, lower first.

        Pairs that were tried and failed have 0; pairs of images that the database does not have
        (any more) are left out.

        Raises:
            InputError: the matches of a pair are damaged.
        """
        known = self._image_ids()
        self._check_data("two_view_geometries", "pair_id")
        rows = self.connection.execute("SELECT pair_id, rows FROM two_view_geometries")
        return {
            pair: count for found, count in rows if known.issuperset(pair := images_of_pair(found))
        }

    def mapped_pairs(self) -> set[tuple[int, int]]:
        """Return the pairs that COLMAP's mapper takes up, ids ascending."""
        rows = self.connection.execute(
            "SELECT pair_id FROM two_view_geometries WHERE rows >= ? AND config > ?",
            (MAPPED_MATCHES, DEGENERATE),
        )
        known = self._image_ids()
        return {pair for (found,) in rows if known.issuperset(pair := images_of_pair(found))}

    def inlier_matches(self, image_id1: int, image_id2: int) -> NDArray[np.uint32]:
        """Return (M, 2) keypoint indices of the verified matches, columns as the ids are given.

        Raises:
            InputError: they are damaged, or of keypoints that an image does not have.
        """
        pair = pair_id(image_id1, image_id2)
        matches = self._values("two_view_geometries", "pair_id", pair, np.uint32, 2)
        if len(matches):
            self._check_keypoints(images_of_pair(pair), matches.max(axis=0).tolist())
        return matches if image_id1 <= image_id2 else matches[:, ::-1]

    def geometry(self, image_id1: int, image_id2: int) -> PairGeometry | None:
        """Return the two-view geometry of a pair, ids ascending; None where it was not verified.

        Raises:
            InputError: it is damaged.
        """
        row = self.connection.execute(
            "SELECT config, F, E, H FROM two_view_geometries WHERE pair_id = ? AND rows > 0",
            (pair_id(image_id1, image_id2),),
        ).fetchone()
        if row is None:
            return None
        if not isinstance(row[0], int):
            raise self._damaged(
                "two_view_geometries", f"{self._image(image_id1)} and {self._image(image_id2)}"
            )
        return PairGeometry(row[0], *(_matrix(blob) for blob in row[1:]))

    def pose_priors(self) -> dict[int, PosePrior]:
        """Return the position priors by image id, from any COLMAP version.

        COLMAP 3.8 and 3.9 kept cartesian `images.prior_t*`; 3.10 on keeps `pose_priors`, keyed by
        image until 3.13, by sensor data since 4.0. Priors that are no three finite numbers are
        left out.
        """
        columns = self._columns("pose_priors")
        if "corr_data_id" in columns:
            query = (
                "SELECT corr_data_id, position, coordinate_system FROM pose_priors"
                " WHERE corr_sensor_type = 0"
            )
        elif "image_id" in columns:
            query = "SELECT image_id, position, coordinate_system FROM pose_priors"
        elif "prior_tx" in self._columns("images"):
            return self._legacy_priors()
        else:
            return {}
        priors = {}
        for image_id, blob, system in self.connection.execute(query):
            if not isinstance(blob, bytes) or len(blob) != 24 or system not in SYSTEMS:
                continue
            x, y, z = position = np.frombuffer(blob, np.float64).tolist()
            if np.isfinite(position).all():
                priors[image_id] = PosePrior((x, y, z), CoordinateSystem(system))
        return priors

    def position_deviations(self) -> dict[int, tuple[float, float, float]]:
        """Return the standard deviations of the position priors, m, by image id.

        They are those of the covariance's diagonal (east, north, up for WGS84); priors without a
        covariance, or of a COLMAP before 4.0, are absent.
        """
        if not {"corr_data_id", "position_covariance"} <= self._columns("pose_priors"):
            return {}
        deviations = {}
        for image_id, blob in self.connection.execute(
            "SELECT corr_data_id, position_covariance FROM pose_priors WHERE corr_sensor_type = 0"
        ):
            covariance = np.frombuffer(blob or b"", np.float64)
            if covariance.size == 9 and (np.diag(covariance.reshape(3, 3)) > 0).all():
                east, north, up = np.sqrt(np.diag(covariance.reshape(3, 3))).tolist()
                deviations[image_id] = (east, north, up)
        return deviations

    def frames(self) -> dict[int, int]:
        """Return the rig frame by image id (COLMAP 3.12 on); empty where there are no frames."""
        if not self._columns("frame_data"):
            return {}
        return dict(
            self.connection.execute(
                "SELECT data_id, frame_id FROM frame_data WHERE sensor_type = 0"
                " AND typeof(data_id) || typeof(frame_id) = 'integerinteger'"
            )
        )

    def with_frames(self, ids: set[int]) -> set[int]:
        """Return images with all others of their rig frames."""
        frames = self.frames()
        touched = {frames[image] for image in ids if image in frames}
        return ids | {image for image, frame in frames.items() if frame in touched}

    def _legacy_priors(self) -> dict[int, PosePrior]:
        rows = self.connection.execute(
            "SELECT image_id, prior_tx, prior_ty, prior_tz FROM images"
            " WHERE typeof(prior_tx) || typeof(prior_ty) || typeof(prior_tz) = 'realrealreal'"
        )
        return {
            image_id: PosePrior((x, y, z), CoordinateSystem.CARTESIAN)
            for image_id, x, y, z in rows
            if np.isfinite([x, y, z]).all()
        }

    def _image_ids(self) -> set[int]:
        return {number for (number,) in self.connection.execute("SELECT image_id FROM images")}

    def _counts(self, table: str) -> dict[int, int]:
        self._check_data(table, "image_id")
        return dict(self.connection.execute(f"SELECT image_id, rows FROM {table} WHERE rows > 0"))

    def _values(
        self, table: str, key: str, number: int, dtype: DTypeLike, columns: int
    ) -> NDArray[Any]:
        """Return the `rows` x `cols` values of one image or pair, (0, columns) where none are."""
        self._check_data(table, key, number)
        row = self.connection.execute(
            f"SELECT rows, cols, data FROM {table} WHERE {key} = ?", (number,)
        ).fetchone()
        if row is None or not row[0]:
            return np.zeros((0, columns), dtype)
        return np.frombuffer(row[2], dtype).reshape(row[0], row[1])

    def _check_data(self, table: str, key: str, number: int | None = None) -> None:
        """Make sure that `data` is as long as `rows` and `cols` say, of one row or of all.

        sqlite knows a blob's type and length without reading it.

        Raises:
            InputError: it is not.
        """
        query = (
            f"SELECT {key} FROM {table} WHERE (typeof(rows) <> 'integer' OR rows < 0 OR rows > 0"
            " AND (typeof(cols) <> 'integer' OR cols < 2 OR typeof(data) <> 'blob'"
            f" OR length(data) <> rows * cols * {VALUE_BYTES[table]}"
            f"{' OR cols <> 2' if key == 'pair_id' else ''}))"
        )
        if number is None:
            row = self.connection.execute(f"{query} LIMIT 1").fetchone()
        else:
            row = self.connection.execute(f"{query} AND {key} = ?", (number,)).fetchone()
        if row is not None:
            whose = images_of_pair(row[0]) if key == "pair_id" else (row[0],)
            raise self._damaged(table, " and ".join(map(self._image, whose)))

    def _check_keypoints(self, images: tuple[int, int], last: Sequence[int]) -> None:
        """Make sure that two images have the keypoints that their matches name last."""
        rows = dict(
            self.connection.execute(
                "SELECT image_id, rows FROM keypoints WHERE image_id IN (?, ?)", images
            )
        )
        for image, index in zip(images, last, strict=True):
            count = rows.get(image, 0)
            if not isinstance(count, int) or index >= count:
                raise InputError(
                    f"{self.path} has matches of keypoint {index} of {self._image(image)}, which "
                    f"has {count}: its features and its matches are not of one run; delete the "
                    "matches, or restore the database from a copy."
                )

    def _image(self, number: int) -> str:
        row = self.connection.execute(
            "SELECT name FROM images WHERE image_id = ?", (number,)
        ).fetchone()
        return f"image {number}" if row is None else f"image {number} ({row[0]})"

    def _damaged(self, table: str, whose: str) -> InputError:
        return InputError(
            f"{self.path} is damaged: what table {table} has of {whose} cannot be right; restore "
            "the database from a copy, or delete this image there and run `colmap-netvlad "
            "features` again."
        )

    def _columns(self, table: str) -> set[str]:
        return {row[1] for row in self.connection.execute(f"PRAGMA table_info({table})")}


@contextmanager
def open_database(path: Path, wait: float = BUSY_SECONDS) -> Iterator[Database]:
    """Open a COLMAP database of version 3.8 to 4.2 for reading; the file stays byte-identical.

    Args:
        wait: how long to wait for another process's write, s.

    Raises:
        InputError: it is not there, not sqlite, not COLMAP's, or locked by another process.
    """
    try:
        with closing(_connect(path, wait)) as connection:
            yield Database(connection, path)
    except sqlite3.OperationalError as fault:
        if "locked" in str(fault) or "busy" in str(fault):
            raise InputError(
                f"{path} is locked by another process; wait for it to finish, or close COLMAP."
            ) from fault
        raise InputError(f"{path} cannot be read: {fault}.") from fault
    except sqlite3.DatabaseError as fault:
        raise InputError(
            f"{path} is not a COLMAP database (not a readable sqlite file: {fault})."
        ) from fault


def _matrix(blob: bytes | None) -> NDArray[np.float64] | None:
    """Read a (3, 3) matrix, kept row by row; older versions write zeros where there is none."""
    values = np.frombuffer(blob or b"", np.float64)
    return values.reshape(3, 3) if values.size == 9 and values.any() else None


def _connect(path: Path, wait: float) -> sqlite3.Connection:
    if not path.is_file():
        raise InputError(f"The database {path} does not exist; mend `database`.")
    uri = path.resolve().as_uri()
    wal = path.with_name(path.name + "-wal")
    # A WAL database at rest is opened for writing and then only queried: a read-only connection
    # could not take away the -wal and -shm files it makes beside the user's database.
    mode = "rw" if _is_wal(path) and not wal.exists() else "ro"
    connection = sqlite3.connect(
        f"{uri}?mode={mode}", uri=True, timeout=wait, check_same_thread=False
    )
    try:
        connection.execute("PRAGMA query_only = ON")
        tables = _tables(connection)
    except sqlite3.OperationalError as fault:
        connection.close()
        if "locked" in str(fault):
            raise
        # A WAL database in a read-only folder cannot make its shared-memory file; where no log
        # waits beside it nothing can be missed by reading it as immutable.
        if wal.exists() and wal.stat().st_size > 0:
            raise
        connection = sqlite3.connect(
            f"{uri}?mode=ro&immutable=1", uri=True, check_same_thread=False
        )
        tables = _tables(connection)
    missing = {"cameras", "images", "keypoints", "descriptors", "matches"} - tables
    if missing:
        connection.close()
        raise InputError(
            f"{path} is not a COLMAP database: it has no table {', '.join(sorted(missing))}."
        )
    return connection


def _is_wal(path: Path) -> bool:
    """Whether sqlite's header says write-ahead logging (bytes 18 and 19 are 2)."""
    with path.open("rb") as file:
        return file.read(20)[18:] == b"\x02\x02"


def _tables(connection: sqlite3.Connection) -> set[str]:
    return {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}


def image_names(path: Path) -> tuple[str, ...]:
    """Return the image names of a database, in the order of the image ids."""
    with open_database(path) as database:
        return tuple(row.name for row in database.images())


def feature_counts(path: Path) -> dict[str, int]:
    """Return the number of keypoints of each image of a database, by name; 0 where there are none.

    Raises:
        InputError: the database cannot be read, or the keypoints of an image are damaged.
    """
    with open_database(path) as database:
        counts = database.keypoint_counts()
        return {row.name: counts.get(row.image_id, 0) for row in database.images()}
