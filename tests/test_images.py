"""Photos -> pixels."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from photos import BROKEN, HEIGHT, SOUND, WIDTH, save_jpeg, scene

from colmap_netvlad.photos.decode import SIDE_MULTIPLE, decode_photo, load_batches
from colmap_netvlad.photos.files import BadPhoto, find_photos, photo_fingerprint, read_header


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.jpg"
    save_jpeg(path, scene())
    return path


@pytest.mark.parametrize("name", SOUND)
def test_every_kind_of_photo_decodes_to_upright_8_bit_rgb(name: str, tmp_path: Path) -> None:
    SOUND[name](tmp_path / name)
    pixels = decode_photo(tmp_path / name, WIDTH)
    assert pixels.dtype == np.uint8
    expected = scene().astype(float)
    if "grey" in name:
        expected = np.repeat(expected @ [[0.299], [0.587], [0.114]], 3, axis=2)
    assert pixels.shape == expected.shape
    # CMYK without a black channel loses little; JPEG costs a few grey levels.
    assert np.abs(pixels - expected).mean() < (12 if name == "cmyk.jpg" else 8)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_photo_is_refused_with_its_reason(name: str, tmp_path: Path) -> None:
    write, reason = BROKEN[name]
    write(tmp_path / name)
    with pytest.raises(BadPhoto, match=reason):
        read_header(tmp_path / name)
    with pytest.raises(BadPhoto, match=reason):
        decode_photo(tmp_path / name, 64)


def test_a_missing_photo_is_refused_with_its_reason(tmp_path: Path) -> None:
    for use in (read_header, photo_fingerprint, lambda path: decode_photo(path, 64)):
        with pytest.raises(BadPhoto, match="is missing"):
            use(tmp_path / "gone.jpg")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(share=st.floats(0.0, 0.999))
def test_a_jpeg_cut_anywhere_is_found(share: float, photo: Path) -> None:
    data = photo.read_bytes()
    cut = photo.with_name("cut.jpg")
    cut.write_bytes(data[: int(share * (len(data) - 2))])
    with pytest.raises(BadPhoto):
        read_header(cut)


def test_a_jpeg_with_bytes_after_its_end_is_whole(photo: Path) -> None:
    photo.write_bytes(photo.read_bytes() + b"appended by a camera" * 100)
    assert read_header(photo).width == WIDTH


def test_the_end_of_an_embedded_thumbnail_is_not_the_photos_end(photo: Path) -> None:
    data = photo.read_bytes()
    thumbnail = b"\xff\xd8" + b"x" * 50 + b"\xff\xd9"
    segment = b"\xff\xe3" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    photo.write_bytes((data[:2] + segment + data[2:])[:-200])
    with pytest.raises(BadPhoto, match="truncated"):
        read_header(photo)


@pytest.mark.parametrize(("long_side", "reduced"), [(64, 8), (100, 4), (200, 2), (400, 1)])
def test_reduced_decoding_keeps_the_picture(long_side: int, reduced: int, tmp_path: Path) -> None:
    pixels = scene(width=800, height=592)
    save_jpeg(tmp_path / "big.jpg", pixels)
    small = decode_photo(tmp_path / "big.jpg", long_side)
    assert max(small.shape) == round(long_side / SIDE_MULTIPLE) * SIDE_MULTIPLE
    quarter = small.shape[0] // 2 - 2, small.shape[1] // 2 - 2
    # The bright corner stays where it is.
    assert (
        small[: quarter[0], : quarter[1]].mean() > small[-quarter[0] :, -quarter[1] :].mean() + 30
    )


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(width=st.integers(16, 300), height=st.integers(16, 300), long_side=st.integers(16, 320))
@example(width=272, height=217, long_side=30)  # decoded at an eighth: 34 x 28, rounded up
@example(width=51, height=16, long_side=248)
def test_sides_are_multiples_and_the_aspect_ratio_is_kept(
    width: int, height: int, long_side: int, tmp_path: Path
) -> None:
    save_jpeg(tmp_path / "any.jpg", scene(width=width, height=height))
    h, w, _ = decode_photo(tmp_path / "any.jpg", long_side).shape
    assert h % SIDE_MULTIPLE == w % SIDE_MULTIPLE == 0
    scale = long_side / max(width, height)
    for found, side in ((w, width * scale), (h, height * scale)):
        # 1e-9: 51 px at a scale of 248 / 51 are not quite 248.
        assert abs(found - side) <= max(SIDE_MULTIPLE / 2, SIDE_MULTIPLE - side) + 1e-9


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_turns_the_photo_upright(orientation: int, tmp_path: Path) -> None:
    save_jpeg(tmp_path / "turned.jpg", scene(), orientation=orientation)
    pixels = decode_photo(tmp_path / "turned.jpg", WIDTH)
    assert pixels.shape[:2] == ((HEIGHT, WIDTH) if orientation < 5 else (WIDTH, HEIGHT))
    halves = np.array_split(pixels.mean(2), 2)
    bright = [[part.mean() for part in np.array_split(half, 2, axis=1)] for half in halves]
    corner = np.unravel_index(np.argmax(bright), (2, 2))
    assert (
        corner == [(0, 0), (0, 1), (1, 1), (1, 0), (0, 0), (0, 1), (1, 1), (1, 0)][orientation - 1]
    )


def test_the_header_tells_size_and_lens(tmp_path: Path) -> None:
    save_jpeg(tmp_path / "dji.jpg", scene(), make="DJI", model="FC300S", focal=20)
    header = read_header(tmp_path / "dji.jpg")
    assert (header.width, header.height, header.lens) == (WIDTH, HEIGHT, ("DJI", "FC300S", 20.0))
    save_jpeg(tmp_path / "bare.jpg", scene(), make="DJI")
    assert read_header(tmp_path / "bare.jpg").lens is None


def test_the_fingerprint_follows_the_content_not_the_date(photo: Path) -> None:
    before = photo_fingerprint(photo)
    copy = photo.with_name("copy.jpg")
    shutil.copy(photo, copy)
    os.utime(copy, (1, 1))
    assert photo_fingerprint(copy) == before
    save_jpeg(photo, scene(seed=1))
    assert photo_fingerprint(photo) != before


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(size=st.integers(1, 400_000))
def test_the_fingerprint_sees_first_and_last_byte(size: int, tmp_path: Path) -> None:
    path = tmp_path / "any.bin"
    data = bytearray(size)
    prints = set()
    for at in (None, 0, size - 1):
        if at is not None:
            data[at] ^= 0xFF
        path.write_bytes(data)
        prints.add(photo_fingerprint(path))
    assert len(prints) == (3 if size > 1 else 2)


def test_photos_are_found_in_subfolders_and_other_files_passed_over(tmp_path: Path) -> None:
    for name in (
        "b.JPG",
        "a.jpg",
        "x/a.jpg",
        "x/y z/ü 漢.png",
        "raw.DNG",
        "._a.jpg",
        ".cache/t.jpg",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert find_photos(tmp_path) == ["a.jpg", "b.JPG", "x/a.jpg", "x/y z/ü 漢.png"]


def test_batches_hold_every_photo_once_and_list_the_bad(tmp_path: Path) -> None:
    names = []
    for i in range(11):
        wide = i % 3 != 0
        size = {"width": 96, "height": 64} if wide else {"width": 64, "height": 96}
        save_jpeg(tmp_path / f"{i}.jpg", scene(seed=i, **size))
        names.append(f"{i}.jpg")
    (tmp_path / "bad.jpg").write_bytes(b"")
    names.insert(5, "bad.jpg")
    batches = list(load_batches(tmp_path, names, 96, batch_size=3, workers=3))
    assert sorted(n for batch in batches for n in batch.names) == sorted(set(names) - {"bad.jpg"})
    assert [entry for batch in batches for entry in batch.bad] == [("bad.jpg", "is empty")]
    for batch in batches:
        assert len(batch.names) == len(batch.pixels) <= 3
        for name, pixels in zip(batch.names, batch.pixels, strict=True):
            expected = decode_photo(tmp_path / name, 96)
            assert np.array_equal(pixels.transpose(1, 2, 0), expected)
    again = list(load_batches(tmp_path, names, 96, batch_size=3, workers=1))
    assert [b.names for b in again] == [b.names for b in batches]


def test_bad_photos_alone_still_reach_the_caller(tmp_path: Path) -> None:
    (batch,) = load_batches(tmp_path, ["a.jpg", "b.jpg"], 96, batch_size=3)
    assert batch.names == () and len(batch.pixels) == 0
    assert batch.bad == [("a.jpg", "is missing"), ("b.jpg", "is missing")]


@pytest.mark.real
def test_real_photos_decode_whole(shared_data: Path) -> None:
    flights = [
        flight / "images" for flight in shared_data.iterdir() if (flight / "images").is_dir()
    ]
    assert flights
    for images in flights:
        name = find_photos(images)[0]
        assert max(decode_photo(images / name, 480).shape) == 480
        assert re.fullmatch("[0-9a-f]{64}", photo_fingerprint(images / name))


def test_masked_areas_become_neutral_and_photos_without_a_mask_are_taken_whole(
    tmp_path: Path,
) -> None:
    photo = np.zeros((64, 96, 3), np.uint8)
    photo[:, :48] = (10, 20, 30)
    photo[:, 48:] = np.random.default_rng(0).integers(0, 256, (64, 48, 3), dtype=np.uint8)
    for name in ("masked.png", "plain.png"):
        cv2.imwrite(str(tmp_path / name), photo)
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.full((64, 96), 255, np.uint8)
    mask[:, 48:] = 0
    cv2.imwrite(str(masks / "masked.png.png"), mask)

    (batch,) = load_batches(tmp_path, ["masked.png", "plain.png"], 96, 2, masks=masks)

    masked, plain = batch.pixels
    assert (masked[:, :, 48:] == np.array([30, 20, 10])[:, None, None]).all()
    assert plain[:, :, 48:].std() > 50
    assert (masked[:, :, :48] == plain[:, :, :48]).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_mask_lies_over_the_photo_as_it_is_stored(tmp_path: Path, orientation: int) -> None:
    """As COLMAP lays it, whatever way up the photo is."""
    stored = np.full((64, 96, 3), 120, np.uint8)
    stored[:32, :32] = (250, 250, 250)
    save_jpeg(tmp_path / "photo.jpg", stored, orientation=orientation)
    mask = np.full((64, 96), 255, np.uint8)
    mask[:32, :32] = 0
    cv2.imwrite(str(tmp_path / "photo.jpg.png"), mask)
    (batch,) = load_batches(tmp_path, ["photo.jpg"], 96, 1, masks=tmp_path)
    assert np.abs(batch.pixels.astype(int) - 120).mean() < 1


def test_a_broken_mask_is_a_reason_to_leave_the_photo_out(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((32, 32, 3), 9, np.uint8))
    (tmp_path / "a.png.png").write_bytes(b"no mask")
    (batch,) = load_batches(tmp_path, ["a.png"], 32, 2, masks=tmp_path)
    assert batch.names == ()
    assert "mask that is no picture" in batch.bad[0][1]
