"""A sparse model as arrays: read once, photo by photo, so that large models fit into memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

Floats = NDArray[np.float64]

REGIONS = (12, 9)
"""Columns and rows in which a photo's reprojection errors are gathered."""

ERROR_BINS = np.linspace(0, 4, 41)
"""Edges of the histogram of reprojection errors, px: COLMAP drops observations beyond 4."""


@dataclass(eq=False)
class CameraErrors:
    """Reprojection errors of one camera's photos by image region.

    Attributes:
        count: (rows, columns) observations.
        vectors: (rows, columns, 2) sum of (keypoint - projection), px.
        lengths: (rows, columns) sum of its length, px.
    """

    count: Floats
    vectors: Floats
    lengths: Floats


@dataclass(frozen=True, eq=False)
class ModelData:
    """What a report reads of a model; images in the order of their names.

    Attributes:
        names: N registered images.
        ids: (N) COLMAP's image ids.
        cameras: (N) COLMAP's camera ids.
        centres: (N, 3) camera centres.
        rotations: (N, 3, 3) camera from world.
        keypoints: (N) features of each image.
        observations: (N) of them see a 3D point.
        errors: (N) mean reprojection error of an image, px; NaN without observations.
        depths: (N) median distance of an image's points along its viewing direction; NaN where
            it sees none.
        reaches: (N) distance within which an image has 95 % of its points; NaN likewise.
        points: (P, 3) 3D points.
        point_ids: (P) COLMAP's ids of them, ascending.
        colours: (P, 3) uint8 RGB.
        track_lengths: (P) images that see a point.
        point_errors: (P) mean reprojection error of a point's observations, px.
        seen_points: (M) points, image after image: image i's are
            `seen_points[starts[i]:starts[i + 1]]`.
        starts: (N + 1) see above.
        histogram: (len(ERROR_BINS)) observations by reprojection error; the last are beyond.
        regions: errors by image region, by camera id.
    """

    names: tuple[str, ...]
    ids: NDArray[np.int64]
    cameras: NDArray[np.int64]
    centres: Floats
    rotations: Floats
    keypoints: NDArray[np.int64]
    observations: NDArray[np.int64]
    errors: Floats
    depths: Floats
    reaches: Floats
    points: Floats
    point_ids: NDArray[np.int64]
    colours: NDArray[np.uint8]
    track_lengths: NDArray[np.int64]
    point_errors: Floats
    seen_points: NDArray[np.int32]
    starts: NDArray[np.int64]
    histogram: NDArray[np.int64]
    regions: dict[int, CameraErrors]

    @property
    def mean_error(self) -> float:
        """Mean reprojection error as COLMAP gives it, px: over points, not over observations.

        NaN without points.
        """
        return float(np.nanmean(self.point_errors)) if len(self.points) else float("nan")

    @property
    def observation_error(self) -> float:
        """Mean reprojection error of all observations, px; NaN without any."""
        seen = self.observations > 0
        total = int(self.observations.sum())
        return float((self.errors * self.observations)[seen].sum() / total) if total else np.nan

    @property
    def mean_track_length(self) -> float:
        """Images that see a point, on average; NaN without points."""
        return float(self.track_lengths.mean()) if len(self.track_lengths) else float("nan")


def read_model_data(model: pycolmap.Reconstruction) -> ModelData:
    """Read a model's arrays and compute its reprojection errors."""
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    listed = sorted(model.points3D.items())
    points = np.array([point.xyz for _, point in listed]).reshape(-1, 3)
    ids = np.array([point_id for point_id, _ in listed], np.int64)
    regions: dict[int, CameraErrors] = {}
    histogram = np.zeros(len(ERROR_BINS), np.int64)
    point_sums = np.zeros(len(points))
    observations, errors, depths, reaches, seen = [], [], [], [], []
    for image in images:
        camera = model.cameras[image.camera_id]
        observed = image.get_observation_points2D()
        pixels = np.array([o.xy for o in observed]).reshape(-1, 2)
        index = np.searchsorted(ids, [o.point3D_id for o in observed])
        local = _into_camera(image, points[index])
        offsets = pixels - camera.img_from_cam(local, check_cheirality=False)
        length = np.linalg.norm(offsets, axis=1)
        whole = np.isfinite(length)
        np.add.at(point_sums, index, length)
        observations.append(len(observed))
        errors.append(float(length[whole].mean()) if whole.any() else np.nan)
        depths.append(float(np.median(local[:, 2])) if len(local) else np.nan)
        away = np.linalg.norm(local, axis=1)
        reaches.append(float(np.percentile(away, 95)) if len(local) else np.nan)
        seen.append(index.astype(np.int32))
        bins = np.digitize(length[whole], ERROR_BINS) - 1
        histogram += np.bincount(bins, minlength=len(ERROR_BINS))
        _gather(regions, camera, pixels[whole], offsets[whole], length[whole])
    track_lengths = np.array([point.track.length() for _, point in listed], np.int64)
    return ModelData(
        names=tuple(image.name for image in images),
        ids=np.array([image.image_id for image in images], np.int64),
        cameras=np.array([image.camera_id for image in images], np.int64),
        centres=np.array([image.projection_center() for image in images]).reshape(-1, 3),
        rotations=np.array([image.cam_from_world().rotation.matrix() for image in images]).reshape(
            -1, 3, 3
        ),
        keypoints=np.array([image.num_points2D() for image in images], np.int64),
        observations=np.array(observations, np.int64),
        errors=np.array(errors),
        depths=np.array(depths),
        reaches=np.array(reaches),
        points=points,
        point_ids=ids,
        colours=np.array([point.color for _, point in listed], np.uint8).reshape(-1, 3),
        track_lengths=track_lengths,
        point_errors=point_sums / np.maximum(track_lengths, 1),
        seen_points=np.concatenate([*seen, np.zeros(0, np.int32)]),
        starts=np.concatenate([[0], np.cumsum(observations)]).astype(np.int64),
        histogram=histogram,
        regions=regions,
    )


def _into_camera(image: pycolmap.Image, points: Floats) -> Floats:
    pose = image.cam_from_world().matrix()
    return np.asarray(points @ pose[:, :3].T + pose[:, 3])


def _gather(
    regions: dict[int, CameraErrors],
    camera: pycolmap.Camera,
    pixels: Floats,
    offsets: Floats,
    lengths: Floats,
) -> None:
    columns, rows = REGIONS
    if camera.camera_id not in regions:
        empty = np.zeros((rows, columns))
        regions[camera.camera_id] = CameraErrors(empty, np.zeros((rows, columns, 2)), empty.copy())
    sums = regions[camera.camera_id]
    column = np.clip((pixels[:, 0] / camera.width * columns).astype(int), 0, columns - 1)
    row = np.clip((pixels[:, 1] / camera.height * rows).astype(int), 0, rows - 1)
    np.add.at(sums.count, (row, column), 1)
    np.add.at(sums.lengths, (row, column), lengths)
    np.add.at(sums.vectors, (row, column), offsets)
