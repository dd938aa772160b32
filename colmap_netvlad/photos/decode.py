"""Photos -> pixels: fast reduced-scale decoding, EXIF orientation, batches of equal size.

Nothing here knows about networks: pixels leave as 8-bit RGB, and a model normalises them itself.
"""

from __future__ import annotations

import io
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.photos.files import (
    BadPhoto,
    is_jpeg,
    parse_header,
    photo_path,
    read_bytes,
    read_header,
)
from colmap_netvlad.photos.masks import find_mask, neutralise
from colmap_netvlad.runtime.machine import usable_processors

SIDE_MULTIPLE = 16
"""Both sides of a decoded photo are multiples of this, the stride of VGG-16 up to conv5_3."""


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
    data = read_bytes(path)
    header = parse_header(io.BytesIO(data))
    flags = _reduction(max(header.width, header.height) / long_side) if is_jpeg(data) else None
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
        path = photo_path(folder, name)
        pixels = decode_photo(path, long_side)
        mask = find_mask(masks, name) if masks is not None else None
        return pixels if mask is None else neutralise(pixels, mask, read_header(path).orientation)

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
