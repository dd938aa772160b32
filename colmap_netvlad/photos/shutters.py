"""Rolling shutters: cameras that read a photo line by line while the drone flies on.

Each line of such a photo is taken from another place. COLMAP knows no such camera, so the surveyor
is told what it costs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np

from colmap_netvlad.photos.exif import DETAIL, FAULTS, exif_of
from colmap_netvlad.photos.files import BadPhoto, open_header, photo_path
from colmap_netvlad.photos.positions import read_gps
from colmap_netvlad.photos.xmp import properties

ROLLING: dict[str, tuple[str, float | None]] = {
    "FC300S": ("DJI Phantom 3 Advanced", 0.033),
    "FC300X": ("DJI Phantom 3 Professional", 0.033),
    "FC300C": ("DJI Phantom 3 Standard", 0.033),
    "FC330": ("DJI Phantom 4", 0.033),
    "FC350": ("DJI Inspire 1", 0.030),
    "FC220": ("DJI Mavic Pro", None),
    "FC2103": ("DJI Mavic Air", None),
    "L1D-20C": ("DJI Mavic 2 Pro", 0.056),
    "FC7203": ("DJI Mavic Mini", 0.020),
    "FC3170": ("DJI Mavic Air 2", 0.027),
    "FC3411": ("DJI Air 2S", 0.032),
    "FC3582": ("DJI Mini 3 Pro", 0.026),
    "L2D-20C": ("DJI Mavic 3", None),
}
"""EXIF model -> drone and seconds in which its largest ordinary photo is read out, where measured.

All have an electronic shutter alone, by DJI's specifications; the times are OpenDroneMap's
(`opendm/rollingshutter.py`, calibrated with https://github.com/OpenDroneMap/RSCalibration)."""

BOTH = {"FC6310": "DJI Phantom 4 Pro", "FC6310S": "DJI Phantom 4 Pro V2.0",
        "FC6310R": "DJI Phantom 4 RTK", "M3E": "DJI Mavic 3 Enterprise"}  # fmt: skip
"""EXIF model -> drone, of cameras with a mechanical shutter that can be switched to an electronic
one; XMP says which took a photo."""

ELECTRONIC = re.compile("electronic", re.I)
SHUTTER_TYPE = "drone-dji:ShutterType"
SPEEDS = ("drone-dji:FlightXSpeed", "drone-dji:FlightYSpeed", "drone-dji:FlightZSpeed")
"""DJI's speed north, east and down when the photo was taken, m/s."""

LARGE = 20e6
"""Pixels from which some of these cameras join several exposures, or read out more slowly."""

SAMPLED = 40
"""Photos of a camera, each with the next, that its speed is taken from."""

LONGEST_PAUSE = 10.0
"""Photos farther apart in time than this say nothing on the speed, s: a turn, or a new battery."""

EARTH = 6_371_000.0
"""Radius of the earth, m."""

TAKEN, FRACTION = 0x9003, 0x9291
"""EXIF's DateTimeOriginal and its fraction of a second."""


@dataclass(frozen=True)
class RollingShutter:
    """A rolling shutter, and how fast its drone flew.

    Attributes:
        camera: drone and EXIF model.
        readout: from the first line to the last, s; None where no measurement is known.
        speed: median over the photos, m/s; None where photos state neither speed nor GPS and time.
    """

    camera: str
    readout: float | None
    speed: float | None

    @property
    def shift(self) -> float | None:
        """How far the drone flies while one photo is read out, m."""
        return None if self.readout is None or self.speed is None else self.readout * self.speed

    def sentence(self, pixel: float | None = None) -> str:
        """Say what it costs.

        Args:
            pixel: ground sample distance, m.
        """
        said = f"{self.camera} has a rolling shutter"
        if self.readout is not None:
            said += f", which reads a photo line by line in {1000 * self.readout:.0f} ms"
        if self.shift is None:
            said += ": the faster the drone flies, the more its lines are apart"
        else:
            said += f": at {self.speed:.1f} m/s the drone flies {100 * self.shift:.0f} cm meanwhile"
            if pixel is not None and pixel > 0:
                said += f", {self.shift / pixel:.1f} pixels on the ground"
        return (
            f"{said}. COLMAP's cameras have no such shutter: poses and lens take up part of it, "
            "the rest is error. Fly slowly, or stop for each photo."
        )


def find_rolling_shutters(images: Path, names: Sequence[str]) -> list[RollingShutter]:
    """Return the rolling shutters among cameras, by name, from a sample of their photos.

    Args:
        images: photo folder.
        names: of photos, in the order in which they were taken.
    """
    first = set(_evenly(len(names)))
    cameras: dict[str, list[_Taken]] = {}
    readouts: dict[str, float | None] = {}
    for i in sorted(first | {i + 1 for i in first if i + 1 < len(names)}):
        taken = _read(images, names[i], i)
        if taken is not None:
            cameras.setdefault(taken.camera, []).append(taken)
            readouts[taken.camera] = taken.readout
    return [
        RollingShutter(camera, readouts[camera], _speed(photos))
        for camera, photos in sorted(cameras.items())
    ]


@dataclass(frozen=True)
class _Taken:
    """One photo of a rolling shutter. `speed` in m/s and `time` in s are None where not stated."""

    number: int
    camera: str
    readout: float | None
    speed: float | None
    time: float | None
    path: Path


def _evenly(count: int) -> Iterable[int]:
    return np.unique(np.linspace(0, count - 1, min(count, SAMPLED)).astype(int)).tolist()


def _read(images: Path, name: str, number: int) -> _Taken | None:
    """Return a photo of a rolling shutter; None where it is of another camera, or unreadable."""
    try:
        path = photo_path(images, name)
        with open_header(path) as photo:
            exif, xmp = exif_of(photo), properties(photo)
            model = str(exif.get(0x0110, "")).strip("\0 ")
            detail = exif.get_ifd(DETAIL)
            large = photo.width * photo.height > LARGE
    except (BadPhoto, *FAULTS):
        return None
    if model.upper() in ROLLING:
        drone, readout = ROLLING[model.upper()]
        readout = None if large else readout
    elif model.upper() in BOTH and ELECTRONIC.search(xmp.get(SHUTTER_TYPE, "")):
        drone, readout = f"{BOTH[model.upper()]} with its electronic shutter", None
    else:
        return None
    try:
        speed = math.hypot(*(float(xmp[key]) for key in SPEEDS))
    except (KeyError, ValueError):
        speed = None
    time = _time(detail.get(TAKEN), detail.get(FRACTION))
    return _Taken(number, f"{drone} ({model})", readout, speed, time, path)


def _time(taken: object, fraction: object) -> float | None:
    try:
        whole = datetime.strptime(str(taken).strip("\0 "), "%Y:%m:%d %H:%M:%S").timestamp()
    except (ValueError, OverflowError):
        return None
    digits = str(fraction or "").strip("\0 ")
    return whole + (float(f"0.{digits}") if digits.isdigit() else 0.0)


def _speed(photos: Sequence[_Taken]) -> float | None:
    """Return the median speed that photos state, else that between neighbours by GPS and time."""
    stated = [photo.speed for photo in photos if photo.speed is not None]
    if stated:
        return median(stated)
    between = []
    for one, other in pairwise(photos):
        if other.number != one.number + 1 or one.time is None or other.time is None:
            continue
        pause, here, there = other.time - one.time, read_gps(one.path), read_gps(other.path)
        if 0 < pause <= LONGEST_PAUSE and here is not None and there is not None:
            (north1, east1, _), (north2, east2, _) = here.position, there.position
            east = (east2 - east1 + 180) % 360 - 180
            step = math.hypot(north2 - north1, east * math.cos(math.radians(north1)))
            between.append(math.radians(step) * EARTH / pause)
    return median(between) if between else None
