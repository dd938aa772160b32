"""Masks in COLMAP's way: areas of a photo that say nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.photos.files import BadPhoto, read_bytes
from colmap_netvlad.runtime.errors import InputError

UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda stored: stored,
    2: np.fliplr,
    3: lambda stored: np.rot90(stored, 2),
    4: np.flipud,
    5: np.transpose,
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: np.rot90(stored, 2).T,
    8: np.rot90,
}
"""By EXIF's orientation, how stored pixels become upright."""


def find_mask(masks: Path, name: str) -> Path | None:
    """Return the mask of a photo in COLMAP's way, `<name>.png` or its stem's, or None."""
    candidates = (masks / f"{name}.png", (masks / name).with_suffix(".png"))
    return next((mask for mask in candidates if mask.is_file()), None)


def check_masks(masks: Path | None) -> None:
    """Make sure that a folder of masks is there, if one is named.

    Raises:
        InputError: it is not.
    """
    if masks is not None and not masks.is_dir():
        raise InputError(f"The mask folder {masks} does not exist; mend `masks`.")


def without_mask(masks: Path, names: Iterable[str]) -> dict[str, str]:
    """Return (name -> reason) of the photos that have no mask."""
    return {
        name: f"has no mask {masks / name}.png" for name in names if find_mask(masks, name) is None
    }


def neutralise(pixels: NDArray[np.uint8], mask: Path, orientation: int = 1) -> NDArray[np.uint8]:
    """Return the photo with its masked area (black in the mask) in the mean colour of the rest.

    An even area has no texture for a network to describe. A mask that covers everything leaves
    an even grey photo.

    Args:
        pixels: (H, W, 3) uint8, upright.
        mask: a picture of any size that is stretched over the photo as it is stored, as COLMAP
            does.
        orientation: how that was turned to be upright, 1..8 as in EXIF.

    Raises:
        BadPhoto: the mask cannot be read.
    """
    shape = cv2.imdecode(np.frombuffer(read_bytes(mask), np.uint8), cv2.IMREAD_GRAYSCALE)
    if shape is None:
        raise BadPhoto(f"has a mask that is no picture ({mask.name})")
    shape = np.ascontiguousarray(UPRIGHT[orientation](shape))
    size = (pixels.shape[1], pixels.shape[0])
    seen = cv2.resize(shape, size, interpolation=cv2.INTER_NEAREST) > 0
    fill = pixels[seen].mean(axis=0) if seen.any() else 128.0
    return np.where(seen[:, :, None], pixels, np.round(fill)).astype(np.uint8)
