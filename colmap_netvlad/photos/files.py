"""Files of photos: which there are, whether they are whole, what tells them apart."""

from __future__ import annotations

import hashlib
import os
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import numpy as np
from PIL import Image, UnidentifiedImageError

from colmap_netvlad.photos.exif import DETAIL, FAULTS, exif_of
from colmap_netvlad.photos.xmp import properties

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
"""What counts as a photo in a folder; other files (raw, video, logs) are passed over."""


MIN_SIDE = 16
"""Photos with a shorter side than this hold nothing to describe, px."""

ORIENTATION, DATE_TIME_ORIGINAL, BODY_SERIAL_NUMBER = 0x0112, 0x9003, 0xA431
"""EXIF tags."""

XMP_SERIAL_NUMBERS = (
    "drone-dji:CameraSerialNumber",
    "exifEX:BodySerialNumber",
    "aux:SerialNumber",
    "drone-dji:DroneSerialNumber",
)
"""Where XMP tells one camera from another of the same model, best first."""

XMP_EXPOSURES = ("drone-dji:CaptureUUID", "MicaSense:CaptureId", "Camera:CaptureUUID")
"""Where XMP states the number that all bands of a shot have in common."""

XMP_BAND = "Camera:BandName"

FINGERPRINT_BLOCKS = 8
FINGERPRINT_BLOCK_BYTES = 16 * 1024

PNG_TAIL_BYTES = 4096
"""A PNG file's last chunk, IEND, lies within these."""

MOST_PIXELS = 2**30
"""Photos with more pixels than this cannot be decoded: it is OpenCV's limit."""

BOMB_PIXELS = 2**26
BOMB_RATIO = 1000
"""A photo of more pixels than `BOMB_PIXELS`, 200 MB decoded, has a byte for `BOMB_RATIO` of them at
least: no codec says less of what is a photo."""

_OPENING = threading.Lock()


class BadPhoto(Exception):
    """A photo that cannot be used. Its text is the reason, fit for a list shown to the user."""


@dataclass(frozen=True)
class PhotoHeader:
    """What a photo's header says, without decoding its pixels.

    Attributes:
        width, height: pixels as stored, before any EXIF rotation (COLMAP's camera size).
        lens: EXIF make, model and focal length, which tell cameras apart; None where EXIF
            lacks one of them.
        serial: number of the camera or, where that is not told, of the drone: EXIF's
            BodySerialNumber, else XMP.
        day: when the photo was taken, `YYYY:MM:DD` of EXIF.
        exposure: number of the shot that a multispectral camera's bands have in common, of XMP.
        band: which band of it the photo is, of XMP.
        orientation: how the stored pixels are to be turned, 1..8 as in EXIF; 1: not at all.
    """

    width: int
    height: int
    lens: tuple[str, str, float] | None
    serial: str | None = None
    day: str | None = None
    exposure: str | None = None
    band: str | None = None
    orientation: int = 1


def find_photos(folder: Path) -> list[str]:
    """Return the sorted names, relative with '/', of the photos in a folder and its subfolders.

    Hidden files and folders (macOS leaves `._DJI_0001.JPG` on memory cards) are passed over, and so
    are links to a folder that is in there already, or above.
    """
    root = folder.resolve()
    names, walked = [], {root}

    def enter(path: Path) -> bool:
        """Whether to look into a folder: a link back into the photos would find them twice."""
        real = path.resolve()
        if path.is_symlink() and (real.is_relative_to(root) or root.is_relative_to(real)):
            return False
        if real in walked:
            return False
        walked.add(real)
        return True

    for parent, folders, files in os.walk(folder, followlinks=True):
        here = Path(parent)
        folders[:] = [n for n in sorted(folders) if not n.startswith(".") and enter(here / n)]
        for name in files:
            if not name.startswith(".") and Path(name).suffix.lower() in PHOTO_SUFFIXES:
                names.append((here / name).relative_to(folder).as_posix())
    return sorted(names)


def leaves_folder(name: str) -> bool:
    """Whether an image name is none: empty, absolute, with `..` or NUL, it would lead out of the
    photo folder."""
    parts = PurePosixPath(name).parts
    return (
        not parts
        or ".." in parts
        or "\0" in name
        or PurePosixPath(name).is_absolute()
        or (os.name == "nt" and (".." in Path(name).parts or bool(Path(name).anchor)))
    )


def photo_path(folder: Path, name: str) -> Path:
    """Return where the photo of an image name lies, below `folder` for any name.

    Raises:
        BadPhoto: the name leads out of the folder.
    """
    if leaves_folder(name):
        raise BadPhoto("has a name that leads out of the photo folder")
    return folder / name


def file_stamp(path: Path) -> str:
    """Return size and time of a file: while they stay the same, so does what is in it.

    Raises:
        BadPhoto: the file is not there or cannot be read.
    """
    try:
        status = path.stat()
    except OSError as fault:
        raise BadPhoto(_file_fault(fault)) from fault
    return f"{status.st_size} {status.st_mtime_ns}"


def photo_fingerprint(path: Path) -> str:
    """Return a fingerprint of a photo's content: its size and evenly spaced blocks, hashed.

    It reads at most 128 KiB, first and last block included. The date plays no part: a copied
    photo keeps its fingerprint, a changed one does not.

    Raises:
        BadPhoto: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            digest = hashlib.sha256(str(size).encode())
            last = max(size - FINGERPRINT_BLOCK_BYTES, 0)
            for offset in np.unique(np.linspace(0, last, FINGERPRINT_BLOCKS).astype(np.int64)):
                file.seek(int(offset))
                digest.update(file.read(FINGERPRINT_BLOCK_BYTES))
    except OSError as fault:
        raise BadPhoto(_file_fault(fault)) from fault
    return digest.hexdigest()


def read_header(path: Path) -> PhotoHeader:
    """Check cheaply that a photo is whole, and return what its header says.

    Found: missing, empty and unreadable files, files that are no photo, photos too small, and
    JPEG and PNG files that end early (their last marker is missing). Not found: damage inside
    a file that has its proper end; COLMAP reads such photos, too. Head and tail are read; a JPEG
    file with something behind its end marker is read whole.

    Raises:
        BadPhoto: one of these.
    """
    try:
        with path.open("rb") as file:
            return parse_header(file)
    except OSError as fault:
        raise BadPhoto(_file_fault(fault)) from fault


def read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as fault:
        raise BadPhoto(_file_fault(fault)) from fault


def _file_fault(fault: OSError) -> str:
    if isinstance(fault, FileNotFoundError):
        return "is missing"
    return f"cannot be read ({fault.strerror or fault})"


def parse_header(file: BinaryIO) -> PhotoHeader:
    """Check an open photo as `read_header` does.

    Raises:
        BadPhoto: it cannot be used.
        OSError: it cannot be read.
    """
    start = file.read(4)
    if not start:
        raise BadPhoto("is empty")
    try:
        with open_header(file) as photo:
            xmp = properties(photo)
            header = PhotoHeader(
                photo.width,
                photo.height,
                _lens(photo),
                _serial(photo, xmp),
                _day(photo),
                next((xmp[key] for key in XMP_EXPOSURES if xmp.get(key)), None),
                xmp.get(XMP_BAND) or None,
                _orientation(photo),
            )
    except UnidentifiedImageError as fault:
        raise BadPhoto("is not a photo") from fault
    except (OSError, SyntaxError, ValueError) as fault:
        raise BadPhoto(f"has a damaged header ({fault})") from fault
    if is_jpeg(start) and not _jpeg_is_whole(file):
        raise BadPhoto("is truncated (the JPEG data end early)")
    if start == b"\x89PNG" and b"IEND" not in _tail(file, PNG_TAIL_BYTES):
        raise BadPhoto("is truncated (the PNG data end early)")
    if header.width * header.height > MOST_PIXELS:
        raise BadPhoto(f"has {header.width} x {header.height} pixels, more than can be decoded")
    pixels = header.width * header.height
    if pixels > max(BOMB_PIXELS, BOMB_RATIO * file.seek(0, os.SEEK_END)):
        raise BadPhoto(f"says {header.width} x {header.height} pixels, but is too small a file")
    if min(header.width, header.height) < MIN_SIDE:
        raise BadPhoto(f"is only {header.width} x {header.height} pixels")
    return header


def _tail(file: BinaryIO, count: int) -> bytes:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - count, 0))
    return file.read(count)


@contextmanager
def open_header(source: Path | BinaryIO) -> Iterator[Image.Image]:
    """Open a photo with Pillow to read its header and EXIF; its pixels are not decoded.

    Aerial mosaics exceed Pillow's guard against decompression bombs, which is a setting of the
    whole process: it is lifted while the block runs, one block at a time, and no longer.

    Raises:
        OSError, SyntaxError, ValueError: as Pillow; `UnidentifiedImageError` where it is no photo.
    """
    with _OPENING, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Corrupt EXIF data", UserWarning)
        guard, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            with Image.open(source) as photo:
                yield photo
        finally:
            Image.MAX_IMAGE_PIXELS = guard


def is_jpeg(data: bytes) -> bool:
    return data.startswith(b"\xff\xd8")


def _jpeg_is_whole(file: BinaryIO) -> bool:
    """Whether the picture's end marker follows its scan; an embedded thumbnail's does not count.

    Decoders fill the missing part of a truncated picture with grey, mostly silently.
    """
    if _tail(file, 2) == b"\xff\xd9":
        return True
    file.seek(0)
    data, at = file.read(), 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xDA:
            # Inside a scan a byte 0xFF is never followed by 0xD9, so the first is the end.
            return data.find(b"\xff\xd9", at) >= 0
        if data[at + 1] == 0xFF:
            at += 1
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _serial(photo: Image.Image, xmp: Mapping[str, str]) -> str | None:
    said = _detail(photo, BODY_SERIAL_NUMBER)
    return next((one for one in (said, *map(xmp.get, XMP_SERIAL_NUMBERS)) if one), None)


def _day(photo: Image.Image) -> str | None:
    taken = _detail(photo, DATE_TIME_ORIGINAL)
    return taken[:10] if taken else None


def _orientation(photo: Image.Image) -> int:
    try:
        said = int(exif_of(photo).get(ORIENTATION, 1))
    except FAULTS:
        return 1
    return said if 1 <= said <= 8 else 1


def _detail(photo: Image.Image, tag: int) -> str | None:
    """Return a text of EXIF's own directory, or None where it is missing or broken."""
    try:
        value = exif_of(photo).get_ifd(DETAIL).get(tag)
    except FAULTS:
        return None
    return str(value).strip("\0 ") if value is not None else None


def _lens(photo: Image.Image) -> tuple[str, str, float] | None:
    try:
        exif = exif_of(photo)
        detail = exif.get_ifd(DETAIL)
        make, model = str(exif[0x010F]).strip("\0 "), str(exif[0x0110]).strip("\0 ")
        # As COLMAP: the focal length in 35 mm film where given, else the real one.
        focal = float(detail[0xA405] if 0xA405 in detail else detail[0x920A])
    except FAULTS:
        return None
    return (make, model, focal) if make and model else None
