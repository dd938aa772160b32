"""Matches of features that a database no longer has, found by content.

Features that were extracted again have as many keypoints as before where both runs stop at the
same limit. Then matches of the old ones still name keypoints that are there, at other places: they
do not lie on the two-view geometry that was estimated from them.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.colmap.database import Database, PairGeometry
from colmap_netvlad.colmap.results import camera_of
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.runtime.errors import InputError

LOOKED_AT = 200
"""Pairs that are looked at: each image's best one, evenly chosen where these are more. Keypoints
of all images would be gigabytes."""

LEAST_MATCHES = 15
"""Fewer matches may lie anywhere."""

OFF_SHARE = 0.01
OFF_PIXELS = 20.0
"""Matches lie on their geometry within COLMAP's few pixels; a median error of more than this, and
more than this share of the photo's width, is that of other features."""

Points = NDArray[np.float64]


def check_same_features(database: Database, pairs: Iterable[IdPair]) -> None:
    """Make sure that the matches of pairs are of the features that the database has.

    Args:
        pairs: pairs matched before, ids ascending.

    Raises:
        InputError: they are of others, or damaged.
    """
    counts = database.verified_matches()
    best: dict[int, IdPair] = {}
    for pair in sorted(pairs, key=lambda pair: counts.get(pair, 0)):
        if counts.get(pair, 0) >= LEAST_MATCHES:
            best.update(dict.fromkeys(pair, pair))
    chosen = sorted(set(best.values()))
    chosen = chosen[:: -(-len(chosen) // LOOKED_AT) or 1]
    names = {row.image_id: row.name for row in database.images()}
    keypoints = lru_cache(maxsize=64)(database.keypoints)
    for pair in chosen:
        geometry, matches = database.geometry(*pair), database.inlier_matches(*pair)
        cameras = _cameras(database, pair)
        if geometry is None or not cameras:
            continue
        ends = [keypoints(i)[matches[:, side]].astype(float) for side, i in enumerate(pair)]
        limit = max(OFF_PIXELS, OFF_SHARE * cameras[0].width)
        if _error(geometry, cameras, ends) > limit:
            raise InputError(
                f"The matches of {names[pair[0]]} and {names[pair[1]]} in {database.path} are not "
                "of the features that they have now (extracted again?): delete the matches there "
                "(tables matches and two_view_geometries), or restore the database from a copy."
            )


def _cameras(database: Database, pair: IdPair) -> list[pycolmap.Camera]:
    """Return the cameras of a pair; none where they are damaged, which COLMAP will say."""
    try:
        cameras = [camera_of(database, i) for i in pair]
    except (ValueError, TypeError):
        return []
    return cameras if all(camera.verify_params() for camera in cameras) else []


def _error(geometry: PairGeometry, cameras: list[pycolmap.Camera], ends: list[Points]) -> float:
    """Return the median distance of matches from the geometry that fits them best, px.

    0 where there is none to measure by.
    """
    one, two = ends
    errors: list[float] = []
    if geometry.F is not None:
        errors.append(_off_line(geometry.F, one, two))
    if geometry.E is not None:
        rays = [
            np.asarray(camera.cam_from_img(points), np.float64)
            for camera, points in zip(cameras, ends, strict=True)
        ]
        errors.append(_off_line(geometry.E, *rays) * cameras[1].mean_focal_length())
    if geometry.H is not None:
        there = _homogeneous(one) @ geometry.H.T
        off = np.linalg.norm(there[:, :2] / there[:, 2:] - two, axis=1)
        errors.append(float(np.nanmedian(off)))
    return min((error for error in errors if np.isfinite(error)), default=0.0)


def _off_line(matrix: Points, one: Points, two: Points) -> float:
    """Return the median distance of points from the epipolar lines of the others."""
    lines = _homogeneous(one) @ matrix.T
    off = (lines * _homogeneous(two)).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1)
    return float(np.nanmedian(np.abs(off)))


def _homogeneous(points: Points) -> Points:
    return np.column_stack([points, np.ones(len(points))])
