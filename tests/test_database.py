"""A COLMAP database of any version is read, and stays as it is."""

from __future__ import annotations

import hashlib
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from schemas import NAMES, VERSIONS, make_filled

from colmap_netvlad.colmap.database import (
    image_names,
    images_of_pair,
    open_database,
    pair_id,
)
from colmap_netvlad.photos.positions import CoordinateSystem
from colmap_netvlad.runtime.errors import InputError


@pytest.fixture(params=VERSIONS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "project.db"
    make_filled(path, request.param)
    return path


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
        connection.execute(
            "UPDATE descriptors SET cols = 512, data = zeroblob(rows * 512) WHERE image_id = 1"
        )
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


def test_a_locked_database_is_one_sentence(database: Path) -> None:
    with closing(sqlite3.connect(database)) as other:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        with (
            pytest.raises(InputError, match="locked by another process"),
            open_database(database, wait=0.1),
        ):
            pass


ids = st.integers(min_value=1, max_value=2147483646)


@given(ids, ids)
def test_a_pair_id_holds_both_images_whatever_their_order(a: int, b: int) -> None:
    assert images_of_pair(pair_id(a, b)) == (min(a, b), max(a, b))
    assert pair_id(a, b) == pair_id(b, a)


def test_pair_ids_are_colmap_s() -> None:
    import pycolmap

    for a, b in ((1, 2), (7, 3), (2147483646, 1)):
        assert pair_id(a, b) == pycolmap.image_pair_to_pair_id(a, b)
