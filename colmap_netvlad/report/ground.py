"""The ground under a flight: its frame, footprints, ground sample distance, overlap."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.report.modeldata import ModelData
from colmap_netvlad.report.moves import Move, from_above, similarity

Floats = NDArray[np.float64]

OUTLIER = 3.0
"""A GPS position is put aside where its residual is this many times the median of all."""

NEAR = 2.0
"""A position this near is never put aside, m: it is GPS's own noise."""

ROUNDS = 5
"""How often the fit onto GPS is repeated without what was put aside."""

GRID = 400
"""Cells on the longer side of the overlap map."""

FARTHER = 1.2
"""A footprint reaches at most this many times as far as the photo has points: rays near the
horizon would reach for kilometres."""

ENOUGH = 3
"""Photos that a place needs for a reliable height."""


@dataclass(frozen=True, eq=False)
class Frame:
    """How a model's coordinates become those of the page.

    Attributes:
        move: model to page: x east (right), y north (up), z up.
        scale: page units of one model unit.
        metric: whether the page's unit is the metre and up is north.
        gps: (N, 3) known positions of the registered images, page units; NaN where unknown.
        residuals: (N, 3) computed centre - GPS, m; NaN where unknown or not metric.
        outliers: (N) whether a position was put aside in the fit.
        source: where the frame comes from, a phrase.
    """

    move: Move
    scale: float
    metric: bool
    gps: Floats
    residuals: Floats
    outliers: NDArray[np.bool_]
    source: str

    def turned(self, directions: Floats) -> Floats:
        """Return (K, 3) directions of the model in the page's frame, their length scaled too."""
        return np.asarray(self.move(directions) - self.move(np.zeros((1, 3))))


def fit_frame(data: ModelData, positions: Floats) -> Frame:
    """Move a model onto its GPS positions, or lay its ground into the page where they do not tell.

    The fit is least squares, repeated without the positions whose residual is `OUTLIER` times
    the median: one wrong position turns nothing.

    Args:
        positions: (N, 3) east, north, up of the registered images, m; NaN where unknown.
    """
    known = np.asarray(np.isfinite(positions).all(axis=1))
    positions = np.where(known[:, None], positions, np.nan)
    used = known
    move = None
    for _ in range(ROUNDS):
        target = np.where(used[:, None], positions, np.nan)
        better = similarity(data.centres, target)
        if better is None:
            break
        move = better
        distance = np.linalg.norm(move(data.centres) - positions, axis=1)
        near = distance <= max(OUTLIER * float(np.nanmedian(distance)), NEAR)
        if np.array_equal(near, used):
            break
        used = near
    if move is None:
        nothing = np.full((len(data.names), 3), np.nan)
        flat = Move(1.0, np.eye(3), np.zeros(3), np.zeros(3))
        if len(data.names):
            flat = from_above(data.centres, data.points)
        source = "the model's own frame, its ground laid into the page; the unit is the model's"
        return Frame(flat, 1.0, False, nothing, nothing, np.zeros(len(known), bool), source)
    unit = move(np.eye(3)[:1]) - move(np.zeros((1, 3)))
    return Frame(
        move,
        float(np.linalg.norm(unit)),
        True,
        positions,
        move(data.centres) - positions,
        known & ~used,
        f"the positions of {int(known.sum()):,} photos",
    )


def ground_sample_distances(
    data: ModelData, model: pycolmap.Reconstruction, frame: Frame
) -> Floats:
    """Return (N) ground size of a pixel: the median distance of a photo's points over its focal
    length, page units; NaN where a photo sees no point."""
    focal = {i: camera.mean_focal_length() for i, camera in model.cameras.items()}
    lengths = np.array([focal[camera] for camera in data.cameras.tolist()])
    return np.asarray(data.depths * frame.scale / lengths)


def footprints(data: ModelData, model: pycolmap.Reconstruction, frame: Frame) -> Floats:
    """Return (N, 4, 2) corners of each photo on the ground, page units; NaN where it sees none.

    The ground of a photo is the level plane through the median height of the points it sees.
    """
    corners = np.full((len(data.names), 4, 2), np.nan)
    centres = frame.move(data.centres)
    points = frame.move(data.points)
    rays = {i: _corner_rays(camera) for i, camera in model.cameras.items()}
    for i, camera in enumerate(data.cameras.tolist()):
        seen = data.seen_points[data.starts[i] : data.starts[i + 1]]
        if not len(seen):
            continue
        below = float(np.median(points[seen, 2])) - centres[i, 2]
        reach = FARTHER * data.reaches[i] * frame.scale
        direction = frame.turned(rays[camera] @ data.rotations[i])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = below / direction[:, 2]
        distance = np.where((distance > 0) & (distance < reach), distance, reach)
        corners[i] = centres[i, :2] + distance[:, None] * direction[:, :2]
    return corners


def _corner_rays(camera: pycolmap.Camera) -> Floats:
    width, height = camera.width, camera.height
    pixels = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    return np.column_stack([camera.cam_from_img(pixels), np.ones(4)])


@dataclass(frozen=True, eq=False)
class Overlap:
    """How many photos see each cell of the ground.

    Attributes:
        count: (rows, columns) photos; the first row is the most southern.
        inside: (rows, columns) whether a cell lies between the cameras (in the hull of their
            centres): the edge of a flight is always seen by few.
        west, south: lower left corner, page units.
        cell: side of a cell, page units.
    """

    count: NDArray[np.int32]
    inside: NDArray[np.bool_]
    west: float
    south: float
    cell: float

    @property
    def area(self) -> float:
        """Ground that at least one photo sees, square page units."""
        return float((self.count > 0).sum()) * self.cell**2

    @property
    def inner_area(self) -> float:
        """Ground between the cameras, square page units."""
        return float(self.inside.sum()) * self.cell**2

    def share(self, photos: int) -> float:
        """Return the share of the ground between the cameras that this many photos see, 0..1."""
        cells = self.count[self.inside]
        return float((cells >= photos).mean()) if len(cells) else float("nan")

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north."""
        rows, columns = self.count.shape
        return (
            self.west,
            self.west + columns * self.cell,
            self.south,
            self.south + rows * self.cell,
        )


def overlap_map(corners: Floats, centres: Floats) -> Overlap | None:
    """Count how many footprints cover each cell of a ground grid.

    Args:
        corners: (N, 4, 2) footprints; NaN where a photo has none.
        centres: (N, 2 or 3) camera centres, same frame.

    Returns:
        None where no photo has a footprint.
    """
    whole = corners[np.isfinite(corners).all(axis=(1, 2))]
    if not len(whole):
        return None
    low, high = whole.min(axis=(0, 1)), whole.max(axis=(0, 1))
    cell = float((high - low).max()) / GRID
    if cell <= 0:
        return None
    columns, rows = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
    count = np.zeros((rows, columns), np.int32)
    # Polygons are drawn on cells, whose middles lie at whole numbers.
    places = (whole - low) / cell - 0.5
    for place in places:
        drawn = np.zeros((rows, columns), np.uint8)
        cv2.fillConvexPoly(drawn, _fixed_point(place), 1, shift=SHIFT)
        count += drawn
    inside = np.zeros((rows, columns), np.uint8)
    hull = cv2.convexHull(((centres[:, :2] - low) / cell - 0.5).astype(np.float32))
    if len(hull) > 2:
        cv2.fillConvexPoly(inside, _fixed_point(hull[:, 0]), 1, shift=SHIFT)
    return Overlap(count, inside > 0, float(low[0]), float(low[1]), cell)


SHIFT = 6
"""Fractional bits of the corners that OpenCV draws."""


def _fixed_point(places: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.asarray((places * 2**SHIFT).round(), np.int32)
