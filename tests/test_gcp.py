"""Ground points: read, triangulated, aligned to, held in the adjustment, reported."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner, Result
from pyproj.transformer import TransformerGroup

from colmap_netvlad.cli import cli
from colmap_netvlad.demo.simulate import (
    FRAME,
    SimulationOptions,
    simulate_control,
    simulate_flight,
)
from colmap_netvlad.geo.gcp import read_control
from colmap_netvlad.geo.georeference import read_frame
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.runtime.errors import InputError

FLIGHT = SimulationOptions(lines=2, photos=40, features=200, partners=8, gps=2.0)
MARKS = 0.5


@dataclass(frozen=True)
class Controlled:
    """A simulated flight with its model and a list of ten ground points."""

    folder: Path
    truth: dict[str, np.ndarray]
    points: dict[str, np.ndarray]

    @property
    def list(self) -> Path:
        return self.folder / "gcp_list.txt"


@pytest.fixture(scope="module")
def controlled(tmp_path_factory: pytest.TempPathFactory) -> Controlled:
    folder = tmp_path_factory.mktemp("control")
    truth = simulate_flight(folder / "database.db", FLIGHT)
    points = simulate_control(folder / "gcp_list.txt", FLIGHT, 5, 2, noise=MARKS)
    map_incremental(folder / "database.db", None, folder / "sparse", MappingOptions(threads=1))
    return Controlled(folder, truth, points)


def georegister(controlled: Controlled, gcp: Path, output: Path, *more: str) -> Result:
    sparse = controlled.folder / "sparse/0"
    arguments = ["georegister", "--sparse", sparse, "--output", output, "--gcp", gcp, *more]
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def assert_in_place(controlled: Controlled, output: Path) -> None:
    """The cameras are where they were; a nadir flight leaves its height to the focal length."""
    model, frame = pycolmap.Reconstruction(output), read_frame(output)
    images = [model.image(i) for i in model.reg_image_ids()]
    found = FRAME.from_wgs84(frame.to_wgs84(np.array([i.projection_center() for i in images])))
    found -= np.array([controlled.truth[image.name] for image in images])
    east, north, up = np.sqrt((found**2).mean(axis=0))
    assert east < 0.25 and north < 0.25 and up < 1.0


def test_control_places_the_model_better_than_gps(controlled: Controlled, tmp_path: Path) -> None:
    checks = ("--check", "GCP5", "--check", "GCP8")
    result = georegister(controlled, controlled.list, tmp_path / "out", *checks)
    assert result.exit_code == 0, result.output
    assert "8 control points: 0.0" in result.output
    assert "2 check points: 0." in result.output
    told = json.loads((tmp_path / "out/georeference.json").read_text())["ground_points"]
    assert max(told["control_rms"]) < 0.1
    assert max(told["check_rms"]) < 0.25
    assert [name for name, one in told["points"].items() if one["check"]] == ["GCP5", "GCP8"]
    assert all(one["pixels"] < 1.5 for one in told["points"].values())
    assert_in_place(controlled, tmp_path / "out")


def test_a_list_in_feet_is_in_feet_in_height_too(controlled: Controlled, tmp_path: Path) -> None:
    lines = controlled.list.read_text().splitlines()[1:]
    rows = [line.split() for line in lines]
    feet = [[str(float(value) * 3937 / 1200) for value in row[:3]] + row[3:] for row in rows]
    system = "+proj=utm +zone=30 +datum=WGS84 +units=us-ft"
    list_in_feet = tmp_path / "feet.txt"
    list_in_feet.write_text("\n".join([system, *map(" ".join, feet)]) + "\n")
    result = georegister(controlled, list_in_feet, tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert f"Heights in feet.txt are read in the unit of {system}, US survey foot" in result.output
    assert_in_place(controlled, tmp_path / "out")
    places = [read_control(path, controlled.truth) for path in (controlled.list, list_in_feet)]
    assert places[1].geographic() == pytest.approx(places[0].geographic(), abs=1e-3)


def test_the_adjustment_holds_the_points(controlled: Controlled, tmp_path: Path) -> None:
    from colmap_netvlad.geo.gcp import adjust_to_control, align_to_control, measure_control

    control = read_control(controlled.list, controlled.truth)
    model = pycolmap.Reconstruction(controlled.folder / "sparse/0")
    model.transform(align_to_control(model, control, FRAME))
    before = measure_control(model, control, FRAME).rms(check=False)
    points = model.num_points3D(), model.compute_num_observations()
    error = model.compute_mean_reprojection_error()
    adjust_to_control(model, control, FRAME)
    after = measure_control(model, control, FRAME).rms(check=False)
    assert after[0] < 0.6 * before[0] and after[1] < 0.6 * before[1]
    assert (model.num_points3D(), model.compute_num_observations()) == points
    assert model.compute_mean_reprojection_error() == pytest.approx(error, rel=0.02)


def test_reconstruct_takes_the_list(controlled: Controlled, tmp_path: Path) -> None:
    shutil.copy(controlled.folder / "database.db", tmp_path / "database.db")
    (tmp_path / "pairs.txt").write_text("00000.jpg 00001.jpg\n")
    arguments = ["reconstruct", "--db", tmp_path / "database.db", "--gcp", controlled.list]
    result = CliRunner().invoke(cli, [str(one) for one in [*arguments, "--threads", "1"]])
    assert result.exit_code == 0, result.output
    assert "10 control points" in result.output
    assert_in_place(controlled, tmp_path / "sparse/0")
    page = (tmp_path / "sparse/0/report.html").read_text("utf-8")
    points = json.loads((tmp_path / "sparse/0/georeference.json").read_text())["ground_points"]
    assert '<h2 id="h-ground">Ground points</h2>' in page
    for name, point in points["points"].items():
        east = f"{point['residual'][0]:.3f}".replace("-", "−")
        assert f'<th scope="row">{name}</th><td>control</td>' in page
        assert f"<td>{east}</td>" in page.replace("-", "−")


Lines = list[str]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda lines: [], "is empty"),
        (lambda lines: ["EPSG:123456", *lines[1:]], "line 1: The coordinate system 'EPSG:123456'"),
        (lambda lines: [*lines, "1 2 3 4 00000.jpg"], "is no mark: x y z px py photo are wanted"),
        (lambda lines: [*lines, "1,5 2 3 4 5 00000.jpg A"], "with a point for decimals"),
        (lambda lines: [*lines, "nan 2 3 4 5 00000.jpg A"], "not finite"),
        (lambda lines: [*lines, "1 2 3 4 5 00000.jpg GCP1"], "GCP1 is at another place"),
        (lambda lines: [lines[0], "1 2 3 4 5 other.jpg A"], "marks no point in any photo"),
        (lambda lines: lines[:1] + keep(lines, "GCP1", "GCP2"), "Only 2 control points"),
        (lambda lines: lines[:1] + keep(lines, "GCP1", "GCP3", "GCP5"), "lie on one line"),
    ],
)
def test_a_bad_list_is_one_sentence(
    controlled: Controlled, tmp_path: Path, change: Callable[[Lines], Lines], said: str
) -> None:
    lines = controlled.list.read_text().splitlines()
    if "one line" in said:
        lines = flattened(lines)
    (tmp_path / "gcp.txt").write_text("\n".join(change(lines)) + "\n")
    result = georegister(controlled, tmp_path / "gcp.txt", tmp_path / "out")
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    assert said in result.output
    assert not (tmp_path / "out").exists()


def keep(lines: Lines, *names: str) -> Lines:
    return [line for line in lines if line.split()[-1] in names]


def flattened(lines: Lines) -> Lines:
    """Put the points on one height."""
    return [lines[0]] + [
        " ".join([*line.split()[:2], "100", *line.split()[3:]]) for line in lines[1:]
    ]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda lines: [*lines, "1 2 3 4 5 other.jpg A"], "1 mark of gcp.txt is in photos"),
        (lambda lines: [*lines, "1 2 3 4 5 00000.jpg A"], "point A is marked in 1 registered"),
    ],
)
def test_what_is_put_aside_is_said(
    controlled: Controlled, tmp_path: Path, change: Callable[[Lines], Lines], said: str
) -> None:
    lines = controlled.list.read_text().splitlines()
    (tmp_path / "gcp.txt").write_text("\n".join(change(lines)) + "\n")
    result = georegister(controlled, tmp_path / "gcp.txt", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert said in result.output
    assert "10 control points" in result.output


def test_a_wrong_mark_is_named(controlled: Controlled, tmp_path: Path) -> None:
    lines = controlled.list.read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if line.endswith("GCP4"))
    parts = lines[number].split()
    lines[number] = " ".join([*parts[:3], str(float(parts[3]) + 80), *parts[4:]])
    (tmp_path / "gcp.txt").write_text("\n".join(lines) + "\n")
    result = georegister(controlled, tmp_path / "gcp.txt", tmp_path / "out", "--check", "GCP4")
    assert result.exit_code == 0, result.output
    assert f"The mark of ground point GCP4 in {parts[5]} is" in result.output


def test_check_points_have_to_be_listed(controlled: Controlled, tmp_path: Path) -> None:
    result = georegister(controlled, controlled.list, tmp_path / "out", "--check", "GCP77")
    assert result.exit_code == 1
    assert "lists no point GCP77" in result.output


@pytest.mark.parametrize("joint", [" ", "\t"])
def test_photos_may_have_spaces_and_umlauts_and_folders(tmp_path: Path, joint: str) -> None:
    photos = ["Flug ü 1/DJI 0001.JPG", "b/DJI 0001.JPG", "b/x.jpg"]
    rows = [
        ["7.1", "48.2", "300", "10", "20", "Flug ü 1/DJI 0001.JPG", "Schacht"],
        ["7.1", "48.2", "300", "10.5", "20", "b/DJI 0001.JPG", "Schacht"],
        ["7.2", "48.2", "300", "10", "20", "x.jpg"],
    ]
    path = tmp_path / "gcp.txt"
    path.write_text("\n".join(["EPSG:4326", *(joint.join(row) for row in rows)]), "utf-8")
    control = read_control(path, photos)
    assert [point.name for point in control.points] == ["Schacht", "point 2"]
    assert [mark.photo for mark in control.points[0].marks] == photos[:2]
    assert control.points[1].marks[0].photo == "b/x.jpg"
    assert control.geographic()[0] == pytest.approx([48.2, 7.1, 300], abs=1e-6)


def test_what_a_list_loses_without_grids_is_said(tmp_path: Path) -> None:
    path = tmp_path / "gcp.txt"
    path.write_text("EPSG:27700\n435300 387300 90 10 20 a.jpg\n")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        all_there = TransformerGroup("EPSG:4326", "EPSG:27700").best_available
    assert ("is good to 2 m" in " ".join(read_control(path, ["a.jpg"]).notes)) != all_there


def test_a_list_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "gcp.txt").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match="cannot be read"):
        read_control(tmp_path / "gcp.txt", ["a.jpg"])
