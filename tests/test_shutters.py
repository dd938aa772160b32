"""Rolling shutters are named where they are known, with what they cost."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from photos import scene
from PIL import Image

from colmap_netvlad.cli import cli
from colmap_netvlad.demo.exif import Exif, add_exif
from colmap_netvlad.photos.shutters import RollingShutter, find_rolling_shutters

METRE = 360 / 40_030_174
"""Degrees of latitude."""


def photo(path: Path, model: str, number: int = 0, xmp: str = "", step: float = 10.0) -> None:
    """A photo of a drone that flies north and takes one every two seconds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    block = f"<rdf:Description {xmp}/>".encode() if xmp else b""
    Image.fromarray(scene(number)).save(path, quality=90, xmp=block)
    date = f"2024:05:01 12:00:{2 * number:02d}"
    exif = Exif("DJI", model, 24, 50 + number * step * METRE, 8.0, 100.0, date)
    path.write_bytes(add_exif(path.read_bytes(), exif))


def speeds(north: float, east: float) -> str:
    return (
        f'drone-dji:FlightXSpeed="{north:+}" drone-dji:FlightYSpeed="{east:+}" '
        'drone-dji:FlightZSpeed="+0.0"'
    )


def test_speed_comes_from_gps_and_time(tmp_path: Path) -> None:
    names = [f"{i}.jpg" for i in range(8)]
    for i, name in enumerate(names):
        photo(tmp_path / name, "FC3170", i)
    (found,) = find_rolling_shutters(tmp_path, names)
    assert (found.camera, found.readout) == ("DJI Mavic Air 2 (FC3170)", 0.027)
    assert found.speed == pytest.approx(5.0, rel=0.01)
    said = found.sentence(pixel=0.03)
    assert "in 27 ms: at 5.0 m/s the drone flies 14 cm meanwhile, 4.5 pixels" in said
    assert "pixels" not in found.sentence()


def test_what_the_drone_states_comes_first(tmp_path: Path) -> None:
    for i in range(3):
        photo(tmp_path / f"{i}.jpg", "FC3411", i, speeds(3.0, -4.0), step=50.0)
    (found,) = find_rolling_shutters(tmp_path, ["0.jpg", "1.jpg", "2.jpg"])
    assert found.speed == 5.0


def test_a_pause_or_missing_gps_says_nothing_on_speed(tmp_path: Path) -> None:
    photo(tmp_path / "0.jpg", "FC330", 0)
    photo(tmp_path / "1.jpg", "FC330", 20)
    (found,) = find_rolling_shutters(tmp_path, ["0.jpg", "1.jpg"])
    assert found.speed is None and found.shift is None
    assert "the faster the drone flies, the more its lines are apart" in found.sentence()


@pytest.mark.parametrize(
    ("model", "xmp", "named"),
    [
        ("FC220", "", "DJI Mavic Pro (FC220)"),
        ("FC6310", "", None),  # mechanical
        ("M3E", 'drone-dji:ShutterType="Mechanical"', None),
        ("M3E", 'drone-dji:ShutterType="Electronic"', "DJI Mavic 3 Enterprise with its electronic"),
        ("ILCE-7R", "", None),  # not known
    ],
)
def test_only_what_is_known_is_named(
    tmp_path: Path, model: str, xmp: str, named: str | None
) -> None:
    photo(tmp_path / "a.jpg", model, xmp=xmp)
    found = find_rolling_shutters(tmp_path, ["a.jpg"])
    assert [one.camera.startswith(named or "-") for one in found] == [True] * (named is not None)


def test_photos_that_cannot_be_read_say_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"broken")
    assert find_rolling_shutters(tmp_path, ["a.jpg", "missing.jpg", "../b.jpg"]) == []
    assert find_rolling_shutters(tmp_path, []) == []


def test_features_names_it(tmp_path: Path) -> None:
    photo(tmp_path / "images/ü 1.jpg", "FC7203")
    result = CliRunner().invoke(
        cli, ["features", "--images", str(tmp_path / "images"), "--db", str(tmp_path / "a.db")]
    )
    assert result.exit_code == 0, result.output
    assert "DJI Mavic Mini (FC7203) has a rolling shutter" in result.output.replace("\n", " ")


def test_the_shift_needs_readout_and_speed() -> None:
    assert RollingShutter("x", None, 5.0).shift is None
    assert RollingShutter("x", 0.02, 5.0).shift == pytest.approx(0.1)
