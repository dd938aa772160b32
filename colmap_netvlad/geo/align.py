"""A model aligned to known places: one robust similarity, residuals, outliers by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_netvlad.runtime.errors import InputError

Array = NDArray[np.float64]

MIN_PLACES = 3
"""Places that a similarity needs."""

ERROR_LADDER = (5.0, 20.0, 80.0)
"""Residuals that pass for noise, m, tried in this order: GPS on a drone, poor GPS, a model that is
bent by much more than its GPS is wrong."""

MIN_AGREEING = 0.5
"""At least this share of the places must agree with one similarity."""

OUTLIER_SPREADS = 5.0
"""A place is an outlier from this many robust standard deviations of the residuals on."""

MIN_OUTLIER = 0.05
"""Residuals below this are never outliers, m: RTK's own noise."""

LINE_ANGLE = 0.02
"""Places lie on one line where the noise leaves the turn about it open by more than this, rad."""

LINE_SHAPE = 5.0
"""And where they spread so many times as much along it as beside: a compact flight has no line, and
levelling it about a diagonal would tilt it the other way."""

LINE_WIDTH = 1e-3
"""Or where their spread beside the line is below this share of the spread along it."""

LEVEL_SLOPE = 1e-6
"""Slope of a flight that is taken to be level: a millimetre in a kilometre."""

DOWN_WEIGHT = 0.01
"""What looking down counts beside being level when the turn about a line is chosen."""


class NotAligned(InputError):
    """The places do not fix the model, or do not agree with it."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a model was brought into the world.

    Attributes:
        world_from_model: the similarity; its scale is m per unit of the model.
        names: the N photos with a known place and a pose.
        residuals: (N, 3) model minus known place, m east, north, up; up is NaN where no height
            is known.
        outliers: (N,) bool, places that do not agree and had no say.
        notes: sentences on what was assumed.
    """

    world_from_model: pycolmap.Sim3d
    names: tuple[str, ...]
    residuals: Array
    outliers: NDArray[np.bool_]
    notes: tuple[str, ...] = ()

    @property
    def horizontal(self) -> float:
        """Root mean square of the horizontal residuals without outliers, m."""
        return _rms(np.hypot(*self.residuals[~self.outliers, :2].T))

    @property
    def vertical(self) -> float:
        """Root mean square of the vertical residuals without outliers, m; NaN without heights."""
        up = self.residuals[~self.outliers, 2]
        return _rms(up[np.isfinite(up)])


def align(
    names: Sequence[str],
    centres: Array,
    rotations: Array,
    places: Array,
    seed: int = 0,
) -> Alignment:
    """Find the similarity that brings a model's camera centres to known places.

    Args:
        names: of the N photos.
        centres: (N, 3) camera centres in the model.
        rotations: (N, 3, 3) camera from world.
        places: (N, 3) m east, north, up; NaN rows where nothing is known, NaN up where the
            height alone is not.
        seed: of RANSAC.

    Raises:
        NotAligned: fewer than three places, all in one spot, or too few that agree.
    """
    kept = np.flatnonzero(np.isfinite(places[:, 0]) & np.isfinite(places[:, 1])).tolist()
    names = tuple(names[i] for i in kept)
    centres, rotations, places = centres[kept], rotations[kept], places[kept]
    if len(names) < MIN_PLACES:
        raise NotAligned(
            f"Only {len(names)} photo{'s' * (len(names) != 1)} of the model "
            f"{'have' if len(names) != 1 else 'has'} a known position, and a model needs "
            f"{MIN_PLACES} to be placed."
        )
    notes: list[str] = []
    high = np.isfinite(places[:, 2])
    target = places.copy()
    if high.sum() < MIN_PLACES:
        level = np.median(places[high, 2]) if high.any() else 0.0
        # Eigen's decomposition gives up on heights that are exactly equal.
        target[:, 2] = level + LEVEL_SLOPE * (target[:, 0] - target[:, 0].mean())
        high = np.ones(len(names), bool)
        notes.append("The photos have no heights, so the flight is taken to be level at one.")
    found, agreed = _ladder(centres, target, high, seed)
    found, agreed = _tighten(found, centres, target, high, agreed)
    residuals = moved(found, centres) - places
    outliers = ~agreed & _far(moved(found, centres) - target, agreed)
    if _on_line(moved(found, centres[agreed]), residuals[agreed]):
        found = _level(found, centres[agreed], rotations)
        residuals = moved(found, centres) - places
        notes.append(
            "The positions lie on one line and leave the turn about it open; it is chosen so that "
            "the photos are level, as a gimbal holds them."
        )
    return Alignment(found, names, residuals, outliers, tuple(notes))


def as_it_lies(names: Sequence[str], centres: Array, places: Array) -> Alignment:
    """Return the residuals of a model that is in the world already, without moving it."""
    kept = np.flatnonzero(np.isfinite(places[:, 0]) & np.isfinite(places[:, 1])).tolist()
    residuals = centres[kept] - places[kept]
    everything = np.ones(len(kept), bool)
    outliers = _far(residuals, everything)
    return Alignment(pycolmap.Sim3d(), tuple(names[i] for i in kept), residuals, outliers)


def moved(similarity: pycolmap.Sim3d, points: Array) -> Array:
    """Return (N, 3) points moved by a similarity."""
    matrix = similarity.matrix()
    return points @ matrix[:, :3].T + matrix[:, 3]


def _ladder(
    centres: Array, target: Array, high: NDArray[np.bool_], seed: int
) -> tuple[pycolmap.Sim3d, NDArray[np.bool_]]:
    """Return a similarity, and which places agree, at the smallest error that most agree with."""
    if np.ptp(target[high, :2], axis=0).max() == 0 or np.ptp(centres[high], axis=0).max() == 0:
        raise NotAligned("All photos are at one position, which says nothing on the model's place.")
    best = 0
    spread = np.linalg.svd(centres[high] - centres[high].mean(axis=0), compute_uv=False)
    if spread[1] < LINE_WIDTH * spread[0]:
        return _along_line(centres, target, high)
    for error in ERROR_LADDER:
        options = pycolmap.RANSACOptions(
            max_error=error, min_inlier_ratio=MIN_AGREEING, random_seed=seed
        )
        # A dictionary, whatever pycolmap's stubs say.
        found: Any = pycolmap.estimate_sim3d_robust(centres[high], target[high], options)
        if found is None:
            continue
        similarity: pycolmap.Sim3d = found["tgt_from_src"]
        agreed = high.copy()
        distance = np.linalg.norm(moved(similarity, centres[high]) - target[high], axis=1)
        agreed[high] = distance <= error
        best = max(best, int(agreed.sum()))
        if agreed.sum() >= max(MIN_PLACES, MIN_AGREEING * high.sum()):
            return similarity, agreed
    raise NotAligned(
        f"The positions do not fit the model: of {int(high.sum())}, at most {best} agree within "
        f"{ERROR_LADDER[-1]:.0f} m."
    )


def _along_line(
    centres: Array, target: Array, high: NDArray[np.bool_]
) -> tuple[pycolmap.Sim3d, NDArray[np.bool_]]:
    """Return a similarity for centres on one line, which leave the turn about it open."""
    middle = centres[high].mean(axis=0)
    line = np.linalg.svd(centres[high] - middle, full_matrices=False)[2][0]
    along = np.column_stack([np.ones(high.sum()), (centres[high] - middle) @ line])
    weight = np.ones(high.sum())
    for _ in range(50):  # least absolute residuals, by weights: single wild places have no say
        root = np.sqrt(weight)[:, None]
        fit = np.linalg.lstsq(along * root, target[high] * root, rcond=None)[0]
        weight = 1 / np.maximum(np.linalg.norm(along @ fit - target[high], axis=1), 1e-3)
    scale = float(np.linalg.norm(fit[1]))
    turn, _ = Rotation.align_vectors(fit[1:2], line[None])
    matrix = np.column_stack([scale * turn.as_matrix(), fit[0] - scale * turn.apply(middle)])
    return pycolmap.Sim3d(matrix), high


def _tighten(
    similarity: pycolmap.Sim3d,
    centres: Array,
    target: Array,
    high: NDArray[np.bool_],
    agreed: NDArray[np.bool_],
) -> tuple[pycolmap.Sim3d, NDArray[np.bool_]]:
    """Fit to what agrees, and look again at what agrees, until nothing changes."""
    for _ in range(20):
        # All on one line: least squares has no unique answer, and RANSAC's is as good.
        similarity = pycolmap.estimate_sim3d(centres[agreed], target[agreed]) or similarity
        again = high & ~_far(moved(similarity, centres) - target, agreed)
        if again.sum() < MIN_PLACES or (again == agreed).all():
            break
        agreed = again
    return similarity, agreed


def _far(residuals: Array, agreed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which residuals are far beyond those that agree, horizontally or vertically."""
    far = np.zeros(len(residuals), bool)
    for part in (np.hypot(residuals[:, 0], residuals[:, 1]), np.abs(residuals[:, 2])):
        known = part[agreed & np.isfinite(part)]
        if len(known):
            # A robust spread: 1.4826 times the median is a standard deviation of normal noise.
            limit = max(MIN_OUTLIER, OUTLIER_SPREADS * 1.4826 * float(np.median(known)))
            far |= part > limit
    return far


def _on_line(places: Array, residuals: Array) -> bool:
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    noise = np.sqrt(np.nanmean(residuals**2) * 3)
    open_turn = noise > LINE_ANGLE * spread[1] and LINE_SHAPE * spread[1] < spread[0]
    return bool(spread[1] < LINE_WIDTH * spread[0] or open_turn)


def _level(similarity: pycolmap.Sim3d, centres: Array, rotations: Array) -> pycolmap.Sim3d:
    """Turn the model about the line of its centres until the photos are level.

    A camera is level where its x axis is; of the two turns that make it so, the one counts in
    which the cameras look down.
    """
    places = moved(similarity, centres)
    middle = places.mean(axis=0)
    line = np.linalg.svd(places - middle, full_matrices=False)[2][0]
    world_from_model = similarity.rotation.matrix()
    right = rotations[:, 0] @ world_from_model.T
    ahead = (rotations[:, 2] @ world_from_model.T).mean(axis=0)
    tilt = right.T @ right / len(right)
    up = np.array([0.0, 0.0, 1.0])
    angles = np.radians(np.arange(0, 360, 0.02))
    # Turning the model by an angle is turning the vertical by its opposite.
    along = (up @ line) * line
    beside = up - along
    vertical = (
        along + np.outer(np.cos(angles), beside) - np.outer(np.sin(angles), np.cross(line, beside))
    )
    cost = np.einsum("ai,ij,aj->a", vertical, tilt, vertical) + DOWN_WEIGHT * vertical @ ahead
    turn = pycolmap.Rotation3d(line * angles[np.argmin(cost)])
    about = pycolmap.Sim3d(1.0, turn, middle - turn.matrix() @ middle)
    return about * similarity


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
