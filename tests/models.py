"""Made-up sparse models of any size, without photos."""

from __future__ import annotations

import numpy as np
import pycolmap

from colmap_netvlad.demo.simulate import FLYING_HEIGHT

DOWN = np.diag([1.0, -1.0, -1.0])
"""Camera from world of a camera that looks straight down, its top to the north."""


def grid_model(
    side: int,
    *,
    step: float = 20.0,
    points: int = 30,
    cameras: bool = False,
    names: tuple[str, ...] = (),
    noise: float = 0.3,
) -> pycolmap.Reconstruction:
    """A flight of `side` x `side` photos that look straight down on hilly ground.

    Args:
        step: distance of photos, m; the flying height is 100 m.
        points: 3D points a photo's square of ground has.
        cameras: a camera for every photo, instead of one for all.
        names: of the photos; default `0000.jpg`, ...
        noise: of a keypoint, px.
    """
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    centres = np.array(
        [(i * step, j * step, FLYING_HEIGHT) for j in range(side) for i in range(side)]
    )
    xy = rng.uniform(-step, side * step, (points * side * side, 2))
    ground = np.column_stack([xy, 6 * np.sin(xy[:, 0] / 30)])
    tracks: list[list[tuple[int, int]]] = [[] for _ in ground]
    camera = None
    for i, centre in enumerate(centres):
        if camera is None or cameras:
            camera = pycolmap.Camera.create_from_model_name(
                i + 1, "SIMPLE_RADIAL", 800.0, 1000, 750
            )
            model.add_camera_with_trivial_rig(camera)
        near = np.flatnonzero(np.abs(xy - centre[:2]).max(axis=1) < FLYING_HEIGHT)
        local = (ground[near] - centre) @ DOWN.T
        pixels = local[:, :2] / local[:, 2:] * 800 + [500, 375]
        pixels += rng.normal(0, noise, pixels.shape)
        inside = ((pixels > 0) & (pixels < [1000, 750])).all(axis=1)
        seen, pixels = near[inside], pixels[inside]
        image = pycolmap.Image(
            names[i] if names else f"{i:04d}.jpg", pixels, camera_id=camera.camera_id,
            image_id=i + 1,
        )  # fmt: skip
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(DOWN), -DOWN @ centre)
        model.add_image_with_trivial_frame(image, pose)
        for index, point in enumerate(seen.tolist()):
            tracks[point].append((i + 1, index))
    for xyz, track in zip(ground, tracks, strict=True):
        if len(track) >= 2:
            elements = [pycolmap.TrackElement(*element) for element in track]
            model.add_point3D(
                xyz, pycolmap.Track(elements), rng.integers(40, 200, 3).astype(np.uint8)
            )
    return model
