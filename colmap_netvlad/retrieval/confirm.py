"""The largest SIFT features of two photos, asked whether they agree.

Cells tell a piece of ground from another by what it is; where all of it is alike (palms, canopy,
water) few of them agree on the right transform. There the features that matching goes by help: the
largest are few, each says by itself how one photo lies in the other (`graph.oriented`), and those
that match by chance do not agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_netvlad.flight import Flight
from colmap_netvlad.graph.oriented import agreements, angles, scales, usable
from colmap_netvlad.runtime.products import operand, products

if TYPE_CHECKING:
    import torch

LARGEST_FEATURES = "largest SIFT features"
"""What the store numbers them under."""

LARGEST = 800
"""Features of a photo, those of the largest scales, which photos of other heights show too."""

RATIO = 0.9
MAX_ANGLE = 0.7
"""A match must be so much more alike than the most alike of other places of its own photos (share
of the angle between descriptors), and alike at all (rad). Asking each feature's own photo, once,
serves as well as the ratio to the second nearest of each other photo."""

SAME_PLACE = 3.0
"""Features of one photo nearer than this (pixels) are one place seen in two ways."""

MOST_ASKED = 64
"""Matches asked at most, the most alike."""

UNIT = 256.0
"""Length of halved descriptors: of COLMAP's 512, so that their bytes are signed ones."""


@dataclass(frozen=True, eq=False)
class Largest:
    """The N largest features of a photo.

    Attributes:
        at: (N, 2) x, y, pixels.
        log_scale: (N,) natural logarithm of the scale.
        angle: (N,) orientation, rad.
        codes: (N, 128) halved descriptors.
        least: (N,) the product of halved descriptors that a match must exceed.
    """

    at: NDArray[np.float32]
    log_scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    codes: torch.Tensor
    least: NDArray[np.int32]

    @property
    def nbytes(self) -> int:
        """Memory they take."""
        fields = (self.at, self.log_scale, self.angle, self.codes, self.least)
        return sum(field.nbytes for field in fields)

    @classmethod
    def of(cls, keypoints: NDArray[np.float32], descriptors: NDArray[np.uint8]) -> Largest:
        """Choose from features as COLMAP's database keeps them."""
        scale = scales(keypoints)
        good = usable(keypoints, scale)
        order = np.flatnonzero(good)
        if len(order) > LARGEST:
            order = np.sort(order[np.argpartition(-scale[order], LARGEST)[:LARGEST]])
        at = keypoints[order, :2]
        codes = operand(np.rint(descriptors[order] / 2).clip(0, 127).astype(np.int8))
        return cls(
            at,
            np.log(scale[order]).astype(np.float32),
            angles(keypoints[order]).astype(np.float32),
            codes,
            _least(at, codes),
        )


def agreeing_features(one: Largest, other: Largest) -> int:
    """Return how many matches agree with the one that most agree with, itself included."""
    if min(len(one.at), len(other.at)) == 0:
        return 0
    alike = products(one.codes, other.codes)
    j = alike.argmax(axis=1)
    alike = alike[np.arange(len(j)), j]
    i = np.flatnonzero((alike > one.least) & (alike > other.least[j]))
    # The most alike first; each feature of the other photo once.
    i = i[np.argsort(-alike[i], kind="stable")]
    i = i[np.sort(np.unique(j[i], return_index=True)[1])][:MOST_ASKED]
    matches = np.stack([i, j[i]], axis=1)
    return int(agreements(one, other, matches).sum(axis=1).max(initial=0))


class LargestFeatures:
    """The largest features of a flight's photos, read from its database when asked for.

    Attributes:
        fingerprints: name -> fingerprint of the features of images that have some.
    """

    def __init__(self, flight: Flight) -> None:
        self._database = flight.database
        self._ids = {i.name: i.image_id for i in flight.images if i.image_id in flight.features}
        self.fingerprints = {name: flight.features[number] for name, number in self._ids.items()}

    def read(self, name: str) -> Largest:
        """Return an image's; none where keypoints and descriptors do not belong together.

        Raises:
            InputError: they are damaged.
        """
        image_id = self._ids[name]
        keypoints = self._database.keypoint_shapes(image_id)
        descriptors = self._database.sift_descriptors(image_id)
        count = len(keypoints) if len(keypoints) == len(descriptors) else 0
        return Largest.of(keypoints[:count], descriptors[:count])


def largest_features(flight: Flight) -> LargestFeatures | None:
    """Return the largest SIFT features of a flight's photos, or None where it has none."""
    return LargestFeatures(flight) if flight.database.has_sift() else None


def _least(at: NDArray[np.float32], codes: torch.Tensor) -> NDArray[np.int32]:
    """Return the product that a match of each feature must exceed."""
    alike = products(codes, codes)
    np.fill_diagonal(alike, 0)
    i, j = cKDTree(at).query_pairs(SAME_PLACE, output_type="ndarray").T
    alike[i, j] = alike[j, i] = 0
    nearest = np.arccos(np.minimum(alike.max(axis=1, initial=0) / UNIT**2, 1))
    return np.ceil(UNIT**2 * np.cos(np.minimum(RATIO * nearest, MAX_ANGLE))).astype(np.int32)
