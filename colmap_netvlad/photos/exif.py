"""EXIF of an open photo, without its pixels."""

from __future__ import annotations

import os
import struct
from typing import IO
from zlib import crc32

from PIL import Image
from PIL.PngImagePlugin import PngImageFile

TAIL_BYTES = 128 * 1024
"""EXIF behind a PNG's pixels begins within these: its chunk is 64 KiB at most in what writes it."""

DETAIL = 0x8769
"""The tag of EXIF's own directory."""

FAULTS = (KeyError, TypeError, ValueError, ArithmeticError, OSError, SyntaxError, struct.error)
"""What reading a tag raises where it is missing or broken, or the file cannot be opened: the pixels
may well be whole."""


def exif_of(photo: Image.Image) -> Image.Exif:
    """Return an open photo's EXIF; empty where it has none.

    Pillow alone decodes all of a PNG that has no EXIF before its pixels, to look behind them:
    half a second for 20 megapixels, each time.

    Raises:
        OSError, SyntaxError, ValueError: as Pillow, where it is broken.
    """
    if isinstance(photo, PngImageFile) and "exif" not in photo.info:
        behind = _behind_pixels(photo.fp) if photo.fp else None
        if behind is not None:
            photo.info["exif"] = b"Exif\0\0" + behind
        return Image.Image.getexif(photo)
    return photo.getexif()


def _behind_pixels(file: IO[bytes]) -> bytes | None:
    """Return what the chunk eXIf at the end of a PNG file holds."""
    at = file.tell()
    file.seek(max(file.seek(0, os.SEEK_END) - TAIL_BYTES, 0))
    tail = file.read()
    file.seek(at)
    start = tail.rfind(b"eXIf")
    length = int.from_bytes(tail[max(start - 4, 0) : max(start, 0)], "big")
    chunk, rest = tail[start : start + 4 + length], tail[start + 4 + length :]
    # Pixels may hold the same four letters, but not with the chunk's checksum.
    return chunk[4:] if start >= 4 and rest[:4] == crc32(chunk).to_bytes(4, "big") else None
