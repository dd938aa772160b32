"""Where the photos were taken: position priors of the database, else GPS in the photos.

GPS is a hint, never a must: a photo without it, or with a position that cannot be right, is
ranked by appearance alone and disables nothing for the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.photos.bands import named_band
from colmap_netvlad.photos.exif import FAULTS, exif_of
from colmap_netvlad.photos.files import open_header

if TYPE_CHECKING:
    import pycolmap

FAR_AWAY = 50_000.0
"""A photo farther than this from the middle of all others is not of this flight, m."""

GPS_IFD = 0x8825
"""The EXIF tag that points to the GPS block."""


class CoordinateSystem(IntEnum):
    """`pose_priors.coordinate_system`."""

    UNDEFINED = -1
    WGS84 = 0
    CARTESIAN = 1


@dataclass(frozen=True)
class PosePrior:
    """A position prior: (lat deg, lon deg, alt m) for WGS84, (x, y, z) for cartesian."""

    position: tuple[float, float, float]
    coordinate_system: CoordinateSystem


@dataclass(frozen=True, eq=False)
class Positions:
    """Where the photos of a project were taken.

    Attributes:
        metres: (N, 3) east, north, up (or the cartesian priors), in the order of the images;
            NaN where nothing is known or what is known cannot be right.
        notes: sentences on what was found and what was put aside, for the report.
        geographic: (N, 3) WGS84 latitude, longitude (degrees) and height (m), NaN where unknown;
            None where the priors are cartesian. The height alone may be unknown.
    """

    metres: NDArray[np.float64]
    notes: tuple[str, ...]
    geographic: NDArray[np.float64] | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,) whether a photo's position is known."""
        return np.isfinite(self.metres[:, 0]) & np.isfinite(self.metres[:, 1])

    @property
    def useful(self) -> bool:
        """Whether positions tell photos apart: at least two known ones that differ."""
        known = self.metres[self.known]
        return len(known) > 1 and bool(np.ptp(known[:, :2], axis=0).max() > 0)


def place(found: Sequence[PosePrior | None], names: Sequence[str]) -> Positions:
    """Turn priors into metres, and put aside those that cannot be right.

    Put aside are: latitude and longitude both zero, outside the globe, or more than `FAR_AWAY`
    from the median of the others. Swapped latitude and longitude are recognised where swapping
    brings a photo back to the others, and mended. Photos at exactly one place are named and stay.
    """
    system = _common_system(found)
    raw = np.array(
        [
            prior.position
            if prior is not None and _same_kind(prior.coordinate_system, system)
            else (np.nan,) * 3
            for prior in found
        ],
        dtype=np.float64,
    ).reshape(-1, 3)
    notes: list[str] = []
    geographic = None
    if system is CoordinateSystem.CARTESIAN:
        metres = raw
    else:
        geographic, notes = _mend_wgs84(raw, names)
        metres = _local_metres(geographic)
    positions = Positions(metres, tuple(notes), geographic)
    if positions.known.any() and not positions.useful:
        notes.append("All known positions are equal, so they say nothing; they are not used.")
        nowhere = np.full_like(metres, np.nan)
        return Positions(nowhere, tuple(notes), None if geographic is None else nowhere)
    repeated = _repeated(metres, names)
    if repeated.any():
        what = "had exactly the position of one before, as where GPS stands still; used even so"
        return Positions(metres, (*notes, _sentence(repeated, names, what)), geographic)
    return positions


def _repeated(metres: NDArray[np.float64], names: Sequence[str]) -> NDArray[np.bool_]:
    """Return which photos have the place of an earlier one that is not a band of the same shot."""
    first: dict[tuple[float, ...], str] = {}
    repeated = np.zeros(len(names), bool)
    for i, (place, name) in enumerate(zip(metres[:, :2].tolist(), names, strict=True)):
        shot = (named_band(name) or (name,))[0]
        repeated[i] = first.setdefault(tuple(place), shot) != shot and np.isfinite(place).all()
    return repeated


def read_gps(photo: Path) -> PosePrior | None:
    """Return a photo's EXIF GPS as a WGS84 prior, or None where it has none that is readable.

    The height is NaN where the photo has latitude and longitude alone.
    """
    try:
        with open_header(photo) as image:
            gps = exif_of(image).get_ifd(GPS_IFD)
        latitude = _degrees(gps[2], gps.get(1, "N"))
        longitude = _degrees(gps[4], gps.get(3, "E"))
        altitude = _altitude(gps)
    except FAULTS:
        return None
    if not np.isfinite([latitude, longitude]).all():
        return None
    return PosePrior((latitude, longitude, altitude), CoordinateSystem.WGS84)


def _degrees(parts: Sequence[float], hemisphere: str) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    value = degrees + minutes / 60 + seconds / 3600
    return -value if str(hemisphere).strip().upper() in ("S", "W") else value


def _altitude(gps: Mapping[int, object]) -> float:
    try:
        altitude = float(gps[6])  # type: ignore[arg-type]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return float("nan")
    below_sea = gps.get(5) in (1, b"\x01")
    return -altitude if below_sea else altitude


def _common_system(found: Sequence[PosePrior | None]) -> CoordinateSystem:
    cartesian = sum(
        prior is not None and prior.coordinate_system is CoordinateSystem.CARTESIAN
        for prior in found
    )
    others = sum(prior is not None for prior in found) - cartesian
    return CoordinateSystem.CARTESIAN if cartesian > others else CoordinateSystem.WGS84


def _same_kind(system: CoordinateSystem, common: CoordinateSystem) -> bool:
    # COLMAP writes WGS84 without saying so in some versions: "undefined" is read as WGS84.
    return (system is CoordinateSystem.CARTESIAN) == (common is CoordinateSystem.CARTESIAN)


def _mend_wgs84(
    raw: NDArray[np.float64], names: Sequence[str]
) -> tuple[NDArray[np.float64], list[str]]:
    raw = raw.copy()
    notes: list[str] = []
    zero = (raw[:, 0] == 0) & (raw[:, 1] == 0)
    _put_aside(raw, zero, names, "have GPS at latitude and longitude zero", notes)
    middle = middle_of(raw)
    if middle is None:
        return raw, notes
    away = _metres_between(raw, middle) > FAR_AWAY
    swapped = raw[:, [1, 0, 2]]
    mended = away & (_metres_between(swapped, middle) <= FAR_AWAY)
    if mended.any():
        raw[mended] = swapped[mended]
        notes.append(_sentence(mended, names, "had latitude and longitude swapped; put right"))
    _put_aside(raw, away & ~mended, names, "have GPS far from all others or off the globe", notes)
    return raw, notes


def _put_aside(
    raw: NDArray[np.float64],
    wrong: NDArray[np.bool_],
    names: Sequence[str],
    what: str,
    notes: list[str],
) -> None:
    if wrong.any():
        raw[wrong] = np.nan
        notes.append(_sentence(wrong, names, f"{what}; not used"))


def _sentence(which: NDArray[np.bool_], names: Sequence[str], what: str) -> str:
    count = int(which.sum())
    first = names[int(np.flatnonzero(which)[0])]
    return f"{count} photo{'s' if count > 1 else ''} (first: {first}) {what}."


def middle_of(geographic: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the median latitude and longitude of those on the globe, or None without any.

    Longitudes are taken around their mean direction, since they jump by 360 at the antimeridian.

    Args:
        geographic: (N, 2 or 3) latitude, longitude in degrees; NaN where unknown.
    """
    latitude, longitude = geographic[~_off_globe(geographic), :2].T
    if not len(latitude):
        return None
    angle = np.radians(longitude)
    mean = float(np.degrees(np.arctan2(np.sin(angle).sum(), np.cos(angle).sum())))
    east = float(np.median(_around(longitude, mean)))
    return np.array([np.median(latitude), (east + 180) % 360 - 180])


def _off_globe(raw: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether latitude or longitude cannot be, or are not known."""
    return ~((np.abs(raw[:, 0]) <= 90) & (np.abs(raw[:, 1]) <= 180))


def _around(longitude: NDArray[np.float64], middle: float) -> NDArray[np.float64]:
    """Return longitudes within 180 degrees of the middle, by whole turns."""
    return longitude + 360 * np.round((middle - longitude) / 360)


def _metres_between(raw: NDArray[np.float64], middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) distances from the middle in m, straight through the earth and heights aside;
    infinite off the globe, NaN where unknown."""
    ground = np.vstack([raw[:, :2], middle])
    on_earth = _earth().ellipsoid_to_ecef(np.column_stack([ground, np.zeros(len(ground))]))
    distance = np.linalg.norm(on_earth[:-1] - on_earth[-1], axis=1)
    result: NDArray[np.float64] = np.where(_off_globe(raw) & ~np.isnan(distance), np.inf, distance)
    return result


def _local_metres(raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3) east, north, up in m on the plane that touches the ellipsoid in the middle.

    An unknown height counts as 0.
    """
    middle = middle_of(raw)
    if middle is None:
        return np.full_like(raw, np.nan)
    filled = np.column_stack([raw[:, :2], np.nan_to_num(raw[:, 2])])
    metres: NDArray[np.float64] = _earth().ellipsoid_to_enu(filled, middle[0], middle[1], 0.0)
    return metres


def _earth() -> pycolmap.GPSTransform:
    import pycolmap  # takes seconds, and most photos' headers are read without it

    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
