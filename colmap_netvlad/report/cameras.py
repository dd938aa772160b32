"""The cameras of a model: parameters before and after, how sure they are, what cannot be known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.colmap.database import InitialCamera
from colmap_netvlad.colmap.engine import silence
from colmap_netvlad.report.ground import Frame
from colmap_netvlad.report.modeldata import ModelData
from colmap_netvlad.runtime.files import scratch_folder

Floats = NDArray[np.float64]

COVARIANCE_IMAGES = 200
"""Images whose covariance is computed: its matrix is dense, 6 rows an image."""

LEVEL_VIEWS = 15.0
"""Views within this angle of their common direction, degrees, see the ground alike."""

LEVEL_HEIGHTS = 0.10
"""Spread of flying heights, and of the ground, below this share of the flying height is flat."""

UNSURE_FOCAL = 0.005
"""Standard deviation of a focal length over itself: from here on it is ill-determined."""

MOVED_FOCAL = 0.05
"""Change of a focal length over itself that is worth a look (5 %, as other software has it)."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a camera.

    Attributes:
        name: as COLMAP calls it (f, cx, k1, ...).
        initial: in the database; None where it is not known.
        adjusted: in the model.
        sigma: its standard deviation; None where it was not adjusted or not computed.
    """

    name: str
    initial: float | None
    adjusted: float
    sigma: float | None


@dataclass(frozen=True)
class CameraReport:
    """One camera of a model."""

    camera_id: int
    model: str
    width: int
    height: int
    images: int
    parameters: tuple[Parameter, ...]
    warnings: tuple[str, ...]


def camera_reports(
    model: pycolmap.Reconstruction,
    data: ModelData,
    frame: Frame,
    initial: Mapping[int, InitialCamera],
) -> list[CameraReport]:
    """Report each camera that took a registered image, those with most images first."""
    counts = Counter(data.cameras.tolist())
    sigmas = parameter_sigmas(model, data)
    ground = frame.move(data.points)[:, 2] if len(data.points) else np.zeros(1)
    relief, heights = _spread(ground), frame.move(data.centres)[:, 2]
    reports = []
    for camera_id in sorted(counts, key=lambda i: (-counts[i], i)):
        camera = model.cameras[camera_id]
        before = initial.get(camera_id)
        if before is not None and len(before.params) != len(camera.params):
            before = None  # another model: nothing to compare
        names = [name.strip() for name in camera.params_info.split(",")]
        spread = sigmas.get(camera_id)
        parameters = tuple(
            Parameter(
                name,
                None if before is None else before.params[i],
                float(camera.params[i]),
                None if spread is None or not np.isfinite(spread[i]) else float(spread[i]),
            )
            for i, name in enumerate(names)
        )
        own = data.cameras == camera_id
        depths = data.depths[own & np.isfinite(data.depths)]
        height = float(np.median(depths)) * frame.scale if len(depths) else 0.0
        level = _see_alike(data.rotations[own][:, 2], heights[own], relief, height)
        guessed = before is not None and not before.prior
        warnings = _warnings(parameters, level, guessed)
        reports.append(
            CameraReport(
                camera_id,
                camera.model_name,
                camera.width,
                camera.height,
                counts[camera_id],
                parameters,
                tuple(warnings),
            )
        )
    return reports


def parameter_sigmas(model: pycolmap.Reconstruction, data: ModelData) -> dict[int, Floats]:
    """Return the standard deviation of every camera parameter, by camera id.

    From COLMAP's covariance of the bundle adjustment, scaled by the residuals' variance; NaN
    where a parameter is held fixed. Above `COVARIANCE_IMAGES` images it is computed on those
    nearest to the middle of the flight alone, and so rather too large than too small.
    """
    if len(data.names) < 2 or not len(data.points):
        return {}
    part = _middle_part(model, data)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in part.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, part)
    silence()  # that a covariance cannot be computed is said on the page
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), part, adjuster)
    if covariance is None:
        return {}
    variance = _residual_variance(data)
    sigmas = {}
    for camera_id, camera in part.cameras.items():
        found = covariance.get_other_params_cov(camera.params)
        adjusted = [*camera.focal_length_idxs(), *camera.extra_params_idxs()]
        if found is None or len(found) != len(adjusted):
            continue
        sigma = np.full(len(camera.params), np.nan)
        with np.errstate(invalid="ignore"):
            sigma[sorted(adjusted)] = np.sqrt(np.diag(found) * variance)
        sigmas[camera_id] = sigma
    return sigmas


def _middle_part(model: pycolmap.Reconstruction, data: ModelData) -> pycolmap.Reconstruction:
    """Return the model, or a copy of the images nearest to its middle where it is large."""
    if model.num_images() == len(data.names) <= COVARIANCE_IMAGES:
        return model
    distance = np.linalg.norm(data.centres - np.median(data.centres, axis=0), axis=1)
    kept = set(data.ids[np.argsort(distance, kind="stable")[:COVARIANCE_IMAGES]].tolist())
    part = pycolmap.Reconstruction(model)
    keep = {part.image(image_id).frame_id for image_id in kept}
    for frame_id in list(part.reg_frame_ids()):
        if frame_id not in keep:
            part.deregister_frame(frame_id)
    # Written and read again, as COLMAP's covariance asks every frame for its pose.
    with scratch_folder() as folder:
        part.write(folder)
        return pycolmap.Reconstruction(folder)


def _residual_variance(data: ModelData) -> float:
    """Variance of one coordinate of a keypoint, px squared: from the mean error, as its length
    has a Rayleigh distribution."""
    return float((data.observation_error / np.sqrt(np.pi / 2)) ** 2)


def _see_alike(views: Floats, heights: Floats, relief: float, height: float) -> bool:
    """Whether all photos look the same way from one height on flat ground.

    Args:
        views: (K, 3) viewing directions, unit length.
        heights: (K) of the cameras.
        relief: spread of the ground, same unit.
        height: above ground, same unit.
    """
    mean = views.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    angles = np.degrees(np.arccos(np.clip(views @ mean, -1, 1)))
    flat = LEVEL_HEIGHTS * height
    return bool(
        np.percentile(angles, 90) < LEVEL_VIEWS and _spread(heights) < flat and relief < flat
    )


def _spread(values: Floats) -> float:
    return float(np.subtract(*np.percentile(values, [95, 5])))


def _warnings(parameters: tuple[Parameter, ...], level: bool, guessed: bool) -> list[str]:
    focal = parameters[0]
    warnings = []
    if level:
        warnings.append(
            "All photos look the same way from one height on flat ground: focal length and flying "
            "height, and distortion and a bowl-shaped ground, can hardly be told apart. Oblique "
            "photos, a second flight at another height, ground control, or a camera calibrated "
            "before would fix them."
        )
    elif focal.sigma is None:
        warnings.append(
            "How sure its parameters are could not be computed: the photos leave at least one of "
            "them undetermined (most often the focal length against the flying height), or it was "
            "held fixed."
        )
    if focal.sigma is not None and focal.sigma > UNSURE_FOCAL * focal.adjusted:
        warnings.append(
            f"The focal length is only known to {100 * focal.sigma / focal.adjusted:.1f} %: "
            "heights are as unsure. Keep it fixed at a calibrated value, or add oblique photos."
        )
    if focal.initial and abs(focal.adjusted / focal.initial - 1) > MOVED_FOCAL:
        guess = ", which was a guess (no EXIF)" if guessed else ""
        warnings.append(
            f"The focal length moved by {100 * (focal.adjusted / focal.initial - 1):+.1f} % from "
            f"the first value{guess}."
        )
    for parameter in parameters:
        if (
            parameter.name.startswith(("k", "p"))
            and parameter.sigma is not None
            and parameter.sigma > 0.1 * max(abs(parameter.adjusted), 0.01)
        ):
            warnings.append(
                f"Distortion {parameter.name} is ill-determined: {parameter.adjusted:+.4f} ± "
                f"{parameter.sigma:.4f}."
            )
    return warnings
