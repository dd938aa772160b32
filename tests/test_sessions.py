"""Several flights in one project: what is a session, pairs across, cameras by serial number."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from photos import scene
from PIL import Image

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.pairs.sessions import across_pairs, find_sessions, session_lines
from colmap_netvlad.photos.files import read_header
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError


def photo(path: Path, day: str = "", serial: str = "", xmp: str = "", seed: int = 0) -> None:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "DJI", "FC3582"
    detail: dict[int, object] = {0xA405: 24}
    if day:
        detail[0x9003] = f"{day} 12:00:00"
    if serial:
        detail[0xA431] = serial
    exif[0x8769] = detail
    path.parent.mkdir(parents=True, exist_ok=True)
    block = f"<rdf:Description {xmp}/>".encode()
    Image.fromarray(scene(seed)).save(path, exif=exif, xmp=block if xmp else b"")


def test_sessions_are_folders_days_and_cameras_as_far_as_they_differ(tmp_path: Path) -> None:
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    for name, day, serial in zip(names, ("2024:05:01",) * 3 + ("2024:05:02",), "1121", strict=True):
        photo(tmp_path / name, day, serial)
    assert find_sessions(names, tmp_path) == [
        "2024:05:01, 1", "2024:05:01, 1", "2024:05:01, 2", "2024:05:02, 1"
    ]  # fmt: skip
    assert find_sessions(["x ü/a.jpg", "y/a.jpg"], None) == ["x ü", "y"]
    assert session_lines(["x", "y", "x"]) == ["2 sessions: x (2 photos); y (1 photos)"]


def test_photos_that_say_nothing_are_a_session_of_their_own(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg", "2024:05:01")
    (tmp_path / "b.jpg").write_bytes(b"broken")
    assert find_sessions(["a.jpg", "b.jpg", "missing.jpg"], tmp_path) == [
        "2024:05:01", "unknown", "unknown"
    ]  # fmt: skip


@pytest.mark.parametrize("images", [True, False])
def test_one_flight_has_nothing_across(tmp_path: Path, images: bool) -> None:
    photo(tmp_path / "a.jpg", "2024:05:01", "1")
    shutil.copy(tmp_path / "a.jpg", tmp_path / "b.jpg")
    with pytest.raises(InputError, match="needs several flights"):
        find_sessions(["a.jpg", "b.jpg"], tmp_path if images else None)


def test_each_image_gets_its_best_of_other_sessions() -> None:
    partners = np.array([[1, 2, 3], [0, 3, 2], [3, 0, 1], [2, 1, 0]], np.int32)
    scores = np.array([[9, 5, 4], [9, 6, 3], [8, 5, 3], [8, 6, 4]], np.float32)
    ranking = Ranking(("a", "b", "c", "d"), partners, scores, "test")
    found = across_pairs(ranking, ["x", "x", "y", "y"], 1)
    assert [(p.name1, p.name2, p.score) for p in found] == [("a", "c", 5.0), ("b", "d", 6.0)]
    assert len(across_pairs(ranking, ["x", "x", "y", "y"], 2)) == 4


def test_the_command_pairs_across_folders(
    project_copy: Callable[..., Project], tmp_path: Path
) -> None:
    images = tmp_path / "photos"
    project = project_copy()
    assert project.images is not None
    names = sorted(path.name for path in project.images.iterdir() if path.suffix == ".JPG")
    for number, name in enumerate(names):
        target = images / ("one" if number < 6 else "two") / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(project.images / name, target)
    database = tmp_path / "flights.db"
    extract_features(images, database, FeatureOptions(max_features=1500))
    arguments = ["pairs", "--db", database, "--images", images, "--method", "vlad", "--k", "2"]
    result = CliRunner().invoke(cli, [str(a) for a in [*arguments, "--across", "3", "--json"]])
    assert result.exit_code == 0, result.output
    pairs = [line.split() for line in (tmp_path / "pairs.txt").read_text().splitlines()]
    across = {name: 0 for pair in pairs for name in pair}
    for one, other in pairs:
        if one.split("/")[0] != other.split("/")[0]:
            across[one] += 1
            across[other] += 1
    assert len(across) == 12 and min(across.values()) >= 3
    said = CliRunner().invoke(cli, [str(a) for a in [*arguments, "--across", "3"]]).output
    assert "2 sessions: one (6 photos); two (6 photos)" in said


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({"serial": "A1"}, "A1"),
        ({"xmp": 'drone-dji:CameraSerialNumber="C7" drone-dji:DroneSerialNumber="D8"'}, "C7"),
        ({"xmp": 'drone-dji:DroneSerialNumber="D8"'}, "D8"),
        ({}, None),
    ],
)
def test_serial_numbers_are_read(
    tmp_path: Path, said: dict[str, str], expected: str | None
) -> None:
    photo(tmp_path / "a.jpg", **said)
    assert read_header(tmp_path / "a.jpg").serial == expected


def test_two_drones_of_one_model_are_two_cameras(tmp_path: Path) -> None:
    for number, serial in enumerate(["A", "A", "B", "B"]):
        photo(tmp_path / f"images/{number}.jpg", serial=serial, seed=number)
    report = extract_features(tmp_path / "images", tmp_path / "project.db")
    assert report.cameras == 2
    photo(tmp_path / "images/9.jpg", serial="B", seed=9)
    assert extract_features(tmp_path / "images", tmp_path / "project.db").cameras == 2
    single = extract_features(
        tmp_path / "images", tmp_path / "single.db", FeatureOptions(camera="single")
    )
    assert single.cameras == 1
