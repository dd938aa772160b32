"""Join sub-models that share images into one model, in arrays.

Two sub-models share a 3D point where both have a track through the same observation: the same
keypoint of the same image. Sub-models are joined in the order of shared 3D points (section 2.2
of the paper), each by the similarity that brings its shared points to those joined before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

MIN_SHARED_POINTS = 20
"""Fewer shared 3D points than this do not carry a similarity transform."""

REFINEMENTS = 3
"""Least squares over the points that agree, after a sample was found that they agree with."""

MIN_INLIER_SHARE = 0.3
"""At least this share of the shared points must agree, or the sub-model is an outlier."""

MAX_PIXELS = 12.0
"""Shared points agree within this many pixels, as seen from the cameras: COLMAP's default error
of a registered image."""

MIN_SPREAD = 1e-3
"""Second over first singular value of the shared points: below, they lie on one line."""


@dataclass
class SubModel:
    """A model as arrays, growing as others are joined to it.

    Attributes:
        name: how reports call it.
        poses: cam_from_world by image id.
        cameras: intrinsics by camera id, and by how many images they are supported.
        rigs: the rigs of the model by id.
        xyz: (P, 3) points.
        color: (P, 3) their colours, 0..255.
        keys: (M) observations, image id << 32 | keypoint index, sorted and unique.
        owner: (M) the row of `xyz` that each observation belongs to.
        pixel: median size of one pixel at the points, in the model's unit.
    """

    name: str
    poses: dict[int, pycolmap.Rigid3d]
    cameras: dict[int, tuple[NDArray[np.float64], int]]
    rigs: dict[int, pycolmap.Rig]
    xyz: NDArray[np.float64]
    color: NDArray[np.uint8]
    keys: NDArray[np.int64]
    owner: NDArray[np.int64]
    pixel: float


@dataclass
class Merged:
    """Sub-models joined into one, and those that did not fit.

    Attributes:
        model: the joined model.
        members: names of the sub-models in it, in the order of joining.
        refused: (name, reason) of sub-models that share points with it but do not fit.
    """

    model: SubModel
    members: list[str]
    refused: list[tuple[str, str]] = field(default_factory=list)


class Refused(Exception):
    """Two sub-models do not fit: the reason, as a phrase."""


def read_sub_model(name: str, reconstruction: pycolmap.Reconstruction) -> SubModel:
    """Take a reconstruction apart; one with neither points nor poses is fine."""
    images = {i: reconstruction.image(i) for i in reconstruction.reg_image_ids()}
    supported: dict[int, int] = {}
    for image in images.values():
        supported[image.camera_id] = supported.get(image.camera_id, 0) + 1
    xyz, color, keys, owner = [], [], [], []
    for row, point in enumerate(reconstruction.points3D.values()):
        xyz.append(point.xyz)
        color.append(point.color)
        for element in point.track.elements:
            keys.append(element.image_id << 32 | element.point2D_idx)
            owner.append(row)
    order = np.argsort(np.array(keys, np.int64))
    model = SubModel(
        name,
        poses={i: image.cam_from_world() for i, image in images.items()},
        cameras={
            camera_id: (np.array(reconstruction.camera(camera_id).params), count)
            for camera_id, count in supported.items()
        },
        rigs={rig_id: reconstruction.rig(rig_id) for rig_id in reconstruction.rigs},
        xyz=np.array(xyz, np.float64).reshape(-1, 3),
        color=np.array(color, np.uint8).reshape(-1, 3),
        keys=np.array(keys, np.int64)[order],
        owner=np.array(owner, np.int64)[order],
        pixel=1.0,
    )
    focal = {
        i: reconstruction.camera(image.camera_id).mean_focal_length() for i, image in images.items()
    }
    model.pixel = _pixel_size(model, focal)
    return model


def merge(sub_models: Sequence[SubModel], seed: int = 0) -> list[Merged]:
    """Join sub-models into as few models as fit together, largest first.

    The largest sub-model is the seed; the one that shares the most 3D points with what is
    joined comes next. A sub-model that is refused is tried again when more has been joined, and
    in the end becomes the seed of a model of its own.
    """
    waiting = sorted(sub_models, key=lambda sub: (-len(sub.poses), -len(sub.xyz), sub.name))
    models = []
    while waiting:
        base = waiting.pop(0)
        merged = Merged(base, [base.name])
        faults: dict[str, tuple[int, str]] = {}
        while waiting:
            shared = {sub.name: len(shared_points(merged.model, sub)) for sub in waiting}
            again = [
                sub
                for sub in waiting
                if shared[sub.name] and shared[sub.name] != faults.get(sub.name, (0, ""))[0]
            ]
            if not again:
                break
            best = max(again, key=lambda sub: shared[sub.name])
            try:
                merged.model = join(merged.model, best, seed)
            except Refused as refusal:
                faults[best.name] = shared[best.name], str(refusal)
                continue
            merged.members.append(best.name)
            waiting.remove(best)
        left = {sub.name for sub in waiting}
        merged.refused = [(name, why) for name, (_, why) in faults.items() if name in left]
        models.append(merged)
    return models


def shared_points(base: SubModel, other: SubModel) -> NDArray[np.int64]:
    """Return (S, 2) rows of points of `base` and `other` with a common observation.

    Each point of `other` stands once, beside the point with which it shares the most.
    """
    _, in_base, in_other = np.intersect1d(
        base.keys, other.keys, assume_unique=True, return_indices=True
    )
    pairs = np.stack([base.owner[in_base], other.owner[in_other]], axis=1)
    unique, counts = np.unique(pairs, axis=0, return_counts=True)
    unique = unique[np.lexsort((unique[:, 0], -counts, unique[:, 1]))]
    _, first = np.unique(unique[:, 1], return_index=True)
    return unique[first]


def similarity(
    base: SubModel, other: SubModel, pairs: NDArray[np.int64], seed: int = 0
) -> pycolmap.Sim3d:
    """Estimate robustly the similarity that brings shared points of `other` to `base`.

    Raises:
        Refused: too few points, points on one line, or too few that agree.
    """
    if len(pairs) < MIN_SHARED_POINTS:
        raise Refused(f"it shares only {len(pairs)} points, fewer than {MIN_SHARED_POINTS}")
    target, source = base.xyz[pairs[:, 0]], other.xyz[pairs[:, 1]]
    options = pycolmap.RANSACOptions(
        max_error=MAX_PIXELS * base.pixel, min_inlier_ratio=MIN_INLIER_SHARE, random_seed=seed
    )
    # A dictionary, whatever pycolmap's stubs say.
    found: Any = pycolmap.estimate_sim3d_robust(source, target, options)
    if found is None:
        raise Refused(f"no similarity agrees with its {len(pairs)} shared points")
    base_from_other: pycolmap.Sim3d = found["tgt_from_src"]
    inliers = agreeing(base, other, pairs, base_from_other)
    for _ in range(REFINEMENTS):
        # The sample that won lies anywhere within the tolerance; all that agree say it best.
        refined = pycolmap.estimate_sim3d(source[inliers], target[inliers])
        if refined is None:
            break
        base_from_other = refined
        inliers = agreeing(base, other, pairs, base_from_other)
    if inliers.mean() < MIN_INLIER_SHARE:
        raise Refused(f"only {inliers.mean():.0%} of its {len(pairs)} shared points agree")
    agreed = target[inliers]
    spread = np.linalg.svd(agreed - agreed.mean(axis=0), compute_uv=False)
    if inliers.sum() < MIN_SHARED_POINTS or spread[1] < MIN_SPREAD * spread[0]:
        raise Refused("the shared points that agree are too few or lie on one line")
    return base_from_other


def agreeing(
    base: SubModel, other: SubModel, pairs: NDArray[np.int64], base_from_other: pycolmap.Sim3d
) -> NDArray[np.bool_]:
    """Return which of the shared points lie within `MAX_PIXELS` of each other."""
    moved = move(base_from_other, other.xyz[pairs[:, 1]])
    distance = np.linalg.norm(moved - base.xyz[pairs[:, 0]], axis=1)
    return distance <= MAX_PIXELS * base.pixel


def join(base: SubModel, other: SubModel, seed: int = 0) -> SubModel:
    """Return `base` with `other` brought to it.

    Shared points that agree become one, with the observations of both tracks; an observation
    belongs to one point, and a point is seen once in an image, where `base` goes first. Images
    of both keep the pose in `base`; a camera of both gets the mean of its intrinsics, weighted
    by images.

    Raises:
        Refused: the sub-models do not fit.
    """
    pairs = shared_points(base, other)
    base_from_other = similarity(base, other, pairs, seed)
    agreed = pairs[agreeing(base, other, pairs, base_from_other)]

    row = np.arange(len(other.xyz)) + len(base.xyz)
    row[agreed[:, 1]] = agreed[:, 0]
    fresh = ~np.isin(other.keys, base.keys, assume_unique=True)
    keys = np.concatenate([base.keys, other.keys[fresh]])
    owner = np.concatenate([base.owner, row[other.owner[fresh]]])
    # The first of each (point, image) stays: those of `base` stand first.
    once = seen_once(keys, owner)
    keys, owner = keys[once], owner[once]

    xyz = np.concatenate([base.xyz, move(base_from_other, other.xyz)])
    color = np.concatenate([base.color, other.color])
    seen = np.bincount(owner, minlength=len(xyz))
    kept = seen >= 2
    held = kept[owner]
    keys, owner = keys[held], (np.cumsum(kept) - 1)[owner[held]]
    order = np.argsort(keys)
    poses = {i: base_from_other.transform_camera_world(pose) for i, pose in other.poses.items()}
    return SubModel(
        base.name,
        poses=poses | base.poses,
        cameras=join_cameras(base.cameras, other.cameras),
        rigs=other.rigs | base.rigs,
        xyz=xyz[kept],
        color=color[kept],
        keys=keys[order],
        owner=owner[order],
        pixel=base.pixel,
    )


def seen_once(keys: NDArray[np.int64], owner: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows, ascending, of the first observation of each point in each image.

    Args:
        keys: (M) observations, image id << 32 | keypoint index.
        owner: (M) the point that each belongs to, below 2**31.
    """
    # Point and image in one number: rows of two are sorted seven times slower.
    _, once = np.unique(owner.astype(np.int64) << 32 | keys >> 32, return_index=True)
    return np.sort(once)


def join_cameras(
    base: dict[int, tuple[NDArray[np.float64], int]],
    other: dict[int, tuple[NDArray[np.float64], int]],
) -> dict[int, tuple[NDArray[np.float64], int]]:
    """Return the cameras of both; one of both gets the mean of its intrinsics, by images."""
    joined = dict(base)
    for camera_id, (params, count) in other.items():
        if camera_id in base:
            mean, weight = base[camera_id]
            params = (mean * weight + params * count) / (weight + count)
            count += weight
        joined[camera_id] = params, count
    return joined


def move(similarity: pycolmap.Sim3d, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3) points moved by a similarity."""
    matrix = similarity.matrix()
    return xyz @ matrix[:, :3].T + matrix[:, 3]


def _pixel_size(model: SubModel, focal: dict[int, float]) -> float:
    if not len(model.keys):
        return 1.0
    image = model.keys >> 32
    ids = np.array(sorted(model.poses))
    pose = [model.poses[i].matrix() for i in ids.tolist()]
    centres = np.array([-matrix[:, :3].T @ matrix[:, 3] for matrix in pose])
    place = np.searchsorted(ids, image)
    depth = np.linalg.norm(model.xyz[model.owner] - centres[place], axis=1)
    return float(np.median(depth / np.array([focal[i] for i in ids.tolist()])[place]))
