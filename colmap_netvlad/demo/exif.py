"""The EXIF header a drone writes: camera, focal length, position."""

from __future__ import annotations

import struct
from dataclasses import dataclass

Entry = tuple[int, int, int, bytes]
"""Tag, type, count, value bytes."""

ASCII, SHORT, LONG, RATIONAL, BYTE = 2, 3, 4, 5, 1


@dataclass(frozen=True)
class Exif:
    """What goes into the header.

    Attributes:
        make, model: of the camera.
        focal_35mm: focal length as on 35 mm film, mm; COLMAP's prior is
            `focal_35mm / 43.27 * hypot(width, height)` px.
        latitude, longitude: WGS84, degrees, north and east positive.
        altitude: m above the ellipsoid.
        date: `YYYY:MM:DD HH:MM:SS`.
    """

    make: str
    model: str
    focal_35mm: int
    latitude: float
    longitude: float
    altitude: float
    date: str


def add_exif(jpeg: bytes, exif: Exif) -> bytes:
    """Return a JPEG with an EXIF segment (APP1) as the first one after its start marker."""
    body = b"Exif\0\0" + _tiff(exif)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def _tiff(exif: Exif) -> bytes:
    photo = [
        (0x9003, *_text(exif.date)),
        (0x920A, *_rational(exif.focal_35mm * 0.18)),
        (0xA405, SHORT, 1, struct.pack("<H", exif.focal_35mm)),
    ]
    gps = [
        (0x0000, BYTE, 4, bytes((2, 3, 0, 0))),
        (0x0001, *_text("N" if exif.latitude >= 0 else "S")),
        (0x0002, *_degrees(exif.latitude)),
        (0x0003, *_text("E" if exif.longitude >= 0 else "W")),
        (0x0004, *_degrees(exif.longitude)),
        (0x0005, BYTE, 1, bytes((int(exif.altitude < 0),))),
        (0x0006, *_rational(abs(exif.altitude))),
    ]
    start = 8
    main = [(0x010F, *_text(exif.make)), (0x0110, *_text(exif.model)), (0x0132, *_text(exif.date))]
    pointer = (LONG, 1, b"\0\0\0\0")
    length = len(_directory([*main, (0x8769, *pointer), (0x8825, *pointer)], start))
    photo_at = start + length
    photo_bytes = _directory(photo, photo_at)
    gps_at = photo_at + len(photo_bytes)
    pointers = [(0x8769, LONG, 1, struct.pack("<L", photo_at)),
                (0x8825, LONG, 1, struct.pack("<L", gps_at))]  # fmt: skip
    head = b"II*\0" + struct.pack("<L", start)
    return head + _directory(main + pointers, start) + photo_bytes + _directory(gps, gps_at)


def _directory(entries: list[Entry], at: int) -> bytes:
    """One image file directory; values over four bytes follow it."""
    heads, data = b"", b""
    data_at = at + 2 + 12 * len(entries) + 4
    for tag, kind, count, value in entries:
        if len(value) > 4:
            offset = struct.pack("<L", data_at + len(data))
            data += value + b"\0" * (len(value) % 2)
        else:
            offset = value.ljust(4, b"\0")
        heads += struct.pack("<HHL", tag, kind, count) + offset
    return struct.pack("<H", len(entries)) + heads + b"\0\0\0\0" + data


def _text(text: str) -> tuple[int, int, bytes]:
    value = text.encode("ascii") + b"\0"
    return ASCII, len(value), value


def _rational(value: float) -> tuple[int, int, bytes]:
    return RATIONAL, 1, struct.pack("<LL", round(value * 1000), 1000)


def _degrees(angle: float) -> tuple[int, int, bytes]:
    """Degrees, minutes, seconds; seconds to 1e-6, which is 0.03 mm on the ground."""
    micro = round(abs(angle) * 3600e6)
    degrees, rest = divmod(micro, 3600_000_000)
    minutes, seconds = divmod(rest, 60_000_000)
    return RATIONAL, 3, struct.pack("<LLLLLL", degrees, 1, minutes, 1, seconds, 1_000_000)
