"""EXIF is read wherever a file has it, without decoding the photo."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from photos import scene
from PIL import Image, PngImagePlugin

from colmap_netvlad.photos.accuracy import read_deviations
from colmap_netvlad.photos.exif import exif_of
from colmap_netvlad.photos.files import read_header
from colmap_netvlad.photos.positions import read_gps

MAKE, MODEL, DETAIL, GPS = 0x010F, 0x0110, 0x8769, 0x8825


def tags() -> Image.Exif:
    exif = Image.Exif()
    exif[MAKE], exif[MODEL], exif[DETAIL] = "DJI", "FC6310", {0xA405: 24}
    exif[GPS] = {1: "N", 2: (52.0, 30.0, 0.0), 3: "E", 4: (13.0, 15.0, 0.0), 6: 120.0}
    return exif


def png(exif: Image.Exif | None = None, behind: bool = False) -> bytes:
    """A PNG file; `behind`: its chunk eXIf stands after the pixels, as the format allows."""
    file = BytesIO()
    Image.fromarray(scene()).save(file, "PNG", **({"exif": exif} if exif else {}))
    data = file.getvalue()
    if not behind:
        return data
    start = data.index(b"eXIf") - 4
    end = start + 12 + int.from_bytes(data[start : start + 4], "big")
    last = data.index(b"IEND") - 4
    return data[:start] + data[end:last] + data[start:end] + data[last:]


@pytest.fixture
def undecoded(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(photo: Image.Image) -> None:
        pytest.fail("the photo was decoded")

    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load", load)


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.usefixtures("undecoded")
def test_a_png_has_its_lens_and_position_undecoded(tmp_path: Path, behind: bool) -> None:
    path = tmp_path / "photo.png"
    path.write_bytes(png(tags(), behind))
    assert read_header(path).lens == ("DJI", "FC6310", 24.0)
    position = read_gps(path)
    assert position is not None
    assert position.position == pytest.approx((52.5, 13.25, 120.0))


@pytest.mark.usefixtures("undecoded")
def test_a_png_without_exif_is_known_to_have_none_undecoded(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    path.write_bytes(png())
    assert read_header(path).lens is None
    assert read_gps(path) is None


@pytest.mark.usefixtures("undecoded")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1), st.binary(max_size=40))
def test_letters_of_exif_without_its_checksum_are_pixels(length: int, pixels: bytes) -> None:
    file = BytesIO(png() + length.to_bytes(4, "big") + b"eXIf" + pixels)
    with Image.open(file) as photo:
        assert not exif_of(photo)


def test_pixels_are_whole_after_exif_was_looked_for_behind_them() -> None:
    with Image.open(BytesIO(png(tags(), behind=True))) as photo:
        assert exif_of(photo)[MODEL] == "FC6310"
        assert photo.tobytes() == Image.fromarray(scene()).tobytes()


def test_a_photo_whose_exif_is_broken_has_no_position(tmp_path: Path) -> None:
    file = BytesIO()
    Image.fromarray(scene()).save(file, "JPEG", dpi=(72, 72))
    data, junk = file.getvalue(), b"Exif\0\0XXXXXXXXjunkjunk"
    end = 4 + int.from_bytes(data[4:6], "big")
    segment = b"\xff\xe1" + (len(junk) + 2).to_bytes(2, "big") + junk
    (tmp_path / "photo.jpg").write_bytes(data[:end] + segment + data[end:])
    assert read_header(tmp_path / "photo.jpg").lens is None
    assert read_gps(tmp_path / "photo.jpg") is None
    assert read_deviations(tmp_path / "photo.jpg") is None
