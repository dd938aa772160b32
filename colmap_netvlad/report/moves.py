"""Similarity transforms: a model onto known positions, or its ground into the page."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

LEAST_SPREAD = 0.02
"""Points on a line to within this share of its length do not fix a rotation."""

Points = NDArray[np.float64]


class Move:
    """A similarity transform of 3D points: scale, rotation, translation."""

    def __init__(self, scale: float, rotation: NDArray[np.float64], origin: Points, target: Points):
        self._linear = scale * rotation
        self._origin, self._target = origin, target

    def __call__(self, points: Points) -> Points:
        return (points - self._origin) @ self._linear.T + self._target


def similarity(source: Points, target: Points) -> Move | None:
    """Return the least-squares similarity from (N, 3) onto (N, 3), or None where it is not fixed:
    fewer than three common finite points, or points on a line."""
    both = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    source, target = source[both], target[both]
    if len(source) < 3:
        return None
    origin, middle = source.mean(axis=0), target.mean(axis=0)
    a, b = source - origin, target - middle
    for spread in (np.linalg.svd(a, compute_uv=False), np.linalg.svd(b, compute_uv=False)):
        if spread[1] <= LEAST_SPREAD * spread[0]:
            return None
    rotation, _ = Rotation.align_vectors(b, a)
    matrix = rotation.as_matrix()
    scale = float((b * (a @ matrix.T)).sum() / (a**2).sum())
    return Move(scale, matrix, origin, middle) if scale > 0 else None


def from_above(centres: Points, points: Points) -> Move:
    """Return the rotation that lays the ground into the page, cameras above it.

    The ground's normal is the direction in which points and cameras spread least: a drone's
    flight is wide and flat.
    """
    cloud = np.vstack([centres, _core(points)])
    middle = cloud.mean(axis=0)
    axes = np.linalg.svd((cloud - middle).T @ (cloud - middle))[2]
    up, right = axes[2], axes[0]
    above = centres.mean(axis=0) - (np.median(points, axis=0) if len(points) else middle)
    if above @ up < 0:
        up = -up
    return Move(1.0, np.array([right, np.cross(up, right), up]), middle, np.zeros(3))


def _core(points: Points) -> Points:
    """Drop the farthest tenth of the points: a few wild ones would tilt the ground."""
    if len(points) < 10:
        return points
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return points[distance <= np.quantile(distance, 0.9)]
