"""Copies of COLMAP databases of every version: what they hold, and that the source stays."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from schemas import NAMES, VERSIONS, make_database, make_filled

from colmap_netvlad.colmap import copies
from colmap_netvlad.colmap.copies import (
    copy_database,
    copy_features,
    copy_images,
    copy_matches,
    copy_with_pairs,
)
from colmap_netvlad.colmap.database import image_names, open_database, pair_id


@pytest.fixture(params=VERSIONS)
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "project.db"
    make_filled(path, request.param)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE INDEX by_camera ON images (camera_id)")
        connection.commit()
    return path


def rows(path: Path, table: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(f"SELECT * FROM {table}").fetchall()


def tables(path: Path) -> dict[str, str]:
    with closing(sqlite3.connect(path)) as connection:
        return dict(connection.execute("SELECT name, sql FROM sqlite_master ORDER BY name"))


@contextmanager
def unchanged(path: Path) -> Iterator[None]:
    before = path.read_bytes()
    yield
    assert path.read_bytes() == before


@pytest.mark.parametrize("matches", [True, False])
def test_a_copy_is_the_same_database(source: Path, tmp_path: Path, matches: bool) -> None:
    target = tmp_path / "copy.db"
    with unchanged(source):
        copy_database(source, target, matches=matches)
    assert tables(target) == tables(source)
    for table in tables(source):
        if table == "by_camera" or "autoindex" in table:
            continue
        expected = [] if table in copies.MATCHES and not matches else rows(source, table)
        assert rows(target, table) == expected, table
    with closing(sqlite3.connect(source)) as a, closing(sqlite3.connect(target)) as b:
        version = "PRAGMA user_version"
        assert a.execute(version).fetchone() == b.execute(version).fetchone()


def test_matches_that_are_left_out_are_never_copied(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    statements: list[str] = []
    connect = sqlite3.connect

    def traced(*arguments: Any, **options: Any) -> sqlite3.Connection:
        connection = connect(*arguments, **options)
        connection.set_trace_callback(statements.append)
        return connection

    monkeypatch.setattr(sqlite3, "connect", traced)
    copy_database(source, tmp_path / "copy.db", matches=False)
    done = [line for line in statements if "sqlite_master" not in line]
    assert any(line.startswith("SELECT") and '"keypoints"' in line for line in done)
    # No backup of all pages either: every row that came was inserted.
    assert any(line.startswith("INSERT") and '"keypoints"' in line for line in done)
    for table in copies.MATCHES:
        assert not any(line.startswith(("SELECT", "INSERT")) and table in line for line in done)
    assert not any(line.startswith(("DELETE", "VACUUM")) for line in done)


def test_a_waiting_write_ahead_log_is_copied(source: Path, tmp_path: Path) -> None:
    with closing(sqlite3.connect(source)) as writer:
        writer.execute("PRAGMA journal_mode = WAL")
        writer.execute("INSERT INTO images (image_id, name, camera_id) VALUES (9, 'new.jpg', 1)")
        writer.commit()
        copy_database(source, tmp_path / "copy.db", matches=False)
    assert image_names(tmp_path / "copy.db")[-1] == "new.jpg"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy.db", "project.db"]


def test_a_copy_with_pairs_has_no_other_matches_and_no_descriptors(
    source: Path, tmp_path: Path
) -> None:
    target = tmp_path / "copy.db"
    with unchanged(source):
        copy_with_pairs(source, target, {(NAMES[1], NAMES[0])})
    with open_database(target) as copy:
        assert copy.verified_matches() == {(1, 2): 2}
        assert copy.matched_pairs() == {(1, 2)}
        assert copy.descriptor_counts() == {}
        assert copy.keypoint_counts() == {1: 4, 2: 8, 3: 12}
        assert len(copy.pose_priors()) == 1


def test_some_images_come_with_their_verified_pairs(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "copy.db"
    with unchanged(source):
        copy_images(source, target, NAMES[:2])
    with open_database(target) as copy:
        assert [row.name for row in copy.images()] == list(NAMES[:2])
        assert copy.keypoint_counts() == {1: 4, 2: 8}
        assert copy.verified_matches() == {(1, 2): 2}
        assert copy.descriptor_counts() == {} and copy.matched_pairs() == set()


def test_features_come_under_aliases_into_a_database_of_another_order(
    source: Path, tmp_path: Path
) -> None:
    target = tmp_path / "scratch.db"
    make_database(target, "4.2")
    with closing(sqlite3.connect(target)) as connection:
        connection.execute("DROP TABLE keypoints")
        connection.execute(
            "CREATE TABLE keypoints (data BLOB, cols INTEGER, rows INTEGER, image_id INTEGER)"
        )
        connection.execute("DROP TABLE descriptors")
        connection.execute(
            "CREATE TABLE descriptors (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)"
        )
    with unchanged(source):
        copy_features(source, target, {3: "three", 1: "one"})
    with open_database(target) as copy:
        assert [(row.image_id, row.name) for row in copy.images()] == [(1, "one"), (3, "three")]
        assert copy.keypoints(1).tolist() == [[0, 1], [6, 7], [12, 13], [18, 19]]
        assert (copy.sift_descriptors(3) == 3).all()
        assert copy.descriptor_counts() == {1: 4, 3: 12}


def test_matches_of_some_pairs_replace_what_is_there(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "other.db"
    copy_database(source, target, matches=True)
    with closing(sqlite3.connect(target)) as connection:
        connection.execute("UPDATE two_view_geometries SET rows = 0")
        connection.execute("UPDATE matches SET rows = 0")
        connection.commit()
    with unchanged(source):
        copy_matches(source, target, [pair_id(2, 1)])
    with open_database(target) as copy:
        assert copy.verified_matches() == {(1, 2): 2, (2, 3): 0}
    kept = {pair: count for pair, count, *_ in rows(target, "matches")}
    assert kept == {pair_id(1, 2): 2, pair_id(2, 3): 0}


def test_more_keys_than_one_query_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copies, "AT_ONCE", 2)
    source, target = tmp_path / "project.db", tmp_path / "copy.db"
    make_filled(source, "4.1")
    copy_images(source, target, NAMES)
    assert image_names(target) == NAMES


def test_a_copy_that_fails_leaves_nothing(source: Path, tmp_path: Path, monkeypatch) -> None:
    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(copies, "_copy_rows", full)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(Exception, match="Cannot write"):
        copy_database(source, tmp_path / "copy.db", matches=False)
    assert sorted(tmp_path.iterdir()) == before
