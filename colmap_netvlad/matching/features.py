"""SIFT features of a photo, prepared once for all its pairs.

Descriptors stay bytes: machine instructions for products of bytes are ten times as fast as those
for floats, and exact, so that every machine finds the same matches.
"""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.graph.oriented import angles, largest_first, scales, usable
from colmap_netvlad.matching.nearest import Codes

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
        codes: of the N descriptors; of nothing but zeros where the keypoint is not finite, which
            is like nothing.
        largest: (<= N,) finite features, those of the largest scales first.
        blocks: features in groups that lie together, without those that are not finite.
        centres: (B, 2) mean place of each block.
        corners: (2, 2) least and most x, y of all; NaN where there is none.
        checksum: of keypoints and descriptors.
    """

    at: NDArray[np.float32]
    log_scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    codes: Codes
    largest: NDArray[np.intp]
    blocks: tuple[NDArray[np.intp], ...]
    centres: NDArray[np.float64]
    corners: NDArray[np.float64]
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
    scale, angle = scales(keypoints), angles(keypoints)
    good = usable(keypoints, scale)
    at = np.where(good[:, None], keypoints[:, :2], np.nan).astype(np.float32)
    if not good.all():
        descriptors = np.where(good[:, None], descriptors, np.uint8(0))
    blocks = tuple(_blocks(at, np.flatnonzero(good)))
    return SiftFeatures(
        at=at,
        log_scale=np.log(np.where(good, scale, 1)).astype(np.float32),
        angle=np.where(good, angle, 0).astype(np.float32),
        codes=Codes.of(descriptors),
        largest=largest_first(scale, good),
        blocks=blocks,
        centres=np.array([at[block].mean(axis=0, dtype=float) for block in blocks]).reshape(-1, 2),
        corners=_corners(at[good]),
        checksum=crc32(descriptors.tobytes(), crc32(keypoints.tobytes())),
    )


def _corners(at: NDArray[np.float32]) -> NDArray[np.float64]:
    if len(at) == 0:
        return np.full((2, 2), np.nan)
    return np.stack([at.min(axis=0), at.max(axis=0)]).astype(float)


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
