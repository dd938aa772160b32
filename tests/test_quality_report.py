"""A flight's quality report: its figures against known truth, its page, its command."""

from __future__ import annotations

import json
import os
import re
import sqlite3
from contextlib import closing
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from models import grid_model
from test_report import Outline

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.commands.report import find_positions, model_of, report, save_run
from colmap_netvlad.demo.simulate import FOCAL, SimulationOptions, simulate_flight
from colmap_netvlad.graph.lookalikes import Lookalike
from colmap_netvlad.graph.pair import as_pair
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.photos.shutters import RollingShutter
from colmap_netvlad.report import missing as reasons
from colmap_netvlad.report import quality as quality_module
from colmap_netvlad.report.cameras import camera_reports
from colmap_netvlad.report.flight_page import render_flight_page
from colmap_netvlad.report.ground import fit_frame, overlap_map
from colmap_netvlad.report.missing import missing_photos
from colmap_netvlad.report.modeldata import read_model_data
from colmap_netvlad.report.quality import (
    Run,
    Source,
    common_points_graph,
    judge,
    measure,
    overall,
    percent,
    verdict_lines,
)
from colmap_netvlad.runtime.errors import InputError


@pytest.fixture(scope="module")
def grid() -> pycolmap.Reconstruction:
    return grid_model(5)


@pytest.fixture(scope="module")
def mapped(flight, matched_database, tmp_path_factory) -> Path:
    """A workspace of the rendered flight: images, project.db, sparse/0 with all 12 photos."""
    folder = tmp_path_factory.mktemp("mapped") / "survey"
    folder.mkdir()
    (folder / "images").symlink_to(flight.images)
    (folder / "project.db").write_bytes(matched_database.read_bytes())
    (model,) = map_incremental(folder / "project.db", flight.images, folder / "sparse")
    assert model.num_reg_images() == 12
    return folder


def page_of(model: pycolmap.Reconstruction, **source) -> str:
    quality = measure(Source("flight", model, Path("sparse/0"), **source))
    return render_flight_page(quality, judge(quality))


# Figures


def test_reprojection_errors_are_colmaps(mapped):
    model = pycolmap.Reconstruction(mapped / "sparse/0")
    data = read_model_data(model)
    assert data.mean_track_length == pytest.approx(model.compute_mean_track_length())
    assert data.observations.sum() == model.compute_num_observations() == data.histogram.sum()
    for i in (0, 7):
        image = model.find_image_with_name(data.names[i])
        errors = [
            np.linalg.norm(point.xy - image.project_point(model.point3D(point.point3D_id).xyz))
            for point in image.get_observation_points2D()
        ]
        assert data.errors[i] == pytest.approx(np.mean(errors))
        regions = data.regions[image.camera_id]
    assert regions.count.sum() == data.observations.sum()
    assert regions.lengths.sum() / regions.count.sum() == pytest.approx(data.observation_error)
    assert data.mean_error == pytest.approx(model.compute_mean_reprojection_error())


def test_model_lies_on_its_positions_and_one_wrong_position_turns_nothing(grid):
    data = read_model_data(grid)
    turn = pycolmap.Rotation3d(np.array([0.3, -0.2, 1.0])).matrix()
    true = 2.5 * data.centres @ turn.T + [100, 200, 300]
    rng = np.random.default_rng(1)
    positions = true + rng.normal(0, 0.5, true.shape)
    positions[7] += [0, 90, 0]
    positions[3] = np.nan
    frame = fit_frame(data, positions)
    assert frame.metric and frame.scale == pytest.approx(2.5, rel=0.02)
    assert np.flatnonzero(frame.outliers).tolist() == [7]
    assert np.linalg.norm(frame.move(data.centres) - true, axis=1).max() < 1
    assert np.linalg.norm(frame.residuals[7]) == pytest.approx(90, abs=2)
    assert np.isnan(frame.residuals[3]).all()


def test_pixel_and_footprint_are_those_of_the_flight(flight, mapped):
    database, images = mapped / "project.db", mapped / "images"
    model = pycolmap.Reconstruction(mapped / "sparse/0")
    positions = find_positions(model, database, images)
    quality = measure(Source("f", model, mapped, database, images, positions))
    true_pixel = 45.0 / flight.focal
    assert np.nanmedian(quality.pixel) == pytest.approx(true_pixel, rel=0.08)
    x, y = quality.corners[..., 0], quality.corners[..., 1]
    areas = 0.5 * np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(axis=1))
    assert np.median(areas) == pytest.approx(400 * 300 * true_pixel**2, rel=0.2)
    middles = quality.corners.mean(axis=1) - quality.frame.move(quality.data.centres)[:, :2]
    assert np.linalg.norm(middles, axis=1).max() < 8  # photos look down, tilted by a few degrees
    across, height = quality.errors_against_gps
    assert across < 0.5 and height < 0.5


def test_overlap_counts_footprints():
    square = np.array([(0, 0), (10, 0), (10, 10), (0, 10)], float)
    corners = np.stack(
        [square, np.add(square, [5, 0]), np.add(square, [100, 0]), np.full((4, 2), np.nan)]
    )
    found = overlap_map(corners, np.array([(0.0, 0.0), (15.0, 0.0), (15.0, 10.0), (0.0, 10.0)]))
    assert found.area == pytest.approx(250, rel=0.08)
    assert (found.count == 2).sum() * found.cell**2 == pytest.approx(50, rel=0.1)
    assert found.count.max() == 2
    assert found.share(1) == pytest.approx(1, abs=0.05)
    assert found.share(2) == pytest.approx(1 / 3, abs=0.05)
    assert overlap_map(corners[3:], np.zeros((1, 3))) is None


def test_common_points_are_counted(grid):
    data = read_model_data(grid)
    seen = [set(data.seen_points[a:b]) for a, b in zip(data.starts, data.starts[1:], strict=False)]
    expected = {
        (i, j): len(seen[i] & seen[j])
        for i in range(25)
        for j in range(i + 1, 25)
        if len(seen[i] & seen[j]) >= 15
    }
    graph = common_points_graph(data)
    found = {(i, j): n for (i, j), n in zip(graph.edges.tolist(), graph.inliers, strict=True)}
    assert found == expected and graph.names == data.names


def test_uncertainty_of_a_camera_covers_its_true_focal_length(tmp_path):
    """Twice: where GPS-free flat nadir photos know it badly, and what is said of it."""
    simulate_flight(tmp_path / "a.db", SimulationOptions(lines=3, photos=6))
    (model,) = map_incremental(tmp_path / "a.db", None, tmp_path / "sparse")
    data = read_model_data(model)
    frame = fit_frame(data, np.full((18, 3), np.nan))
    with open_database(tmp_path / "a.db") as database:
        (camera,) = camera_reports(model, data, frame, database.cameras())
    focal = camera.parameters[0]
    assert focal.name == "f" and focal.initial == pytest.approx(FOCAL * 1.01)
    assert 0 < focal.sigma < 0.05 * FOCAL
    assert abs(focal.adjusted - FOCAL) < 4 * focal.sigma
    assert camera.parameters[1].sigma is None  # the principal point is held fixed


def test_flat_nadir_photos_are_warned_of():
    flat = grid_model(4)
    for point in flat.points3D.values():
        point.xyz = (point.xyz[0], point.xyz[1], 0.0)
    data = read_model_data(flat)
    (camera,) = camera_reports(flat, data, fit_frame(data, np.full((16, 3), np.nan)), {})
    assert any("hardly be told apart" in text for text in camera.warnings)


# Missing photos


def no_points(name: str) -> np.ndarray:
    return np.full(5000, -1)


def all_points(name: str) -> np.ndarray:
    return np.arange(5000)


def test_each_missing_photo_has_its_reason(project_copy):
    database = project_copy(matched=True).database
    names = image_names(database)
    with closing(sqlite3.connect(database)) as connection:
        ids = dict(connection.execute("SELECT name, image_id FROM images"))
        connection.execute("UPDATE keypoints SET rows = 0 WHERE image_id = ?", (ids[names[0]],))
        pairs = "pair_id / 2147483647 = {0} OR pair_id % 2147483647 = {0}"
        for name, table in product(names[:2], ("two_view_geometries", "matches")):
            connection.execute(f"DELETE FROM {table} WHERE {pairs.format(ids[name])}")
        own = pairs.format(ids[names[2]])
        connection.execute(
            f"UPDATE two_view_geometries SET rows = 3, data = substr(data, 1, 24)"
            f" WHERE rows > 3 AND ({own})"
        )
        connection.commit()

    def reason(name, registered, points_of, elsewhere=()):
        with open_database(database) as opened:
            found = missing_photos(opened, registered, points_of, elsewhere)
        return {photo.name: photo for photo in found}[name]

    rest = set(names[4:])
    assert reason(names[0], rest, all_points).reason == reasons.NO_FEATURES
    assert reason(names[1], rest, all_points).reason == reasons.NOT_MATCHED
    unverified = reason(names[2], rest, all_points)
    assert unverified.reason == reasons.NO_VERIFIED_PAIR and "at most 3 " in unverified.details
    assert reason(names[3], rest, no_points).reason == reasons.TOO_FEW_POINTS
    left_out = reason(names[3], rest, all_points)
    assert left_out.reason == reasons.LEFT_OUT and left_out.points > 30 and left_out.pairs > 2
    assert reason(names[3], (), all_points).reason == reasons.APART
    assert reason(names[3], rest, all_points, {names[3]}).reason == reasons.ELSEWHERE


# The verdict


def test_a_good_model_is_green_and_a_poor_one_says_why(mapped):
    model = pycolmap.Reconstruction(mapped / "sparse/0")
    database, images = mapped / "project.db", mapped / "images"
    positions = find_positions(model, database, images)
    source = Source("f", model, mapped / "sparse/0", database, images, positions)
    quality = measure(source)
    levels = {check.title: check.level for check in judge(quality)}
    assert levels["Photos registered"] == levels["Against GPS"] == "green"
    for frame_id in list(model.reg_frame_ids())[:5]:
        model.deregister_frame(frame_id)
    poor = measure(source)
    checks = judge(poor)
    assert overall(checks) == "red"
    registered = next(check for check in checks if check.title == "Photos registered")
    assert registered.value == "7 of 12 (58.3 %)" and "Missing: 5 " in registered.reason
    lines = verdict_lines(poor, checks, Path("sparse/0/report.html"))
    assert len(lines) == 5 and lines[0].startswith("Verdict: RED (photos registered")
    assert lines[-1] == "Report: sparse/0/report.html"


def test_weak_links_are_those_of_the_pairs_that_were_mapped(mapped, monkeypatch):
    model, database = pycolmap.Reconstruction(mapped / "sparse/0"), mapped / "project.db"
    source = Source("f", model, mapped / "sparse/0", database, run=Run("reconstruct"))
    graph = measure(source).graph
    of_first = [(graph.names[i], graph.names[j]) for i, j in graph.edges.tolist() if i == 0]
    against = [Lookalike(as_pair(*pair), 50, "", True, 2.0) for pair in of_first[1:]]
    monkeypatch.setattr(quality_module, "find_lookalikes", lambda *_: against)
    for dropped, value in ((0, "none"), (len(against), "1 photo, 1 pair")):
        quality = measure(replace(source, run=Run("reconstruct", dropped=dropped)))
        (weak,) = (check for check in judge(quality) if check.title == "Weak links")
        assert weak.value == value
        assert quality.links.bridges == ((of_first[0],) if dropped else ())


def test_positions_of_another_flight_are_red(grid):
    data = read_model_data(grid)
    rng = np.random.default_rng(2)
    positions = dict(zip(data.names, rng.uniform(-80, 80, (25, 3)), strict=True))
    quality = measure(Source("f", grid, Path("m"), positions=positions))
    (check,) = (check for check in judge(quality) if check.title == "Against GPS")
    assert check.level == "red" and "bent or folded" in check.reason


def test_the_verdict_says_which_positions_its_gps_error_leaves_out(grid):
    data = read_model_data(grid)
    positions = dict(zip(data.names, data.centres + np.array([100, 200, 300]), strict=True))
    positions[data.names[7]] += [0, 90, 0]
    quality = measure(Source("f", grid, Path("m"), positions=positions))
    lines = verdict_lines(quality, judge(quality), Path("report.html"))
    assert lines[3].endswith("(root mean square, 1 photo far from its GPS left out).")


def test_pairs_in_doubt_are_not_called_none(mapped):
    model = pycolmap.Reconstruction(mapped / "sparse/0")
    database = mapped / "project.db"
    quality = measure(Source("f", model, mapped / "sparse/0", database))
    doubt = Lookalike(("a", "b"), 20, "Tilted.", False, 1.5)
    values = {}
    for found in ([], [doubt], [doubt, replace(doubt, contradicted=True)]):
        checks = judge(replace(quality, lookalikes=found))
        values[len(found)] = {c.title: c.value for c in checks}["Look-alikes"]
    assert values == {0: "none found", 1: "none contradicted, 1 doubtful", 2: "1 pair"}


def test_only_all_is_hundred_per_cent():
    assert percent(1) == "100 %" and percent(0.99999) == "99.9 %" and percent(0.5) == "50.0 %"


# The page


def test_page_refers_to_nothing_outside_and_runs_our_script_alone(grid):
    text = page_of(grid)
    for attribute in re.findall(r'(?:src|href|srcset|action)="([^"]*)"', text):
        assert attribute.startswith(("data:", "#")), attribute[:80]
    assert "@import" not in text and "url(http" not in text
    assert text.count("<script") == 2 and "default-src &#39;none&#39;" in text
    outline = Outline(text)
    assert len(outline.ids) == len(set(outline.ids))
    assert all(attributes.get("alt") for tag, attributes in outline.tags if tag == "img")
    assert text == page_of(grid)


def test_names_are_escaped_everywhere():
    names = tuple(f"</script><script>alert({i})</script>&.jpg" for i in range(16))
    text = page_of(grid_model(4, names=names))
    assert text.count("<script") == 2 and "alert(3)" in text
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', text, re.DOTALL)[1])
    assert facts["names"] == sorted(names)


def test_what_is_missing_is_said(grid):
    text = page_of(grid)
    assert "There is no database" in text and "There is no photo folder" in text
    assert "no registered photos with a position" in text
    nothing = page_of(pycolmap.Reconstruction())
    assert "no points" in nothing and 'id="plan"' not in nothing
    one = grid_model(1)
    assert "no points" in page_of(one)
    Outline(nothing)
    Outline(page_of(one))
    for image in grid.images.values():
        assert image.name in text


def test_a_model_without_points_still_shows_its_cameras(grid):
    bare = pycolmap.Reconstruction(grid)
    bare.delete_all_points2D_and_points3D()
    text = page_of(bare)
    assert 'id="plan"' in text and 'id="overlap"' not in text and "no points" in text


def test_photos_on_one_line_have_no_metres(grid):
    data = read_model_data(grid)
    line = dict(zip(data.names, np.arange(25)[:, None] * [1.0, 2.0, 0.0], strict=True))
    assert "lie on one line" in page_of(grid, positions=line)


def test_page_of_many_photos_each_with_a_camera_stays_small():
    many = grid_model(32, points=6, cameras=True)
    text = page_of(many)
    assert len(text) < 4e6
    assert text.count("<h3>Camera ") == 8 and "of 1,024" in text


# The command


def test_report_of_a_model_made_by_colmap_alone(mapped, tmp_path):
    run = CliRunner().invoke(cli, ["report", "--sparse", str(mapped / "sparse")])
    assert run.exit_code == 0, run.output
    lines = run.stdout.splitlines()
    page = mapped / "sparse/0/report.html"
    assert len(lines) == 5 and lines[-1] == f"Report: {page}"
    text = page.read_text("utf-8")
    assert 'Quality of <span class="project">survey</span>' in text
    assert "12 of 12" in text and "The model does not say how it was made" in text
    save_run(mapped / "sparse/0", Run("colmap-netvlad <b>", {"mapping": 61.0}, {"seed": "7"}))
    output = tmp_path / "elsewhere.html"
    report(mapped / "sparse/0", output=output)
    text = output.read_text("utf-8")
    assert "colmap-netvlad &lt;b&gt;" in text and "61.0 s" in text and "seed: 7" in text
    (mapped / "sparse/0/run.json").write_text("{broken")
    report(mapped / "sparse/0", output=output)
    (mapped / "sparse/0/run.json").unlink()


def test_text_models_and_photos_elsewhere(mapped, tmp_path):
    model = pycolmap.Reconstruction(mapped / "sparse/0")
    model.write_text(tmp_path)
    found = report(tmp_path, images=mapped / "images")
    assert found.quality.missing is None and found.quality.frame.metric
    assert found.page == tmp_path / "report.html"


def test_other_models_of_the_run_are_counted(mapped, tmp_path):
    for number, gone in enumerate((3, 7)):
        model = pycolmap.Reconstruction(mapped / "sparse/0")
        for frame_id in list(model.reg_frame_ids())[
            -gone if number else 0 : None if number else gone
        ]:
            model.deregister_frame(frame_id)
        (tmp_path / "sparse" / str(number)).mkdir(parents=True)
        model.write(tmp_path / "sparse" / str(number))
    assert model_of(tmp_path / "sparse").name == "0"
    found = report(tmp_path / "sparse", mapped / "project.db")
    (check,) = (check for check in found.checks if check.title == "Models")
    assert check.value == "2" and check.level == "yellow"
    assert any(photo.reason == reasons.ELSEWHERE for photo in found.quality.missing)


def test_bad_arguments_are_said_in_a_sentence(mapped, tmp_path):
    def fault(*arguments):
        run = CliRunner().invoke(cli, ["report", *map(str, arguments)])
        assert run.exit_code == 1 and "Traceback" not in run.output
        return run.stderr

    sparse = mapped / "sparse"
    assert "does not exist" in fault("--sparse", tmp_path / "none")
    assert "holds no COLMAP model" in fault("--sparse", tmp_path)
    assert "mend --images" in fault("--sparse", sparse, "--images", tmp_path / "none")
    assert "mend --db" in fault("--sparse", sparse, "--db", tmp_path / "none.db")
    simulate_flight(tmp_path / "other.db", SimulationOptions(lines=1, photos=2))
    assert "another project's" in fault("--sparse", sparse, "--db", tmp_path / "other.db")
    for part in ("cameras", "images", "points3D"):
        (tmp_path / f"{part}.bin").write_bytes(b"no model")
    assert "is not a COLMAP model" in fault("--sparse", tmp_path)
    if os.getuid():
        (tmp_path / "locked").mkdir(mode=0o500)
        output = tmp_path / "locked" / "a.html"
        assert "Cannot write" in fault("--sparse", sparse, "--output", output)


def test_reconstruct_writes_the_report_and_says_the_verdict(project_copy):
    project = project_copy(matched=True)
    names = image_names(project.database)
    project.pairs.write_text("".join(f"{a} {b}\n" for a in names for b in names if a < b))
    run = CliRunner().invoke(cli, ["reconstruct", "--db", str(project.database)])
    assert run.exit_code == 0, run.output
    page = project.sparse / "0" / "report.html"
    assert run.stdout.splitlines()[-1] == f"Report: {page}"
    assert "Verdict: " in run.stdout
    text = page.read_text("utf-8")
    assert "mapping" in text and "mapping.seed: 0" in text and "pycolmap 4" in text


def test_a_report_that_cannot_be_made_loses_no_model(project_copy, monkeypatch, caplog):
    from colmap_netvlad.commands import report as module

    def fail(*arguments, **options):
        raise InputError("no space left")

    project = project_copy(matched=True)
    names = image_names(project.database)
    project.pairs.write_text("".join(f"{a} {b}\n" for a in names for b in names if a < b))
    monkeypatch.setattr(module, "write_report", fail)
    run = CliRunner().invoke(cli, ["reconstruct", "--db", str(project.database)])
    assert run.exit_code == 0, run.output
    assert "No quality report of" in run.stderr and "no space left" in run.stderr
    assert (project.sparse / "0" / "images.bin").is_file()


def test_rolling_shutters_are_named_with_their_cost(mapped):
    made = report(mapped / "sparse/0")
    assert made.quality.shutters == []  # the demo's camera is not known to have one
    shutter = RollingShutter("DJI Mavic Air 2 (FC3170)", 0.027, 8.0)
    page = render_flight_page(replace(made.quality, shutters=[shutter]), made.checks)
    assert "DJI Mavic Air 2 (FC3170) has a rolling shutter" in page
    assert re.search(r"at 8.0 m/s the drone flies 22 cm meanwhile, \d\.\d pixels", page)
