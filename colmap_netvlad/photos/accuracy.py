"""How good a photo's position is, as the drone states it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_netvlad.photos.exif import FAULTS, exif_of
from colmap_netvlad.photos.files import open_header
from colmap_netvlad.photos.positions import GPS_IFD
from colmap_netvlad.photos.xmp import properties

RTK_DEVIATIONS = ("drone-dji:RtkStdLon", "drone-dji:RtkStdLat", "drone-dji:RtkStdHgt")
"""DJI's standard deviations of an RTK position, m east, north, up."""

POSITIONING_ERROR = 31
"""EXIF's GPSHPositioningError, m."""


def read_deviations(photo: Path) -> tuple[float, float, float] | None:
    """Return the standard deviations of a photo's position, m east, north, up, as it states them.

    DJI's RTK tags come first; else EXIF's horizontal positioning error, its vertical one taken to
    be half as large again. None where the photo states neither, or cannot be read.
    """
    try:
        with open_header(photo) as image:
            xmp = properties(image)
            gps = exif_of(image).get_ifd(GPS_IFD)
    except FAULTS:
        return None
    try:
        east, north, up = (float(xmp[name]) for name in RTK_DEVIATIONS)
        if min(east, north, up) > 0 and np.isfinite([east, north, up]).all():
            return east, north, up
    except (KeyError, ValueError):
        pass
    try:
        error = float(gps[POSITIONING_ERROR])
    except (KeyError, ValueError, TypeError, ZeroDivisionError):
        return None
    return (error, error, 1.5 * error) if 0 < error < np.inf else None
