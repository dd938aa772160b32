"""The figures of a model that users compare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap.database import feature_counts


@dataclass(frozen=True)
class ModelSummary:
    """Figures of one sparse model, or of several together.

    Attributes:
        registered: images with a pose.
        points: 3D points.
        mean_reprojection_error: COLMAP's figure, the mean over 3D points of a point's mean
            error over its track, px; nan without points.
        mean_track_length: observations of a point; nan without points.
        observations: image points that see a 3D point.
    """

    registered: int
    points: int
    mean_reprojection_error: float
    mean_track_length: float
    observations: int


def summarize(model: pycolmap.Reconstruction) -> ModelSummary:
    """Return the figures of one model."""
    points = model.num_points3D()
    if not points:
        return ModelSummary(model.num_reg_images(), 0, float("nan"), float("nan"), 0)
    model.update_point_3d_errors()
    return ModelSummary(
        registered=model.num_reg_images(),
        points=points,
        mean_reprojection_error=model.compute_mean_reprojection_error(),
        mean_track_length=model.compute_mean_track_length(),
        observations=model.compute_num_observations(),
    )


def registered_names(models: Sequence[pycolmap.Reconstruction]) -> set[str]:
    """Return the names of the images that have a pose in any of the models."""
    return {model.image(image_id).name for model in models for image_id in model.reg_image_ids()}


def strangers(
    model: pycolmap.Reconstruction, features: Mapping[str, int]
) -> tuple[list[str], list[str]]:
    """Return a model's images that a database does not have, and those of other features.

    Args:
        features: how many the database has of each of its images, by name.
    """
    images = sorted((image.name, image.num_points2D()) for image in model.images.values())
    absent = [name for name, _ in images if name not in features]
    return absent, [name for name, count in images if features.get(name, count) != count]


def of_database(model: pycolmap.Reconstruction, database: Path) -> bool:
    """Return whether a database has photos of a model, and those with as many features: another
    flight's photos may have the same names.

    Raises:
        InputError: the database cannot be read.
    """
    absent, others = strangers(model, feature_counts(database))
    return not others and len(absent) < model.num_images()


def put_aside(database: Path) -> str:
    """Say that a database beside a model is not the model's."""
    return (
        f"The database {database} is put aside: its photos have other features than the model's; "
        "name it as `database` to use it all the same."
    )


def combine(models: Sequence[pycolmap.Reconstruction]) -> ModelSummary:
    """Return the figures of several models together; an image in two of them counts once."""
    parts = [summary for summary in map(summarize, models) if summary.points]
    points = sum(part.points for part in parts)
    observations = sum(part.observations for part in parts)
    error = sum(part.mean_reprojection_error * part.points for part in parts)
    return ModelSummary(
        registered=len(registered_names(models)),
        points=points,
        mean_reprojection_error=error / points if points else float("nan"),
        mean_track_length=observations / points if points else float("nan"),
        observations=observations,
    )
