"""The focal length that EXIF states by the resolution of the focal plane."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_netvlad.photos.exif import DETAIL, FAULTS, exif_of
from colmap_netvlad.photos.files import open_header

FOCAL_LENGTH, PIXELS_ACROSS, PIXELS_DOWN = 0x920A, 0xA002, 0xA003
PLANE_RESOLUTION, PLANE_UNIT = 0xA20E, 0xA210
"""EXIF tags."""

SAME_SHAPE = 0.02
"""Photos whose ratios of sides are nearer than this have one shape: sides are whole."""

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
            detail, stored = exif_of(image).get_ifd(DETAIL), sorted(image.size)
        unit = UNITS[int(detail.get(PLANE_UNIT, 2))]
        taken = float(detail[FOCAL_LENGTH]) * float(detail[PLANE_RESOLUTION]) / unit
        sides = sorted((int(detail[PIXELS_ACROSS]), int(detail[PIXELS_DOWN])))
        shares = [side / of_taken for side, of_taken in zip(stored, sides, strict=True)]
    except FAULTS:
        return None
    # Sides that shrank unequally are those of a part of the photo, which has its focal length.
    made_smaller = shares[1] <= 1 and abs(shares[0] / shares[1] - 1) < SAME_SHAPE
    return PlaneFocal(taken, shares[1] * taken) if taken > 0 and made_smaller else None
