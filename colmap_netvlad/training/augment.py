"""Views of photos: any rotation, flips, scale, shift, perspective, illumination; pseudo-scenes.

Ours: the paper shows each photo as it is, downsampled (section 4.2).

A nadir photo has no up: flights turn, so views are turned by any angle. A view is a homography
and an illumination, drawn from (seed, epoch, ...) alone; rendering it draws nothing, so the same
view gives the same pixels in a resumed run.

Coordinates: origin in the centre of the photo (or view), x right, y down, unit the longer side.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.training.scenes import Observations, Scene, common_points

Size = tuple[int, int]
"""Width and height in pixels."""


@dataclass(frozen=True)
class Augmentation:
    """How far views differ from their photo.

    Attributes:
        rotation: largest turn either way, degrees; 180 is any rotation.
        flip: probability of a mirrored view.
        scale: the smallest and largest share of the photo's longer side that the view's longer
            side covers; above 1 the border is filled by reflection.
        perspective: largest shift of a corner, as a share of the view's sides.
        illumination: standard deviation of log gamma; contrast, brightness and colour follow it.
    """

    rotation: float = 180.0
    flip: float = 0.5
    scale: tuple[float, float] = (0.65, 1.25)
    perspective: float = 0.08
    illumination: float = 0.2


@dataclass(frozen=True, eq=False)
class View:
    """A view of a photo.

    Attributes:
        homography: (3, 3) from photo to view coordinates.
        gamma, contrast, brightness: of the grey values (brightness in grey values of 255).
        colour: (3,) gains of R, G, B.
    """

    homography: NDArray[np.float64]
    gamma: float = 1.0
    contrast: float = 1.0
    brightness: float = 0.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)


def draw_view(
    rng: np.random.Generator, photo: Size, size: Size, augmentation: Augmentation
) -> View:
    """Draw a view of `size` of a photo; it lies mostly inside the photo."""
    low, high = np.log(augmentation.scale)
    scale = float(np.exp(rng.uniform(low, high)))
    turn = np.deg2rad(rng.uniform(-augmentation.rotation, augmentation.rotation))
    mirror = -1.0 if rng.random() < augmentation.flip else 1.0
    room = np.maximum(0.1 * _extent(photo), _extent(photo) - scale * _extent(size))
    centre = rng.uniform(-0.5, 0.5, 2) * room
    jitter = rng.uniform(-1, 1, (4, 2)) * augmentation.perspective
    strength = augmentation.illumination
    return View(
        _tilt(jitter, size) @ _similarity(centre, scale, turn, mirror),
        gamma=float(np.exp(rng.normal(0, strength))),
        contrast=float(np.exp(rng.normal(0, 0.6 * strength))),
        brightness=float(rng.normal(0, 50 * strength)),
        colour=tuple(np.exp(rng.normal(0, 0.25 * strength, 3)).tolist()),
    )


def render(
    photo: NDArray[np.uint8], view: View, size: Size, crop: NDArray[np.float64] | None = None
) -> NDArray[np.uint8]:
    """Render a view.

    Args:
        photo: (H, W, 3) RGB.
        size: width and height of the view.
        crop: a further homography applied to the photo first (a pseudo-scene's view).

    Returns:
        (height, width, 3) RGB.
    """
    width, height = size
    homography = view.homography if crop is None else view.homography @ crop
    matrix = _to_pixels(size) @ homography @ np.linalg.inv(_to_pixels(photo.shape[1::-1]))
    # Warping alone would alias where the view is smaller than what it shows.
    shrink = 1 / np.sqrt(abs(np.linalg.det(matrix[:2, :2] / matrix[2, 2])))
    source = cv2.GaussianBlur(photo, (0, 0), 0.45 * shrink) if shrink > 1.3 else photo
    warped = cv2.warpPerspective(
        source,
        matrix,
        (width, height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    return _illuminate(warped.astype(np.float32), view)


def _illuminate(pixels: NDArray[np.floating], view: View) -> NDArray[np.uint8]:
    if view.gamma != 1.0:
        pixels = 255 * (pixels / 255) ** np.float32(view.gamma)
    mean = pixels.mean()
    pixels = (pixels - mean) * np.float32(view.contrast) + mean + np.float32(view.brightness)
    pixels = pixels * np.asarray(view.colour, np.float32)
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class PseudoOptions:
    """How pseudo-scenes are cut from single photos.

    Attributes:
        views: views cut from each photo; 0 makes no pseudo-scenes.
        scale: the share of the photo's longer side that a view's longer side covers.
        seed: of the cuts.
    """

    views: int = 0
    scale: tuple[float, float] = (0.4, 0.7)
    seed: int = 0


GRID = 64
"""Points along a photo's longer side that stand for 3D points in a pseudo-scene."""


def pseudo_scene(scene: Scene, image: int, photo: Size, options: PseudoOptions) -> Scene:
    """Cut views of known overlap from one photo, as a scene of its own.

    The points of a grid on the photo play the 3D points: GS (eq. 4) of two views is the number of
    grid points that both show.

    Args:
        photo: width and height of the photo, in any unit.
    """
    name = scene.names[image]
    rng = np.random.default_rng([options.seed, zlib.crc32(f"{scene.name}/{name}".encode())])
    cut = Augmentation(scale=options.scale, perspective=0.05, illumination=0.0)
    crops = np.stack([draw_view(rng, photo, photo, cut).homography for _ in range(options.views)])
    wide, high = _extent(photo)
    xs = (np.arange(round(GRID * wide)) + 0.5) / GRID - wide / 2
    ys = (np.arange(max(round(GRID * high), 1)) + 0.5) / GRID - high / 2
    grid = np.stack([a.ravel() for a in np.meshgrid(xs, ys)], axis=1)
    shown = [visible(crop, grid, photo) for crop in crops]
    first = np.cumsum([0, *(inside.sum() for inside, _ in shown)])
    points = np.concatenate([np.flatnonzero(inside) for inside, _ in shown])
    at = np.concatenate([moved[inside] for inside, moved in shown])
    seen = Observations(first, points.astype(np.int32), at.astype(np.float32))
    table = common_points(seen, len(grid))
    return Scene(
        name=f"{scene.name}/{name}",
        images=scene.images,
        names=(name,) * options.views,
        common_points=table,
        matches=table,
        sizes=np.tile(np.asarray(photo, np.int32), (options.views, 1)),
        model=np.zeros(options.views, np.int32),
        poses=np.full((options.views, 7), np.nan),
        points=len(np.unique(points)),
        method="pseudo",
        observations=seen,
        crops=crops,
        cut_from=scene.name,
    )


def visible(
    homography: NDArray[np.float64], positions: NDArray[np.floating], size: Size
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which positions (M, 2) of a photo a view of `size` shows, and where (M, 2)."""
    moved = np.c_[positions, np.ones(len(positions))] @ homography.T
    at = moved[:, :2] / moved[:, 2:]
    inside = (np.abs(at) <= _extent(size) / 2).all(1) & (moved[:, 2] > 0)
    return inside, at


def _similarity(
    centre: NDArray[np.float64], scale: float, turn: float, mirror: float
) -> NDArray[np.float64]:
    """Move `centre` to the origin, turn, mirror, and magnify by 1 / scale."""
    cos, sin = np.cos(turn) / scale, np.sin(turn) / scale
    move = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, 1]])
    spin = np.array([[mirror * cos, -mirror * sin, 0], [sin, cos, 0], [0, 0, 1]])
    return spin @ move


def _tilt(jitter: NDArray[np.float64], size: Size) -> NDArray[np.float64]:
    """Return the homography that shifts the view's corners by `jitter` of its sides."""
    extent = _extent(size)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * extent
    moved = corners + jitter * extent
    tilt = cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32))
    return np.asarray(tilt, np.float64)


def _extent(size: Sequence[int]) -> NDArray[np.float64]:
    return np.asarray(size, np.float64) / max(size)


def _to_pixels(size: Sequence[int]) -> NDArray[np.float64]:
    """Coordinates -> pixel positions as cv2 counts them (centre of the first pixel is 0)."""
    width, height = size[0], size[1]
    unit = max(width, height)
    return np.array([[unit, 0, width / 2 - 0.5], [0, unit, height / 2 - 0.5], [0, 0, 1.0]])
