"""Mosaics are read, and Pillow's guard against decompression bombs stays where it was."""

from __future__ import annotations

import struct
import subprocess
import sys
import warnings
import zlib
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path

import pytest
from PIL import Image

from colmap_netvlad.photos.files import BOMB_RATIO, BadPhoto, open_header, parse_header
from colmap_netvlad.photos.positions import read_gps


def png(width: int, height: int) -> bytes:
    """A PNG file of any size that has a header, and as many bytes as pixels need at the least."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = bytes(width * height // BOMB_RATIO)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


def test_a_mosaic_of_a_thousand_megapixels_is_read_without_a_warning(tmp_path: Path) -> None:
    mosaic = png(2**15, 2**15)
    (tmp_path / "mosaic.png").write_bytes(mosaic)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        header = parse_header(BytesIO(mosaic))
        assert read_gps(tmp_path / "mosaic.png") is None
    assert (header.width, header.height) == (2**15, 2**15)


def test_a_larger_photo_is_refused() -> None:
    with pytest.raises(BadPhoto, match="has 32768 x 32769 pixels, more than can be decoded"):
        parse_header(BytesIO(png(2**15, 2**15 + 1)))


def test_the_guard_of_the_process_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    filters = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(parse_header, [BytesIO(png(20_000, 20_000)) for _ in range(64)]))
    with pytest.raises(BadPhoto):
        parse_header(BytesIO(b"\x89PNG no photo"))
    with pytest.raises(RuntimeError), open_header(_write(tmp_path, png(64, 64))):
        raise RuntimeError
    assert Image.MAX_IMAGE_PIXELS == 1000
    assert list(warnings.filters) == filters
    with pytest.raises(Image.DecompressionBombError):
        Image.open(_write(tmp_path, png(64, 64)))


def _write(folder: Path, data: bytes) -> Path:
    path = folder / "photo.png"
    path.write_bytes(data)
    return path


def test_importing_changes_nothing() -> None:
    code = (
        "import numpy, warnings; from PIL import Image; before = Image.MAX_IMAGE_PIXELS;"
        "filters = len(warnings.filters); import colmap_netvlad.photos.files;"
        "print(before is not None and Image.MAX_IMAGE_PIXELS == before,"
        " len(warnings.filters) == filters)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]
