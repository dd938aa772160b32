"""What drones write into a photo's XMP block: RTK's standard deviations, serial number, bands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from colmap_netvlad.photos.positions import GPS_IFD

_VALUE = re.compile(r'([\w-]+:\w+)\s*=\s*"([^"]*)"|<([\w-]+:\w+)>([^<]*)</')
"""A property is an attribute with some writers and an element with others."""

RTK_DEVIATIONS = ("drone-dji:RtkStdLon", "drone-dji:RtkStdLat", "drone-dji:RtkStdHgt")
"""DJI's standard deviations of an RTK position, m east, north, up."""

POSITIONING_ERROR = 31
"""EXIF's GPSHPositioningError, m."""


def read_xmp(photo: Path) -> dict[str, str]:
    """Return a photo's XMP properties by qualified name; empty where it has none or is broken."""
    try:
        with Image.open(photo) as image:
            block = image.info.get("xmp", b"")
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError):
        return {}
    text = block.decode("utf-8", "replace") if isinstance(block, bytes) else str(block)
    return {
        attribute or element: (value or content).strip()
        for attribute, value, element, content in _VALUE.findall(text)
    }


def read_deviations(photo: Path) -> tuple[float, float, float] | None:
    """Return the standard deviations of a photo's position, m east, north, up, as it states them.

    DJI's RTK tags come first; else EXIF's horizontal positioning error, its vertical one taken to
    be half as large again. None where the photo states neither.
    """
    xmp = read_xmp(photo)
    try:
        east, north, up = (float(xmp[name]) for name in RTK_DEVIATIONS)
        if min(east, north, up) > 0 and np.isfinite([east, north, up]).all():
            return east, north, up
    except (KeyError, ValueError):
        pass
    try:
        with Image.open(photo) as image:
            error = float(image.getexif().get_ifd(GPS_IFD)[POSITIONING_ERROR])
    except (OSError, UnidentifiedImageError, KeyError, ValueError, TypeError, ZeroDivisionError):
        return None
    return (error, error, 1.5 * error) if 0 < error < np.inf else None
