"""A COLMAP database of any version is read, and stays as it is."""

from __future__ import annotations

import hashlib
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from schemas import VERSIONS, make_database

from colmap_netvlad.colmap.database import (
    copy_database,
    image_names,
    images_of_pair,
    open_database,
    pair_id,
)
from colmap_netvlad.photos.positions import CoordinateSystem
from colmap_netvlad.runtime.errors import InputError

NAMES = ("a/DJI 0001.JPG", "b/DJI 0001.JPG", "Übersicht.jpg", "图.jpg")


@pytest.fixture(params=VERSIONS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A database of four images: features in three, one verified and one failed pair, priors."""
    path = tmp_path / "project.db"
    make_database(path, request.param)
    with closing(sqlite3.connect(path)) as connection:
        _fill(connection)
        connection.commit()
    return path


def _fill(connection: sqlite3.Connection) -> None:
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


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_everything_is_read_and_the_file_stays_byte_identical(database: Path) -> None:
    before = _sha256(database)
    with open_database(database) as db:
        images = db.images()
        assert [image.name for image in images] == list(NAMES)
        assert (images[0].width, images[0].height) == (400, 300)
        assert db.keypoint_counts() == {1: 4, 2: 8, 3: 12}
        assert db.descriptor_counts() == {1: 4, 2: 8, 3: 12}
        assert db.keypoints(1).tolist() == [[0, 1], [6, 7], [12, 13], [18, 19]]
        assert db.keypoints(4).shape == (0, 2)
        assert (db.sift_descriptors(2) == 2).all()
        assert db.sift_descriptors(4).shape == (0, 128)
        assert db.matched_pairs() == {(1, 2), (2, 3)}
        assert db.verified_matches() == {(1, 2): 2, (2, 3): 0}
        assert db.inlier_matches(1, 2).tolist() == [[0, 1], [2, 3]]
        assert db.inlier_matches(2, 1).tolist() == [[1, 0], [3, 2]]
        assert db.inlier_matches(1, 4).shape == (0, 2)
        assert db.frames() == {}
    assert _sha256(database) == before
    assert sorted(p.name for p in database.parent.iterdir()) == ["project.db"]


def test_position_priors_are_read_from_every_version_and_broken_ones_left_out(
    database: Path,
) -> None:
    with open_database(database) as db:
        priors = db.pose_priors()
    assert list(priors) == [1]
    assert priors[1].position == (47.5, 8.25, 400.0)
    assert priors[1].coordinate_system in (CoordinateSystem.WGS84, CoordinateSystem.CARTESIAN)


def test_a_feature_copy_has_no_matches_and_leaves_its_source(database: Path) -> None:
    before = _sha256(database)
    target = database.with_name("copy.db")
    copy_database(database, target, matches=False)
    assert _sha256(database) == before
    assert image_names(target) == NAMES
    with open_database(target) as copy:
        assert copy.descriptor_counts() == {1: 4, 2: 8, 3: 12}
        assert copy.matched_pairs() == set()


def test_reading_a_wal_database_at_rest_leaves_no_files_beside_it(database: Path) -> None:
    with closing(sqlite3.connect(database)) as writer:
        writer.execute("PRAGMA journal_mode = WAL")
    before, changed = _sha256(database), database.stat().st_mtime_ns
    assert image_names(database) == NAMES
    assert [p.name for p in database.parent.iterdir()] == ["project.db"]
    assert _sha256(database) == before
    assert database.stat().st_mtime_ns == changed


def test_a_log_left_by_a_killed_writer_stays_as_it_is(database: Path, tmp_path: Path) -> None:
    with closing(sqlite3.connect(database)) as writer:
        writer.execute("PRAGMA journal_mode = WAL")
        writer.execute("INSERT INTO images (image_id, name, camera_id) VALUES (9, 'new.jpg', 1)")
        writer.commit()
        killed = tmp_path / "killed"
        killed.mkdir()
        for suffix in ("", "-wal"):
            left = database.with_name(database.name + suffix)
            (killed / left.name).write_bytes(left.read_bytes())
    before = {p.name: _sha256(p) for p in killed.iterdir()}
    assert image_names(killed / "project.db")[-1] == "new.jpg"
    assert {name: _sha256(killed / name) for name in before} == before


def test_a_waiting_write_ahead_log_is_read_too(database: Path) -> None:
    with closing(sqlite3.connect(database)) as writer:
        writer.execute("PRAGMA journal_mode = WAL")
        writer.execute("INSERT INTO images (image_id, name, camera_id) VALUES (9, 'new.jpg', 1)")
        writer.commit()
        assert image_names(database)[-1] == "new.jpg"


def test_features_of_another_kind_are_one_sentence(database: Path) -> None:
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("UPDATE descriptors SET cols = 512 WHERE image_id = 1")
        connection.commit()
    with open_database(database) as db, pytest.raises(InputError, match="512 bytes, not SIFT's"):
        db.sift_descriptors(1)


def test_a_file_that_is_not_sqlite_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "project.db"
    path.write_bytes(b"\xff\xd8\xff\xe0 this is a photo" * 100)
    with pytest.raises(InputError, match="is not a COLMAP database"):
        image_names(path)


def test_a_sqlite_file_that_is_not_colmap_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "project.db"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE photos (name TEXT)")
    with pytest.raises(InputError, match="has no table cameras, descriptors"):
        image_names(path)


def test_an_empty_file_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "project.db").touch()
    with pytest.raises(InputError, match="is not a COLMAP database"):
        image_names(tmp_path / "project.db")


def test_a_locked_database_is_one_sentence(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("colmap_netvlad.colmap.database.BUSY_SECONDS", 0.1)
    with closing(sqlite3.connect(database)) as other:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(InputError, match="locked by another process"):
            image_names(database)


ids = st.integers(min_value=1, max_value=2147483646)


@given(ids, ids)
def test_a_pair_id_holds_both_images_whatever_their_order(a: int, b: int) -> None:
    assert images_of_pair(pair_id(a, b)) == (min(a, b), max(a, b))
    assert pair_id(a, b) == pair_id(b, a)


def test_pair_ids_are_colmap_s() -> None:
    import pycolmap

    for a, b in ((1, 2), (7, 3), (2147483646, 1)):
        assert pair_id(a, b) == pycolmap.image_pair_to_pair_id(a, b)
