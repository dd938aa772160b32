"""GPS is a hint: what cannot be right is put aside and said, and disables nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from colmap_netvlad.colmap.positions import find_priors
from colmap_netvlad.photos.positions import CoordinateSystem, PosePrior, place, read_gps

NAMES = [f"DJI_{i:04d}.JPG" for i in range(5)]


def wgs84(latitude: float, longitude: float, altitude: float = 100.0) -> PosePrior:
    return PosePrior((latitude, longitude, altitude), CoordinateSystem.WGS84)


def line(count: int) -> list[PosePrior | None]:
    """Photos 11.1 m apart on a line to the north."""
    return [wgs84(47.0 + i * 1e-4, 8.0) for i in range(count)]


def test_degrees_become_metres() -> None:
    positions = place(line(5), NAMES)
    steps = np.diff(positions.metres[:, 1])
    assert steps == pytest.approx([11.118] * 4, abs=0.001)
    assert positions.known.all()
    assert positions.notes == ()


@given(st.floats(-80, 80), st.floats(-179, 179), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_distances_are_the_globe_s(
    latitude: float, longitude: float, north: float, east: float
) -> None:
    import pycolmap

    both = [wgs84(latitude, longitude), wgs84(latitude + north, longitude + east)]
    positions = place(both, NAMES[:2])
    if not positions.useful:
        return
    earth = pycolmap.GPSTransform().ellipsoid_to_ecef([list(prior.position) for prior in both])
    true = float(np.linalg.norm(earth[0] - earth[1]))
    ours = float(np.linalg.norm(positions.metres[0] - positions.metres[1]))
    assert ours == pytest.approx(true, rel=1e-6, abs=1e-6)


def test_a_photo_without_gps_disables_nothing() -> None:
    found = line(5)
    found[2] = None
    positions = place(found, NAMES)
    assert positions.known.tolist() == [True, True, False, True, True]
    assert positions.useful


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (wgs84(0.0, 0.0), "latitude and longitude zero"),
        (wgs84(52.0, 13.0), "far from all others"),
        (wgs84(147.0, 8.0), "off the globe"),
    ],
)
def test_wrong_gps_is_put_aside_and_said(wrong: PosePrior, said: str) -> None:
    found = line(5)
    found[3] = wrong
    positions = place(found, NAMES)
    assert positions.known.tolist() == [True, True, True, False, True]
    assert len(positions.notes) == 1
    assert said in positions.notes[0]
    assert "DJI_0003.JPG" in positions.notes[0]


def test_swapped_latitude_and_longitude_are_put_right_and_said() -> None:
    found = line(5)
    found[1] = wgs84(8.0, 47.0001)
    positions = place(found, NAMES)
    assert positions.metres[1] == pytest.approx(place(line(5), NAMES).metres[1], abs=0.2)
    assert "swapped" in positions.notes[0]


def test_equal_gps_in_all_photos_says_nothing() -> None:
    positions = place([wgs84(47.0, 8.0)] * 3, NAMES[:3])
    assert not positions.useful
    assert not positions.known.any()
    assert "equal" in positions.notes[0]


def test_repeated_gps_is_said_and_used() -> None:
    found = line(5)
    found[3] = found[2]
    positions = place(found, NAMES)
    assert positions.known.all()
    (note,) = positions.notes
    assert note.startswith("1 photo (first: DJI_0003.JPG) had exactly the position of one before")
    bands = ["IMG_0000_1.tif", "IMG_0000_2.tif", "IMG_0001_1.tif"]  # one shot, one place
    assert place([found[0], found[0], found[1]], bands).notes == ()


def test_gps_in_one_photo_is_not_useful() -> None:
    positions = place([wgs84(47.0, 8.0), None, None], NAMES[:3])
    assert not positions.useful


def test_no_positions_at_all_are_no_fault() -> None:
    positions = place([None, None], NAMES[:2])
    assert not positions.useful
    assert positions.notes == ()


def test_cartesian_priors_are_taken_as_they_are() -> None:
    found = [PosePrior((float(i), 2.0 * i, 50.0), CoordinateSystem.CARTESIAN) for i in range(3)]
    assert place(found, NAMES[:3]).metres.tolist() == [[0, 0, 50], [1, 2, 50], [2, 4, 50]]


def test_gps_is_read_from_exif_in_both_hemispheres(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x8825] = {
        1: "S",
        2: (33.0, 30.0, 36.0),
        3: "W",
        4: (70.0, 15.0, 0.0),
        5: b"\x00",
        6: 512.5,
    }
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    prior = read_gps(tmp_path / "a.jpg")
    assert prior is not None
    assert prior.position == pytest.approx((-33.51, -70.25, 512.5))


@pytest.mark.parametrize("content", [b"", b"not a photo", None])
def test_a_photo_without_readable_gps_has_none(tmp_path: Path, content: bytes | None) -> None:
    photo = tmp_path / "a.jpg"
    if content is None:
        Image.new("RGB", (8, 8)).save(photo)
    else:
        photo.write_bytes(content)
    assert read_gps(photo) is None


def test_a_flight_across_the_antimeridian_is_one_flight() -> None:
    found = [wgs84(-17.0, longitude) for longitude in (179.9992, 179.9996, -180, -179.9996)]
    positions = place([*found, wgs84(-17.0, 12.0)], NAMES)
    steps = np.diff(positions.metres[:4, 0])
    assert steps == pytest.approx([42.5] * 3, abs=0.1)
    assert positions.known.tolist() == [True, True, True, True, False]


def test_a_missing_height_is_not_taken_for_zero(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x8825] = {1: "N", 2: (47, 0, 0), 3: "E", 4: (8, 0, 0)}
    Image.new("RGB", (32, 32)).save(tmp_path / "a.jpg", exif=exif)
    prior = read_gps(tmp_path / "a.jpg")
    assert prior is not None
    assert prior.position[:2] == (47.0, 8.0)
    assert np.isnan(prior.position[2])
    positions = place([prior, wgs84(47.001, 8.0)], NAMES[:2])
    assert positions.metres[0, 2] == pytest.approx(0.0, abs=0.01)  # for those that want a number
    assert positions.geographic is not None
    assert np.isnan(positions.geographic[0, 2])


def test_a_name_that_leads_out_of_the_photo_folder_is_not_opened(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x8825] = {1: "N", 2: (47, 0, 0), 3: "E", 4: (8, 0, 0)}
    (tmp_path / "photos").mkdir()
    for name in ("outside.jpg", "photos/inside.jpg"):
        Image.new("RGB", (32, 32)).save(tmp_path / name, exif=exif)
    outside, inside = find_priors(["../outside.jpg", "inside.jpg"], None, tmp_path / "photos")
    assert outside is None and inside is not None
