"""A reconstruction of a rendered flight held against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.demo.render import RenderedFlight

MOST_ERROR = 0.01
"""Largest error of a camera centre that counts as right, as a share of the flight's extent."""


@dataclass(frozen=True, eq=False)
class TruthCheck:
    """How far a model is from the truth.

    Attributes:
        registered: images of the largest model.
        images: photos of the flight.
        errors: (registered,) distance of each camera centre from its true place after the best
            similarity transform, m.
        extent: diagonal of the box around the true centres, m.
    """

    registered: int
    images: int
    errors: NDArray[np.float64]
    extent: float

    @property
    def passed(self) -> bool:
        """Whether every photo is registered, and in its place within `MOST_ERROR`."""
        return self.registered == self.images and self.largest <= MOST_ERROR

    @property
    def largest(self) -> float:
        """Largest error as a share of the extent; infinite where nothing is registered."""
        return float(self.errors.max()) / self.extent if len(self.errors) else float("inf")

    @property
    def mean(self) -> float:
        """Mean error as a share of the extent; infinite where nothing is registered."""
        return float(self.errors.mean()) / self.extent if len(self.errors) else float("inf")


def check_against_truth(
    models: Sequence[pycolmap.Reconstruction], flight: RenderedFlight
) -> TruthCheck:
    """Compare the camera centres of the largest model with the flight's."""
    true = dict(zip(flight.names, flight.centres, strict=True))
    largest = max(models, key=lambda model: model.num_reg_images(), default=None)
    if largest is None:
        return TruthCheck(0, len(true), np.zeros(0), flight.extent)
    found = {
        image.name: image.projection_center()
        for image in largest.images.values()
        if image.has_pose and image.name in true
    }
    moved, target = align(found, true)
    errors = np.linalg.norm(moved - target, axis=1)
    return TruthCheck(len(found), len(true), errors, flight.extent)


def align(
    found: dict[str, NDArray[np.float64]], true: dict[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N, 3) found centres moved onto the true ones, and those, in the order of `found`."""
    source = np.array([found[name] for name in found]).reshape(-1, 3)
    target = np.array([true[name] for name in found]).reshape(-1, 3)
    transform = pycolmap.estimate_sim3d(source, target)
    if transform is None:  # fewer than three places, or all on one line
        return np.full_like(source, np.inf), target
    return np.array([transform * point for point in source]), target
