"""The guided matcher: on the rendered flight, on damaged features, and by its properties."""

from __future__ import annotations

import itertools
import os
import shutil
import sqlite3
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from guided import Rows, change, rows
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names, images_of_pair, open_database, pair_id
from colmap_netvlad.colmap.results import PairResult, camera_of, write_results
from colmap_netvlad.matching import blocks
from colmap_netvlad.matching.features import prepare
from colmap_netvlad.matching.guided import Stage, match
from colmap_netvlad.matching.matchers import MATCHERS, find_matcher
from colmap_netvlad.matching.options import MatchOptions, MatchReport
from colmap_netvlad.matching.rounds import match_in_rounds
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.matching.verify import verify
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import InputError

MakeProject = Callable[..., Project]
GUIDED = MatchOptions("guided")
THOROUGH = MatchOptions("guided", thorough=True)


def all_pairs(database: Path, images: int | None = None) -> list[tuple[str, str]]:
    return list(itertools.combinations(image_names(database)[:images], 2))


@pytest.fixture(scope="module")
def unbroken(
    flight_database: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[MatchReport, Rows]:
    """Every pair matched in one go by one process: the report and the rows."""
    from colmap_netvlad.colmap.copies import copy_database

    database = tmp_path_factory.mktemp("unbroken") / "project.db"
    copy_database(flight_database, database, matches=False)
    return match_pairs(database, all_pairs(database), GUIDED), rows(database)


# What it finds, and how it is written


def test_it_verifies_what_colmap_verifies(
    unbroken: tuple[MatchReport, Rows], matched_database: Path
) -> None:
    report, found = unbroken
    with open_database(matched_database) as colmap:
        truth = colmap.verified_matches()
    assert (report.requested, report.matched, report.matcher) == (66, 66, "guided")
    inliers = {images_of_pair(pair): row[3] for pair, row in found.items()}
    assert inliers.keys() == truth.keys()
    correct = [pair for pair, count in truth.items() if count > 15]
    missed = [pair for pair in correct if inliers[pair] <= 15]
    assert len(correct) > 20 and len(missed) <= len(correct) // 100
    assert sum(map(int, inliers.values())) >= 0.95 * sum(truth.values())


def test_the_rows_of_equal_matches_are_byte_for_byte_colmaps(project_copy: MakeProject) -> None:
    database = project_copy().database
    match_pairs(database, all_pairs(database, 8), MatchOptions("colmap"))
    written = rows(database)
    assert sum(row[2] is None for row in written.values()) > 0  # pairs without matches too
    assert {row[6] for row in written.values()} > {1}  # degenerate, and others
    results = []
    with open_database(database) as colmap:
        for pair in sorted(written):
            a, b = images_of_pair(pair)
            data = written[pair][2] or b""
            matches = np.frombuffer(data, np.uint32).reshape(-1, 2)  # type: ignore[call-overload]
            cameras = camera_of(colmap, a), camera_of(colmap, b)
            places = colmap.keypoints(a), colmap.keypoints(b)
            results.append(PairResult((a, b), matches, verify(cameras, places, matches)))
    change(database, "DELETE FROM matches", "DELETE FROM two_view_geometries")
    write_results(database, results)
    assert rows(database) == written


def make_strange(database: Path, image_id: int) -> None:
    """Turn the bytes of an image's descriptors round: it looks like nothing else then."""
    with closing(sqlite3.connect(database)) as connection:
        (data,) = connection.execute(
            "SELECT data FROM descriptors WHERE image_id = ?", (image_id,)
        ).fetchone()
        turned = np.frombuffer(data, np.uint8).reshape(-1, 128)[:, ::-1].tobytes()
        connection.execute("UPDATE descriptors SET data = ? WHERE image_id = ?", (turned, image_id))
        connection.commit()


def verified_without_the_first(found: Rows) -> int:
    """Return how many of the pairs between images 2, 3 and 4 are verified."""
    pairs = [pair_id(2, 3), pair_id(2, 4), pair_id(3, 4)]
    return sum(found[pair][3] != 0 for pair in pairs)


def test_a_pair_given_up_is_written_as_one_without_matches(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows]
) -> None:
    database = project_copy().database
    make_strange(database, 1)
    pairs = all_pairs(database, 4)
    report = match_pairs(database, pairs, GUIDED)
    assert (report.matched, report.given_up) == (6, 3)
    assert report.verified == verified_without_the_first(unbroken[1])
    again = match_pairs(database, pairs, GUIDED)
    assert (again.already, again.matched, again.given_up) == (6, 0, 0)
    guided = rows(database)
    change(database, "DELETE FROM matches", "DELETE FROM two_view_geometries")
    match_pairs(database, pairs[:3], MatchOptions("colmap"))
    colmap = rows(database)
    assert [row[2] for row in colmap.values()] == [None] * 3
    assert {pair: guided[pair] for pair in colmap} == colmap


def test_thorough_gives_no_pair_up(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows]
) -> None:
    database = project_copy().database
    make_strange(database, 1)
    report = match_pairs(database, all_pairs(database, 4), THOROUGH)
    assert (report.matched, report.given_up) == (6, 0)
    assert report.verified >= verified_without_the_first(unbroken[1])


def test_thorough_tries_pairs_given_up_before_again(project_copy: MakeProject) -> None:
    database = project_copy().database
    make_strange(database, 1)
    pairs = all_pairs(database, 4)
    match_pairs(database, pairs, GUIDED)
    empty = sum(row[2] is None for row in rows(database).values())
    report = match_pairs(database, pairs, THOROUGH)
    assert (report.already, report.matched, report.given_up) == (6 - empty, empty, 0)
    assert empty >= 3
    found = rows(database)
    change(database, "DELETE FROM matches", "DELETE FROM two_view_geometries")
    match_pairs(database, pairs, THOROUGH)
    assert rows(database) == found


def test_rounds_count_the_pairs_given_up(project_copy: MakeProject) -> None:
    project = project_copy()
    make_strange(project.database, 1)
    options = RetrievalOptions(k=11)
    ranking = rank_project(project, "random", options)
    report = match_in_rounds(project, ranking, 66, 2, GUIDED)
    assert report.matches.given_up == sum(r.given_up for r in report.rounds) > 0
    assert report.matches.matcher == "guided"


# Always the same


def test_the_order_of_pairs_does_not_matter(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blocks, "BLOCK", 7)
    monkeypatch.setattr(blocks, "KEPT_FEATURES", 3000)  # two photos or three
    database = project_copy().database
    pairs = [pair[::-1] for pair in all_pairs(database)[::-1]]
    match_pairs(database, pairs[::2], GUIDED)
    match_pairs(database, pairs, GUIDED)
    assert rows(database) == unbroken[1]


def test_several_processes_give_the_same_as_one(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blocks, "WORTH_A_PROCESS", 10)
    monkeypatch.setattr(blocks, "BLOCK", 5)
    database = project_copy().database
    report = match_pairs(database, all_pairs(database), MatchOptions("guided", processes=3))
    assert rows(database) == unbroken[1]
    assert report.even_seconds > 0


def test_a_stopped_run_keeps_what_is_matched_and_goes_on(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows], monkeypatch: pytest.MonkeyPatch
) -> None:
    database = project_copy().database
    match_block, calls = blocks.match_block, itertools.count()

    def stop(*arguments: object) -> blocks.BlockReport:
        if next(calls) == 3:
            raise KeyboardInterrupt
        return match_block(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(blocks, "BLOCK", 8)
    monkeypatch.setattr(blocks, "match_block", stop)
    with pytest.raises(KeyboardInterrupt):
        match_pairs(database, all_pairs(database), GUIDED)
    assert len(rows(database)) == 24
    monkeypatch.undo()
    report = match_pairs(database, all_pairs(database), GUIDED)
    assert (report.already, report.matched) == (24, 42)
    assert rows(database) == unbroken[1]


def test_a_killed_run_goes_on(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows]
) -> None:
    database = project_copy().database
    script = Path(__file__).with_name("guided.py")
    path = os.pathsep.join([str(script.parents[1]), *filter(None, [os.getenv("PYTHONPATH")])])
    run = subprocess.Popen(
        [sys.executable, script, database], env={**os.environ, "PYTHONPATH": path}
    )
    try:
        for _ in range(600):
            if len(rows(database)) >= 3 or run.poll() is not None:
                break
            time.sleep(0.1)
        assert run.poll() is None, "it ended before it could be killed"
    finally:
        run.kill()
        run.wait()
    with closing(sqlite3.connect(database)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        counts = [
            connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
            for table in ("matches", "two_view_geometries")
        ]
    assert 3 <= counts[0] == counts[1] < 66
    report = match_pairs(database, all_pairs(database), GUIDED)
    assert report.already == counts[0]
    assert rows(database) == unbroken[1]


def test_a_full_disk_is_said_and_what_is_written_stays(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows], monkeypatch: pytest.MonkeyPatch
) -> None:
    database = project_copy().database
    usage = namedtuple("usage", "total used free")
    asked = iter([10**12, 10**12])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**12, 0, next(asked, 1000)))
    monkeypatch.setattr(blocks, "BLOCK", 20)
    monkeypatch.setattr(blocks, "WRITE_PAIRS", 20)
    with pytest.raises(InputError, match="is full"):
        match_pairs(database, all_pairs(database), GUIDED)
    assert len(rows(database)) == 20
    monkeypatch.undo()
    assert match_pairs(database, all_pairs(database), GUIDED).matched == 46
    assert rows(database) == unbroken[1]


# Databases of all kinds


def test_a_3x_database_is_matched(legacy_database: Path) -> None:
    report = match_pairs(legacy_database, all_pairs(legacy_database, 4), GUIDED)
    assert report.matcher == "guided" and report.verified >= 3
    with closing(sqlite3.connect(legacy_database)) as connection:
        assert connection.execute("PRAGMA user_version").fetchone()[0] >= 4_000_000


def test_photos_of_two_sizes_in_rigs_match_as_those_of_one(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows]
) -> None:
    """Every second photo as a camera of twice the pixels would have taken it; frames of two."""
    database = project_copy().database
    with closing(sqlite3.connect(database)) as connection:
        model, width, height, params, prior = connection.execute(
            "SELECT model, width, height, params, prior_focal_length FROM cameras"
        ).fetchone()
        double = np.frombuffer(params).copy()
        double[:3] *= 2  # focal length and principal point, not the distortion
        connection.execute(
            "INSERT INTO cameras VALUES (99, ?, ?, ?, ?, ?)",
            (model, 2 * width, 2 * height, double.tobytes(), prior),
        )
        for image_id, data in connection.execute(
            "SELECT image_id, data FROM keypoints WHERE image_id % 2"
        ).fetchall():
            scaled = 2 * np.frombuffer(data, np.float32)
            connection.execute(
                "UPDATE keypoints SET data = ? WHERE image_id = ?", (scaled.tobytes(), image_id)
            )
        connection.execute("UPDATE images SET camera_id = 99 WHERE image_id % 2")
        connection.execute("UPDATE frame_data SET sensor_id = 99 WHERE data_id % 2")
        connection.execute("UPDATE frame_data SET frame_id = (data_id + 1) / 2")
        connection.commit()
    report = match_pairs(database, all_pairs(database), GUIDED)
    assert abs(report.verified - unbroken[0].verified) <= 2


def test_photos_that_are_gone_match_all_the_same(
    project_copy: MakeProject, unbroken: tuple[MatchReport, Rows]
) -> None:
    project = project_copy()
    assert project.images is not None
    for photo in project.images.iterdir():
        photo.unlink()
    match_pairs(project.database, all_pairs(project.database), GUIDED)
    assert rows(project.database) == unbroken[1]


# Damaged features


def test_no_features_cost_their_own_pairs_only(
    project_copy: MakeProject, caplog: pytest.LogCaptureFixture
) -> None:
    database = project_copy().database
    change(
        database,
        "DELETE FROM keypoints WHERE image_id = 1",
        "DELETE FROM descriptors WHERE image_id = 1",
        "UPDATE keypoints SET rows = 0, data = NULL WHERE image_id = 2",
        "UPDATE descriptors SET rows = 0, data = NULL WHERE image_id = 2",
    )
    report = match_pairs(database, all_pairs(database, 4), THOROUGH)
    assert report.matched == len(rows(database)) == 6
    assert {images_of_pair(pair) for pair, row in rows(database).items() if row[3]} <= {(3, 4)}
    (warning,) = caplog.messages
    assert "2 images have no features (first: " in warning
    assert "5 pairs with them cannot be verified" in warning


def test_unequal_numbers_are_refused_before_anything_is_written(
    project_copy: MakeProject,
) -> None:
    database = project_copy().database
    change(
        database,
        "UPDATE descriptors SET rows = rows - 1,"
        " data = substr(data, 1, 128 * (rows - 1)) WHERE image_id = 2",
    )
    for options in (GUIDED, MatchOptions("colmap")):
        with pytest.raises(InputError, match=r"keypoints but [\d,]+ descriptors.*extract them"):
            match_pairs(database, all_pairs(database), options)
    assert rows(database) == {}


def test_keypoints_that_are_not_finite_are_passed_over(
    project_copy: MakeProject, caplog: pytest.LogCaptureFixture
) -> None:
    database = project_copy().database
    with open_database(database) as colmap:
        keypoints = colmap.keypoint_shapes(1).copy()
    keypoints[:100, 0] = np.nan
    keypoints[100:200, 2] = np.inf
    with closing(sqlite3.connect(database)) as connection:
        connection.execute(
            "UPDATE keypoints SET data = ? WHERE image_id = 1", (keypoints.tobytes(),)
        )
        connection.commit()
    report = match_pairs(database, all_pairs(database, 3), GUIDED)
    assert report.matched == 3 and report.verified >= 1
    assert ["1 image has keypoints that are not finite" in m for m in caplog.messages] == [True]
    with open_database(database) as colmap:
        used = [*colmap.inlier_matches(1, 2)[:, 0], *colmap.inlier_matches(1, 3)[:, 0]]
    assert used and min(used) >= 200


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE descriptors SET type = 1",
        "UPDATE descriptors SET cols = 64, data = substr(data, 1, 64 * rows) WHERE image_id = 1",
    ],
)
def test_features_that_are_not_sift_are_refused_before_anything_is_written(
    statement: str, project_copy: MakeProject
) -> None:
    database = project_copy().database
    change(database, statement)
    for options in (GUIDED, MatchOptions("colmap")):
        with pytest.raises(InputError, match=r"DJI_0001\.JPG\) have other local feat"):
            match_pairs(database, all_pairs(database, 3), options)
    assert rows(database) == {}


def test_sift_beside_other_features_goes_to_colmap(
    project_copy: MakeProject, caplog: pytest.LogCaptureFixture
) -> None:
    database = project_copy().database
    change(database, "UPDATE descriptors SET type = 1 WHERE image_id = 1")
    report = match_pairs(database, all_pairs(database, 3)[-1:], GUIDED)
    assert (report.matcher, report.matched, report.verified) == ("colmap", 1, 1)
    assert "COLMAP's matcher is used" in caplog.messages[0]


def test_a_database_without_descriptors_goes_to_colmap(
    project_copy: MakeProject, caplog: pytest.LogCaptureFixture
) -> None:
    database = project_copy(matched=True).database
    change(database, "DELETE FROM descriptors")
    report = match_pairs(database, all_pairs(database, 3), GUIDED)
    assert (report.already, report.matcher) == (3, "colmap")


# The command line


def test_match_takes_the_matcher(project_copy: MakeProject) -> None:
    project = project_copy()
    make_strange(project.database, 1)
    (project.folder / "pairs.txt").write_text(
        "".join(f"{a} {b}\n" for a, b in all_pairs(project.database, 4))
    )
    run = partial(CliRunner().invoke, cli)
    arguments = ["match", "--db", str(project.database)]
    bad = run([*arguments, "--matcher", "gided"])
    assert bad.exit_code and "choose colmap, guided" in bad.output
    bad = run([*arguments, "--matcher", "colmap", "--thorough"])
    assert bad.exit_code and "--thorough would be ignored" in bad.output.replace("`", "")
    good = run([*arguments, "--matcher", "guided"])
    assert good.exit_code == 0, good.output
    assert "verified, 3 given up at a glance" in good.output


def test_every_matcher_can_be_found() -> None:
    assert {find_matcher(MatchOptions(name)).name for name in MATCHERS} == set(MATCHERS)


# The search near the place where a feature is expected


def towards(start: NDArray[np.float64], end: NDArray[np.float64], angle: float) -> np.ndarray:
    """Turn a unit vector towards another by an angle, rad."""
    across = end - (end @ start) * start
    return np.cos(angle) * start + np.sin(angle) * across / np.linalg.norm(across)


@pytest.mark.parametrize("twin", [False, True])
def test_a_match_must_be_distinct_from_features_far_away_too(twin: bool) -> None:
    random = np.random.default_rng(0)
    at = np.concatenate([[[100, 100]], random.uniform(0, 2000, (1500, 2)), [[1900, 1900]]])
    shape = np.tile(np.float32([2.0, 0.0, 0.0, 2.0]), (len(at), 1))
    drawn = random.random((len(at) + 2, 128)) ** 4
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    descriptors, elsewhere = drawn[:-2], drawn[-2:]
    moved = descriptors.copy()
    moved[0] = towards(descriptors[0], elsewhere[0], 0.65)
    if twin:
        moved[-1] = towards(descriptors[0], elsewhere[1], 0.7)
    one, other = (
        prepare(
            np.column_stack([at, shape]).astype(np.float32), np.rint(512 * rows).astype(np.uint8)
        )
        for rows in (descriptors, moved)
    )
    found = match(one, other)
    assert found.stage is Stage.NARROW
    pairs = set(map(tuple, found.matches.tolist()))
    assert len(pairs) >= 1500 and {(i, i) for i in range(1, 1501)} <= pairs
    assert ((0, 0) in pairs) != twin


# Properties


@st.composite
def photos(draw: st.DrawFn) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return keypoints and descriptors: some of a scene that all share, moved, some of noise."""
    shared = draw(st.integers(0, 60))
    noise = draw(st.integers(0, 40))
    columns = draw(st.sampled_from([2, 4, 6]))
    seed = draw(st.integers(0, 5))
    scene, own = np.random.default_rng(7), np.random.default_rng(seed)
    at = scene.uniform(0, 500, (60, 2))[:shared]
    turn = own.uniform(0, 6)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    at = np.concatenate([at @ rotation.T * own.uniform(0.5, 2), own.uniform(0, 500, (noise, 2))])
    shape = np.tile(np.float32([2.0, turn, 0.0, 2.0]), (len(at), 1))
    descriptors = np.concatenate(
        [scene.random((60, 128))[:shared] ** 4, own.random((noise, 128)) ** 4]
    )
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    codes = np.clip(np.rint(512 * descriptors / np.maximum(norms, 1e-9)), 0, 255).astype(np.uint8)
    keypoints = np.column_stack([at, shape])[:, :columns].astype(np.float32)
    order = own.permutation(len(at))
    return keypoints[order], codes[order]


@settings(max_examples=60, deadline=None)
@given(photos(), photos(), st.booleans())
def test_matching_is_symmetric_uses_no_feature_twice_and_stays_within(
    one: tuple[NDArray[np.float32], NDArray[np.uint8]],
    other: tuple[NDArray[np.float32], NDArray[np.uint8]],
    thorough: bool,
) -> None:
    first, second = prepare(*one), prepare(*other)
    there, back = match(first, second, thorough), match(second, first, thorough)
    assert there.stage is back.stage
    assert sorted(map(tuple, there.matches.tolist())) == sorted(
        (i, j) for j, i in back.matches.tolist()
    )
    assert there.matches.shape[1] == 2 and there.matches.dtype == np.uint32
    for column, features in zip(there.matches.T, (first, second), strict=True):
        assert len(set(column.tolist())) == len(column)
        assert not len(column) or column.max() < len(features)
