"""The focal length that EXIF states by the resolution of the focal plane."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_netvlad.photos.exif import FAULTS, exif_of
from colmap_netvlad.photos.files import open_header

DETAIL, PIXELS_ACROSS, FOCAL_LENGTH = 0x8769, 0xA002, 0x920A
PLANE_RESOLUTION, PLANE_UNIT = 0xA20E, 0xA210
"""EXIF tags."""

UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""EXIF's number of a unit of resolution: mm."""


@dataclass(frozen=True)
class PlaneFocal:
    """A photo's focal length, px.

    Attributes:
        taken: of the photo as it was taken.
        stored: of the file, which may have been made smaller since.
    """

    taken: float
    stored: float


def plane_focal(photo: Path) -> PlaneFocal | None:
    """Return a photo's focal length by its focal plane, or None where EXIF does not state it."""
    try:
        with open_header(photo) as image:
            detail, across = exif_of(image).get_ifd(DETAIL), image.width
        unit = UNITS[int(detail.get(PLANE_UNIT, 2))]
        taken = float(detail[FOCAL_LENGTH]) * float(detail[PLANE_RESOLUTION]) / unit
        share = across / int(detail[PIXELS_ACROSS])
    except FAULTS:
        return None
    return PlaneFocal(taken, share * taken) if taken > 0 and 0 < share <= 1 else None
