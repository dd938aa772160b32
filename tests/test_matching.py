"""Pairs -> matches in the database."""

from __future__ import annotations

import itertools
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_matches
from colmap_netvlad.colmap.database import image_names, open_database, pair_id
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.matching import colmap as matching
from colmap_netvlad.matching import run as asked_pairs
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError

MakeProject = Callable[..., Project]


def some_pairs(database: Path, images: int = 4) -> list[tuple[str, str]]:
    return list(itertools.combinations(image_names(database)[:images], 2))


def results(database: Path) -> dict[int, tuple[object, ...]]:
    """Every row of both tables of matches, by pair."""
    with closing(sqlite3.connect(database)) as connection:
        return {
            row[0]: row[1:]
            for row in connection.execute(
                "SELECT m.pair_id, m.rows, m.data, g.rows, g.data, g.config, g.F, g.E, g.H"
                " FROM matches m JOIN two_view_geometries g USING (pair_id)"
            )
        }


def rename(database: Path, names: list[str]) -> None:
    with closing(sqlite3.connect(database)) as connection:
        ids = [row[0] for row in connection.execute("SELECT image_id FROM images ORDER BY 1")]
        connection.executemany(
            "UPDATE images SET name = ? WHERE image_id = ?", zip(names, ids, strict=False)
        )
        connection.commit()


def test_pairs_are_matched_and_verified_and_nothing_else(project_copy: MakeProject) -> None:
    database = project_copy().database
    pairs = some_pairs(database)
    report = match_pairs(database, [*pairs, pairs[0][::-1]])
    assert (report.requested, report.already, report.matched) == (6, 0, 6)
    assert 3 <= report.verified <= 6 and report.seconds > 0
    with open_database(database) as colmap:
        assert len(colmap.matched_pairs()) == 6
        assert sum(count > 15 for count in colmap.verified_matches().values()) >= 3


def test_pairs_matched_before_are_not_matched_again(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = project_copy().database
    first = match_pairs(database, some_pairs(database))
    before = results(database)
    monkeypatch.setattr(engine, "call", lambda *_, **__: pytest.fail("COLMAP was called"))
    again = match_pairs(database, some_pairs(database))
    assert (again.already, again.matched, again.verified) == (6, 0, first.verified)
    assert results(database) == before


def test_names_with_spaces_and_hashes_match_as_any_others(project_copy: MakeProject) -> None:
    plain = project_copy(name="plain").database
    odd = project_copy(name="odd names #1").database
    rename(odd, ["a b.jpg", "#c.jpg", "写真 2.jpg", "b.jpg", "a"])
    pairs = some_pairs(odd)
    assert pairs[0] == ("a b.jpg", "#c.jpg")
    report = match_pairs(odd, pairs)
    match_pairs(plain, some_pairs(plain))
    assert report.matched == 6
    assert results(odd) == results(plain) and len(results(odd)) == 6
    with open_database(odd) as colmap:
        assert {row.name for row in colmap.images()} >= {"a b.jpg", "#c.jpg", "写真 2.jpg", "b.jpg"}


def test_matches_are_the_same_twice_and_in_chunks_of_any_size(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = (project_copy(name=name).database for name in ("one", "two"))
    match_pairs(one, some_pairs(one))
    monkeypatch.setattr(matching, "FIRST_CHUNK", 1)
    monkeypatch.setattr(matching, "CHUNK_SECONDS", 0.0)
    match_pairs(two, some_pairs(two)[::-1])
    assert results(one) == results(two)


def test_several_processes_give_the_same_matches_as_one(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = (project_copy(name=name).database for name in ("one", "two"))
    match_pairs(one, some_pairs(one, 6), MatchOptions(processes=1))
    monkeypatch.setattr(matching, "WORTH_A_PROCESS", 5)
    monkeypatch.setattr(matching, "FIRST_CHUNK", 2)
    report = match_pairs(two, some_pairs(two, 6), MatchOptions(processes=3))
    assert report.matched == 15
    assert results(one) == results(two) and len(results(two)) == 15


def test_a_process_waits_while_another_writes(project_copy: MakeProject) -> None:
    database = project_copy(matched=True).database
    target = project_copy(name="target").database
    ready = threading.Event()

    def write_slowly() -> None:
        with closing(sqlite3.connect(target, isolation_level=None)) as other:
            other.execute("PRAGMA journal_mode = WAL")
            other.execute("BEGIN IMMEDIATE")
            other.execute("INSERT INTO matches (pair_id, rows, cols) VALUES (?, 0, 2)", (one,))
            ready.set()
            time.sleep(0.5)
            other.execute("COMMIT")

    one, two = sorted(results(database))[:2]
    thread = threading.Thread(target=write_slowly)
    thread.start()
    ready.wait()
    copy_matches(database, target, [two])
    thread.join()
    assert results(target)[two] == results(database)[two]


match_chunk = matching._match_chunk


def match_the_first_only(seed: int, database: Path, pairs: list[IdPair]) -> tuple[int, float]:
    if (1, 2) not in pairs:
        matching.copy_features = full_disk  # in a process of its own
    return match_chunk(seed, database, pairs)


def full_disk(*arguments: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_failing_process_is_said_and_leaves_what_is_matched(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = project_copy().database
    monkeypatch.setattr(matching, "WORTH_A_PROCESS", 5)
    monkeypatch.setattr(matching, "FIRST_CHUNK", 5)
    monkeypatch.setattr(matching, "_match_chunk", match_the_first_only)
    with pytest.raises(InputError, match="run the command again"):
        match_pairs(database, some_pairs(database, 5), MatchOptions(processes=2))
    assert len(results(database)) == 5
    monkeypatch.undo()
    assert match_pairs(database, some_pairs(database, 5)).matched == 5


def test_a_stopped_run_goes_on_with_the_pairs_left(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = project_copy().database
    monkeypatch.setattr(matching, "FIRST_CHUNK", 4)
    calls = 0

    def stop_at_the_second(*arguments: object, **options: object) -> object:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise KeyboardInterrupt
        return call(*arguments, **options)

    call = engine.call
    monkeypatch.setattr(engine, "call", stop_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        match_pairs(database, some_pairs(database))
    assert len(results(database)) == 4
    report = match_pairs(database, some_pairs(database))
    assert (report.already, report.matched) == (4, 2)


@pytest.mark.parametrize("spaces", [False, True])
def test_a_3x_database_is_brought_up_to_date_and_matched(
    spaces: bool, legacy_database: Path
) -> None:
    if spaces:
        rename(legacy_database, ["a b.jpg", "a c.jpg"])
    report = match_pairs(legacy_database, some_pairs(legacy_database, 3))
    assert report.matched == 3 and report.verified >= 2
    with closing(sqlite3.connect(legacy_database)) as connection:
        assert connection.execute("PRAGMA user_version").fetchone()[0] >= 4_000_000


def test_unknown_names_and_missing_features_are_said(project_copy: MakeProject) -> None:
    database = project_copy().database
    name = image_names(database)[0]
    with pytest.raises(InputError, match=r"has no image gone\.jpg"):
        match_pairs(database, [(name, "gone.jpg")])
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("DELETE FROM keypoints")
        connection.execute("DELETE FROM descriptors")
        connection.commit()
    with pytest.raises(InputError, match="colmap-netvlad features"):
        match_pairs(database, some_pairs(database))


def test_one_image_without_features_fails_its_pairs_only(project_copy: MakeProject) -> None:
    database = project_copy().database
    with open_database(database) as colmap:
        ids = {row.name: row.image_id for row in colmap.images()}
    bare, other, third, *_ = image_names(database)
    with closing(sqlite3.connect(database)) as connection:
        for table in ("keypoints", "descriptors"):
            connection.execute(f"DELETE FROM {table} WHERE image_id = ?", (ids[bare],))
        connection.commit()
    report = match_pairs(database, some_pairs(database, 3))
    assert report.requested == 3 and report.verified >= 1
    with open_database(database) as colmap:
        verified = colmap.verified_matches()
    assert verified.get(tuple(sorted((ids[bare], ids[other]))), 0) == 0
    assert pair_id(*sorted((ids[other], ids[third]))) in results(database)


@given(st.sets(st.tuples(st.integers(1, 90), st.integers(1, 90)), min_size=1, max_size=300))
def test_the_order_of_matching_keeps_every_pair_once(pairs: set[tuple[int, int]]) -> None:
    asked = sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]} | {(1, 2)})
    assert sorted(asked_pairs.in_tiles(asked)) == asked


def test_neighbours_in_the_list_share_images() -> None:
    shuffled = [i * 37 % 101 for i in range(101)]  # a flight line under names in any order
    line = [(shuffled[i], shuffled[j]) for i in range(101) for j in range(i + 1, min(i + 9, 101))]
    pairs = sorted((min(pair), max(pair)) for pair in line)

    def indexed(order: list[tuple[int, int]]) -> int:
        chunks = [order[at : at + 100] for at in range(0, len(order), 100)]
        return sum(len({image for pair in chunk for image in pair}) for chunk in chunks)

    assert indexed(asked_pairs.in_tiles(pairs)) < 0.5 * indexed(pairs)
