"""Coordinate frames: WGS84, a local east-north-up frame at a stated origin, UTM.

Models are kept in the local frame: true metres, z up, small numbers. Its axes are those of the
tangent plane at the origin, so that a place 1 km away lies 8 cm below the height it has over the
ellipsoid; every conversion here is exact, and takes account of it.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.enums import TransformDirection
from pyproj.exceptions import CRSError
from pyproj.transformer import TransformerGroup

from colmap_netvlad.photos.positions import middle_of
from colmap_netvlad.runtime.errors import InputError

NEIGHBOUR = 20.0
"""Degrees beyond a system's area of use in which it may still be used: Norway is mapped in one UTM
zone from west to east."""

ORIGIN_DECIMALS = 6
"""The origin is stated to this many decimals of a degree, about 0.1 m, and is exact as stated."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalFrame:
    """East, north, up in m at an origin.

    Attributes:
        latitude, longitude: of the origin, WGS84 degrees.
        height: of the origin, m, in the height system of the photos.
    """

    latitude: float
    longitude: float
    height: float = 0.0

    @property
    def epsg(self) -> int:
        """EPSG code of the UTM zone of the origin (of UPS beyond 84° N and 80° S).

        The whole flight keeps the origin's zone, also where it crosses a zone's border.
        """
        if self.latitude >= 84:
            return 32661
        if self.latitude < -80:
            return 32761
        zone = int((self.longitude + 180) // 6) % 60 + 1
        return (32600 if self.latitude >= 0 else 32700) + zone

    def from_wgs84(self, geographic: Array) -> Array:
        """Return (N, 3) m east, north, up of (N, 3) latitude, longitude (degrees), height (m)."""
        latitude, longitude, height = np.asarray(geographic, np.float64).reshape(-1, 3).T
        return np.column_stack(self._topocentric.transform(longitude, latitude, height))

    def to_wgs84(self, metres: Array) -> Array:
        """Return (N, 3) latitude, longitude (degrees), height (m) of (N, 3) m east, north, up."""
        east, north, up = np.asarray(metres, np.float64).reshape(-1, 3).T
        longitude, latitude, height = self._topocentric.transform(
            east, north, up, direction=TransformDirection.INVERSE
        )
        return np.column_stack([latitude, longitude, height])

    def to_crs(self, metres: Array, crs: CRS) -> Array:
        """Return (N, 3) easting, northing, height in a projected system of (N, 3) m of the frame.

        Heights are those of the photos, in the system's unit (`height_unit`); only the horizontal
        place is projected.
        """
        latitude, longitude, height = self.to_wgs84(metres).T
        to_crs = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
        easting, northing = to_crs.transform(longitude, latitude)
        return np.column_stack([easting, northing, height / height_unit(crs)[1]])

    def from_crs(self, places: Array, crs: CRS) -> Array:
        """Return (N, 3) m of the frame of (N, 3) x, y, height in any horizontal system.

        x is east or longitude, y north or latitude, whatever order the system's own axes have;
        heights are in the system's unit (`height_unit`).
        """
        x, y, height = np.asarray(places, np.float64).reshape(-1, 3).T
        to_wgs84 = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        longitude, latitude = to_wgs84.transform(x, y)
        return self.from_wgs84(np.column_stack([latitude, longitude, height * height_unit(crs)[1]]))

    @cached_property
    def _topocentric(self) -> Transformer:
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
            f"+lon_0={self.longitude!r} +lat_0={self.latitude!r} +h_0={self.height!r}"
        )


def frame_of(geographic: Array) -> LocalFrame:
    """Return the frame in the middle of a flight, its origin at height 0.

    Args:
        geographic: (N, 3) latitude, longitude (degrees), height; NaN where unknown, not for all.
    """
    middle = middle_of(geographic)
    assert middle is not None
    latitude, longitude = middle.tolist()
    return LocalFrame(round(latitude, ORIGIN_DECIMALS), round(longitude, ORIGIN_DECIMALS))


def height_unit(crs: CRS) -> tuple[str, float]:
    """Return the unit of heights in a system: its name, and how many m it is.

    It is that of the system's vertical axis, else of its horizontal ones, and m beside degrees.
    PROJ would leave the height of a system without a vertical axis as it is, in feet or in m.
    """
    axis = crs.axis_info[-1]
    if len(crs.axis_info) == 2 and crs.is_geographic:
        return "metre", 1.0
    return axis.unit_name, axis.unit_conversion_factor


def lacking_grids(crs: CRS, geographic: Array) -> list[str]:
    """Return a sentence where PROJ has not the grids of the best transformation to a system.

    It takes the best it has without a word, which is good to some m in many national systems.

    Args:
        geographic: (N, 3) latitude, longitude (degrees), height of places for which it counts.
    """
    latitude, longitude, _ = np.median(geographic, axis=0).tolist()
    if not np.isfinite([latitude, longitude]).all():
        return []
    near: Any = AreaOfInterest(longitude, latitude, longitude, latitude)  # not as stubs have it
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is said here
        group = TransformerGroup("EPSG:4326", crs.to_2d(), always_xy=True, area_of_interest=near)
    if group.best_available or not group.transformers:
        return []
    accuracy = group.transformers[0].accuracy
    good = f"good to {accuracy:g} m" if accuracy >= 0 else "of unknown accuracy"
    files = ", ".join(grid.short_name for grid in group.unavailable_operations[0].grids)
    return [
        f"The transformation between WGS84 and {crs.name} is {good}: PROJ lacks {files} for a "
        "better one (`pyproj sync` fetches its grids)."
    ]


def check_area(crs: CRS, geographic: Array) -> None:
    """Make sure that a system is one for where the flight is, or for a zone beside it.

    Args:
        geographic: (N, 3) latitude, longitude (degrees), height of places of the flight.

    Raises:
        InputError: it is far from the system's area of use; results would be plausible numbers.
    """
    area = crs.area_of_use
    if area is None:
        return
    latitude, longitude, _ = np.median(geographic, axis=0).tolist()
    wide = (area.east - area.west) % 360 or 360.0
    beyond = (longitude - area.west) % 360 - wide
    east_or_west = max(0.0, min(beyond, 360.0 - wide - beyond))
    if max(east_or_west, area.south - latitude, latitude - area.north) > NEIGHBOUR:
        raise InputError(
            f"{crs.name} is for another part of the world ({re.split('[:,]', area.name)[0]}): the "
            f"flight is at {latitude:.4f}, {longitude:.4f}; mend `crs`."
        )


def read_crs(text: str) -> CRS:
    """Return a coordinate system by EPSG code, PROJ string or WKT.

    Raises:
        InputError: none is known by that name.
    """
    name = text.strip()
    if name.upper().startswith("WGS84 UTM"):  # OpenDroneMap's way: WGS84 UTM 32N
        zone = name[9:].strip().upper()
        south = zone.endswith("S")
        digits = zone.rstrip("NS ")
        if digits.isdigit() and 1 <= int(digits) <= 60:
            return CRS.from_epsg((32700 if south else 32600) + int(digits))
    try:
        return CRS.from_user_input(int(name) if name.isdigit() else name)
    except CRSError as fault:
        raise InputError(
            f"The coordinate system {name!r} is not known; name one as EPSG:32632, as a PROJ "
            "string or as WGS84 UTM 32N."
        ) from fault
