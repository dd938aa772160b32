"""Photos -> pixels: fast reduced-scale decoding, EXIF orientation, batches of equal size.

Nothing here knows about networks: pixels leave as 8-bit RGB, and a model normalises them itself.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import warnings
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from colmap_netvlad.machine import usable_processors

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
"""What counts as a photo in a folder; other files (raw, video, logs) are passed over."""

SIDE_MULTIPLE = 16
"""Both sides of a decoded photo are multiples of this, the stride of VGG-16 up to conv5_3."""

MIN_SIDE = 16
"""Photos with a shorter side than this hold nothing to describe, px."""

FINGERPRINT_BLOCKS = 8
FINGERPRINT_BLOCK_BYTES = 16 * 1024

# Aerial mosaics exceed Pillow's guard against decompression bombs. Pillow only reads headers
# here; OpenCV, which decodes, has its own limit of 2^30 pixels.
Image.MAX_IMAGE_PIXELS = None
warnings.filterwarnings("ignore", "Corrupt EXIF data", UserWarning)


class BadPhoto(Exception):
    """A photo that cannot be used. Its text is the reason, fit for a list shown to the user."""


@dataclass(frozen=True)
class PhotoHeader:
    """What a photo's header says, without decoding its pixels.

    Attributes:
        width, height: pixels as stored, before any EXIF rotation (COLMAP's camera size).
        lens: EXIF make, model and focal length, which tell cameras apart; None where EXIF
            lacks one of them.
    """

    width: int
    height: int
    lens: tuple[str, str, float] | None


@dataclass(frozen=True, eq=False)
class PhotoBatch:
    """Photos of equal size, decoded.

    Attributes:
        names: B image names.
        pixels: (B, 3, H, W) uint8 RGB, H and W multiples of `SIDE_MULTIPLE`.
        bad: (name, reason) of the photos found unusable since the batch before.
    """

    names: tuple[str, ...]
    pixels: NDArray[np.uint8]
    bad: list[tuple[str, str]] = field(default_factory=list)


def find_photos(folder: Path) -> list[str]:
    """Return the sorted names, relative with '/', of the photos in a folder and its subfolders.

    Hidden files and folders (macOS leaves `._DJI_0001.JPG` on memory cards) are passed over.
    """
    names = []
    for parent, folders, files in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            if not name.startswith(".") and Path(name).suffix.lower() in PHOTO_SUFFIXES:
                names.append(Path(parent, name).relative_to(folder).as_posix())
    return sorted(names)


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
    a file that has its proper end; COLMAP reads such photos, too.

    Raises:
        BadPhoto: one of these.
    """
    return _parse_header(_read(path))


def decode_photo(path: Path, long_side: int) -> NDArray[np.uint8]:
    """Decode a photo at reduced scale, turned upright by its EXIF orientation.

    JPEG is decoded at 1/2, 1/4 or 1/8 (libjpeg's scaled transform) as long as that is at least
    the size asked for, then reduced by area averaging; smaller photos are enlarged. 16-bit,
    grey, CMYK and transparent photos become 8-bit RGB as in COLMAP.

    Args:
        path: the photo.
        long_side: longer side of the result, px; rounded to a multiple of `SIDE_MULTIPLE`,
            as is the shorter side (the aspect ratio changes by at most half of that).

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        BadPhoto: missing, unreadable, truncated, not a photo, or too small.
    """
    data = _read(path)
    header = _parse_header(data)
    flags = _reduction(max(header.width, header.height) / long_side) if _is_jpeg(data) else None
    try:
        pixels = cv2.imdecode(
            np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR if flags is None else flags
        )
    except cv2.error as fault:
        raise BadPhoto(f"cannot be decoded ({fault.err})") from fault
    if pixels is None:
        raise BadPhoto("cannot be decoded (damaged, or a kind of file OpenCV does not read)")
    height, width = pixels.shape[:2]
    # The header's aspect ratio: sides of a photo decoded at a fraction of its size are rounded up.
    ratio = min(header.width, header.height) / max(header.width, header.height)
    longer, shorter = _rounded(long_side), _rounded(long_side * ratio)
    size = (longer, shorter) if width >= height else (shorter, longer)
    smooth = cv2.INTER_AREA if long_side < max(height, width) else cv2.INTER_LINEAR
    resized = cv2.resize(pixels, size, interpolation=smooth)
    return np.asarray(cv2.cvtColor(resized, cv2.COLOR_BGR2RGB), np.uint8)


def find_mask(masks: Path, name: str) -> Path | None:
    """Return the mask of a photo in COLMAP's way, `<name>.png` or its stem's, or None."""
    candidates = (masks / f"{name}.png", (masks / name).with_suffix(".png"))
    return next((mask for mask in candidates if mask.is_file()), None)


def neutralise(pixels: NDArray[np.uint8], mask: Path) -> NDArray[np.uint8]:
    """Return the photo with its masked area (black in the mask) in the mean colour of the rest.

    An even area has no texture for a network to describe. A mask that covers everything leaves
    an even grey photo.

    Args:
        pixels: (H, W, 3) uint8.
        mask: a picture of any size that is stretched over the photo.

    Raises:
        BadPhoto: the mask cannot be read.
    """
    shape = cv2.imdecode(np.frombuffer(_read(mask), np.uint8), cv2.IMREAD_GRAYSCALE)
    if shape is None:
        raise BadPhoto(f"has a mask that is no picture ({mask})")
    size = (pixels.shape[1], pixels.shape[0])
    seen = cv2.resize(shape, size, interpolation=cv2.INTER_NEAREST) > 0
    fill = pixels[seen].mean(axis=0) if seen.any() else 128.0
    return np.where(seen[:, :, None], pixels, np.round(fill)).astype(np.uint8)


def load_batches(
    folder: Path,
    names: Iterable[str],
    long_side: int,
    batch_size: int,
    workers: int | None = None,
    masks: Path | None = None,
) -> Iterator[PhotoBatch]:
    """Decode photos in threads while the caller works on the batches already decoded.

    Photos of equal size share a batch. The order of batches depends on the photos alone. One
    bad photo stops nothing: it is listed in the next batch's `bad`; the last batch may hold no
    photo, only bad ones.

    Args:
        folder: what `names` are relative to.
        names: image names.
        long_side: as in `decode_photo`.
        batch_size: photos of a full batch.
        workers: decoding threads; default: one for each processor.
        masks: folder of masks; masked areas become neutral. Photos without one are taken whole.
    """

    def decode(name: str) -> NDArray[np.uint8]:
        pixels = decode_photo(folder / name, long_side)
        mask = find_mask(masks, name) if masks is not None else None
        return pixels if mask is None else neutralise(pixels, mask)

    workers = workers or usable_processors()
    waiting: dict[tuple[int, ...], list[tuple[str, NDArray[np.uint8]]]] = defaultdict(list)
    bad: list[tuple[str, str]] = []
    queue: deque[tuple[str, Future[NDArray[np.uint8]]]] = deque()
    todo = iter(names)
    pool = ThreadPoolExecutor(workers, thread_name_prefix="decode")
    try:
        while True:
            # Twice a batch is decoded ahead: one being built while one is being described.
            while len(queue) < 2 * batch_size + workers:
                name = next(todo, None)
                if name is None:
                    break
                queue.append((name, pool.submit(decode, name)))
            if not queue:
                break
            name, future = queue.popleft()
            try:
                pixels = future.result()
            except BadPhoto as fault:
                bad.append((name, str(fault)))
                continue
            group = waiting[pixels.shape]
            group.append((name, pixels))
            if len(group) == batch_size:
                yield _batch(waiting.pop(pixels.shape), bad)
                bad = []
        for group in waiting.values():
            yield _batch(group, bad)
            bad = []
        if bad:
            yield PhotoBatch((), np.zeros((0, 3, 0, 0), np.uint8), bad)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _batch(group: list[tuple[str, NDArray[np.uint8]]], bad: list[tuple[str, str]]) -> PhotoBatch:
    pixels = np.stack([photo for _, photo in group]).transpose(0, 3, 1, 2)
    return PhotoBatch(tuple(name for name, _ in group), np.ascontiguousarray(pixels), bad)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as fault:
        raise BadPhoto(_file_fault(fault)) from fault


def _file_fault(fault: OSError) -> str:
    if isinstance(fault, FileNotFoundError):
        return "is missing"
    return f"cannot be read ({fault.strerror or fault})"


def _parse_header(data: bytes) -> PhotoHeader:
    if not data:
        raise BadPhoto("is empty")
    try:
        with Image.open(io.BytesIO(data)) as photo:
            header = PhotoHeader(photo.width, photo.height, _lens(photo))
    except UnidentifiedImageError as fault:
        raise BadPhoto("is not a photo") from fault
    except (OSError, SyntaxError, ValueError) as fault:
        raise BadPhoto(f"has a damaged header ({fault})") from fault
    if _is_jpeg(data) and not _jpeg_is_whole(data):
        raise BadPhoto("is truncated (the JPEG data end early)")
    if data.startswith(b"\x89PNG") and data.rfind(b"IEND", -4096) < 0:
        raise BadPhoto("is truncated (the PNG data end early)")
    if min(header.width, header.height) < MIN_SIDE:
        raise BadPhoto(f"is only {header.width} x {header.height} pixels")
    return header


def _is_jpeg(data: bytes) -> bool:
    return data.startswith(b"\xff\xd8")


def _jpeg_is_whole(data: bytes) -> bool:
    """Whether the picture's end marker follows its scan; an embedded thumbnail's does not count.

    Decoders fill the missing part of a truncated picture with grey, mostly silently.
    """
    if data.endswith(b"\xff\xd9"):
        return True
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xDA:
            # Inside a scan a byte 0xFF is never followed by 0xD9, so the first is the end.
            return data.find(b"\xff\xd9", at) >= 0
        if data[at + 1] == 0xFF:
            at += 1
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _lens(photo: Image.Image) -> tuple[str, str, float] | None:
    try:
        exif = photo.getexif()
        detail = exif.get_ifd(0x8769)
        make, model = str(exif[0x010F]).strip("\0 "), str(exif[0x0110]).strip("\0 ")
        # As COLMAP: the focal length in 35 mm film where given, else the real one.
        focal = float(detail[0xA405] if 0xA405 in detail else detail[0x920A])
    except (KeyError, TypeError, ValueError, ArithmeticError, OSError, SyntaxError, struct.error):
        return None  # no such tags, or broken ones: the pixels may well be whole
    return (make, model, focal) if make and model else None


def _reduction(factor: float) -> int | None:
    """OpenCV's flag for the strongest reduction that still leaves `factor` >= 1."""
    if factor >= 8:
        return cv2.IMREAD_REDUCED_COLOR_8
    if factor >= 4:
        return cv2.IMREAD_REDUCED_COLOR_4
    if factor >= 2:
        return cv2.IMREAD_REDUCED_COLOR_2
    return None


def _rounded(side: float) -> int:
    return max(SIDE_MULTIPLE, round(side / SIDE_MULTIPLE) * SIDE_MULTIPLE)
