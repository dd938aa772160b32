"""Empty COLMAP databases of every schema from 3.8 to 4.2, made without pycolmap.

The statements follow COLMAP's published schemas; only what differs between versions is varied.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from colmap_netvlad.colmap.database import pair_id

NAMES = ("a/DJI 0001.JPG", "b/DJI 0001.JPG", "Übersicht.jpg", "图.jpg")

VERSIONS = ("3.9", "3.10", "3.11", "3.12", "4.1", "4.2")

_CAMERAS = """CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
 model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB,
 prior_focal_length INTEGER NOT NULL)"""
_IMAGES = """CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
 name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL{priors},
 FOREIGN KEY(camera_id) REFERENCES cameras(camera_id))"""
_LEGACY_PRIORS = ", " + ", ".join(
    f"prior_{name} REAL" for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
)
_KEYPOINTS = """CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL,
 rows INTEGER NOT NULL,
 cols INTEGER NOT NULL, data BLOB,
 FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)"""
_DESCRIPTORS = """CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL,{type}
 rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
 FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)"""
_MATCHES = """CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
 cols INTEGER NOT NULL, data BLOB)"""
_GEOMETRIES = """CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL,
 rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB, config INTEGER NOT NULL,
 F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB{cameras})"""
_PRIORS_BY_IMAGE = """CREATE TABLE pose_priors (image_id INTEGER PRIMARY KEY NOT NULL,
 position BLOB, coordinate_system INTEGER NOT NULL{covariance},
 FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)"""
_PRIORS_BY_SENSOR_DATA = """CREATE TABLE pose_priors (pose_prior_id INTEGER PRIMARY KEY NOT NULL,
 corr_data_id INTEGER NOT NULL, corr_sensor_id INTEGER NOT NULL, corr_sensor_type INTEGER NOT NULL,
 position BLOB, position_covariance BLOB, gravity BLOB, coordinate_system INTEGER NOT NULL)"""
_RIGS = (
    """CREATE TABLE rigs (rig_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
 ref_sensor_id INTEGER NOT NULL, ref_sensor_type INTEGER NOT NULL)""",
    """CREATE TABLE rig_sensors (rig_id INTEGER NOT NULL, sensor_id INTEGER NOT NULL,
 sensor_type INTEGER NOT NULL, sensor_from_rig BLOB)""",
    """CREATE TABLE frames (frame_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
 rig_id INTEGER NOT NULL)""",
    """CREATE TABLE frame_data (frame_id INTEGER NOT NULL, data_id INTEGER NOT NULL,
 sensor_id INTEGER NOT NULL, sensor_type INTEGER NOT NULL)""",
)


def make_database(path: Path, version: str) -> None:
    """Write an empty database of a COLMAP version in `VERSIONS`."""
    number = tuple(int(part) for part in version.split("."))
    four = number >= (4, 0)
    statements = [
        _CAMERAS,
        _IMAGES.format(priors=_LEGACY_PRIORS if number < (3, 10) else ""),
        _KEYPOINTS,
        _DESCRIPTORS.format(type=" type INTEGER NOT NULL," if four else ""),
        _MATCHES,
        _GEOMETRIES.format(cameras=", camera1 BLOB, camera2 BLOB" if number >= (4, 2) else ""),
    ]
    if four:
        statements.append(_PRIORS_BY_SENSOR_DATA)
    elif number >= (3, 10):
        covariance = ", position_covariance BLOB" if number >= (3, 11) else ""
        statements.append(_PRIORS_BY_IMAGE.format(covariance=covariance))
    if number >= (3, 12):
        statements.extend(_RIGS)
    user_version = number[0] * 10**6 + number[1] * 10**4 if four else 3900
    with closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {user_version}")
        connection.commit()


def add_images(path: Path, names: Sequence[str]) -> None:
    """Add images of one camera, without features, to a database from `make_database`."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(
            "INSERT INTO cameras (camera_id, model, width, height, params, prior_focal_length)"
            " VALUES (1, 0, 400, 300, NULL, 0)"
        )
        connection.executemany(
            "INSERT INTO images (name, camera_id) VALUES (?, 1)", [(name,) for name in names]
        )
        connection.commit()


def make_filled(path: Path, version: str) -> None:
    """Write a database of a COLMAP version with the images `NAMES`."""
    make_database(path, version)
    with closing(sqlite3.connect(path)) as connection:
        _fill(connection)
        connection.commit()


def _fill(connection: sqlite3.Connection) -> None:
    """Fill in the images `NAMES`: features in three, a verified and a failed pair, priors."""
    connection.execute("INSERT INTO cameras VALUES (1, 2, 400, 300, NULL, 0)")
    connection.executemany(
        "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, 1)",
        list(enumerate(NAMES, start=1)),
    )
    typed = any(row[1] == "type" for row in connection.execute("PRAGMA table_info(descriptors)"))
    for image_id in (1, 2, 3):
        points = np.arange(image_id * 24, dtype=np.float32).reshape(-1, 6)
        connection.execute(
            "INSERT INTO keypoints VALUES (?, ?, 6, ?)", (image_id, len(points), points.tobytes())
        )
        descriptors = np.full((len(points), 128), image_id, np.uint8)
        connection.execute(
            f"INSERT INTO descriptors VALUES (?, {'1,' if typed else ''} ?, 128, ?)",
            (image_id, len(points), descriptors.tobytes()),
        )
    matches = np.array([[0, 1], [2, 3]], np.uint32)
    for pair, rows in ((pair_id(1, 2), 2), (pair_id(2, 3), 0)):
        connection.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", (pair, 2, matches.tobytes()))
        connection.execute(
            "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config)"
            " VALUES (?, ?, 2, ?, 2)",
            (pair, rows, matches[:rows].tobytes()),
        )
    _add_priors(connection)


def _add_priors(connection: sqlite3.Connection) -> None:
    columns = {row[1] for row in connection.execute("PRAGMA table_info(pose_priors)")}
    good, broken = np.array([47.5, 8.25, 400.0]), np.array([np.nan, 8.0, 400.0])
    if "corr_data_id" in columns:
        for image_id, position in ((1, good), (2, broken)):
            connection.execute(
                "INSERT INTO pose_priors VALUES (?, ?, 1, 0, ?, NULL, NULL, 0)",
                (image_id, image_id, position.tobytes()),
            )
    elif columns:
        for image_id, position in ((1, good), (2, broken)):
            connection.execute(
                "INSERT INTO pose_priors (image_id, position, coordinate_system) VALUES (?, ?, 0)",
                (image_id, position.tobytes()),
            )
    else:
        connection.execute(
            "UPDATE images SET prior_tx = 47.5, prior_ty = 8.25, prior_tz = 400 WHERE image_id = 1"
        )
