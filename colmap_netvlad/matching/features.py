"""SIFT features of a photo, prepared once for all its pairs.

Descriptors stay bytes: machine instructions for products of bytes are ten times as fast as those
for floats, and exact, so that every machine finds the same matches.
"""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

SIFT_BYTES = 128
"""Length of a SIFT descriptor."""

BLOCK_FEATURES = 384
"""Most features of a block: of smaller ones the calls cost more than the products, for larger ones
the windows grow."""


@dataclass(frozen=True, eq=False)
class SiftFeatures:
    """Features of one photo.

    Attributes:
        at: (N, 2) x, y, pixels; NaN where the keypoint is not finite.
        log_scale: (N,) natural logarithm of the scale.
        angle: (N,) orientation, rad.
        codes: (N, 128) descriptors less 128; of nothing but zeros where the keypoint is not
            finite, which is like nothing.
        largest: (<= N,) finite features, those of the largest scales first.
        blocks: features in groups that lie together, without those that are not finite.
        checksum: of keypoints and descriptors.
    """

    at: NDArray[np.float32]
    log_scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    codes: NDArray[np.int8]
    largest: NDArray[np.intp]
    blocks: tuple[NDArray[np.intp], ...]
    checksum: int

    def __len__(self) -> int:
        return len(self.at)


def prepare(keypoints: NDArray[np.float32], descriptors: NDArray[np.uint8]) -> SiftFeatures:
    """Prepare features as COLMAP's database keeps them.

    Args:
        keypoints: (N, 2) x, y; (N, 4) with scale and orientation; or (N, 6) with an affine shape.
        descriptors: (N, 128) of length 512 (RootSIFT, COLMAP's L1_ROOT).

    Raises:
        ValueError: unequal numbers, or descriptors of another length.
    """
    if len(keypoints) != len(descriptors):
        raise ValueError(f"{len(keypoints)} keypoints have {len(descriptors)} descriptors")
    if descriptors.shape[1] != SIFT_BYTES or descriptors.dtype != np.uint8:
        raise ValueError(f"descriptors are not SIFT's {SIFT_BYTES} bytes")
    scale, angle = _scale_and_angle(keypoints)
    good = np.isfinite(keypoints).all(axis=1) & (scale > 0)
    at = np.where(good[:, None], keypoints[:, :2], np.nan).astype(np.float32)
    codes = np.where(good[:, None], descriptors, 0) ^ 128
    codes = codes.astype(np.uint8).view(np.int8)
    order = np.argsort(-np.where(good, scale, 0), kind="stable")[: good.sum()]
    return SiftFeatures(
        at=at,
        log_scale=np.log(np.where(good, scale, 1)).astype(np.float32),
        angle=np.where(good, angle, 0).astype(np.float32),
        codes=codes,
        largest=order,
        blocks=tuple(_blocks(at, np.flatnonzero(good))),
        checksum=crc32(descriptors.tobytes(), crc32(keypoints.tobytes())),
    )


def _scale_and_angle(
    keypoints: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N,) scale and orientation; 1 and 0 where keypoints have none."""
    shape = keypoints[:, 2:].astype(np.float64)
    if shape.shape[1] == 2:
        return shape[:, 0], shape[:, 1]
    if shape.shape[1] == 4:
        a11, a12, a21, a22 = shape.T
        return np.sqrt(np.abs(a11 * a22 - a12 * a21)), np.arctan2(a21, a11)
    return np.ones(len(shape)), np.zeros(len(shape))


def _blocks(at: NDArray[np.float32], features: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return features in blocks: halved along the longer side until they are small."""
    if len(features) == 0:
        return []
    if len(features) <= BLOCK_FEATURES:
        return [features]
    places = at[features]
    order = np.argsort(places[:, np.ptp(places, axis=0).argmax()], kind="stable")
    halves = np.array_split(order, 2)
    return [block for half in halves for block in _blocks(at, np.sort(features[half]))]
