"""Register further images into an existing model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap.database import feature_counts
from colmap_netvlad.graph.verified import mapped_names
from colmap_netvlad.mapping.incremental import register
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import Finish, as_mapped, model_folder, numbered
from colmap_netvlad.mapping.summary import registered_names, strangers
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.sequences import listed


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model (`cameras.bin`, `images.bin`, `points3D.bin`, or the same as text).

    Raises:
        InputError: there is none.
    """
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as fault:
        raise InputError(
            f"{folder} is not a COLMAP model (cameras, images, points3D); name one with `sparse`."
        ) from fault


def read_models(output: Path) -> list[pycolmap.Reconstruction]:
    """Read the models of a folder of models, in the order of their numbers.

    Raises:
        InputError: one of them cannot be read.
    """
    return [read_model(folder) for folder in numbered(output)]


def largest_model(folders: Sequence[Path]) -> Path:
    """Return the folder of the model with the most registered images, the first of equal ones.

    Raises:
        InputError: one of them holds no model.
    """
    if len(folders) == 1:
        return folders[0]
    return max(folders, key=lambda folder: read_model(folder).num_reg_images())


def check_origin(project: Project, folder: Path, model: pycolmap.Reconstruction) -> None:
    """Make sure that the model is of the database's features and matches: COLMAP would stop, when
    the new photos are matched already.

    Args:
        folder: where the model is.

    Raises:
        InputError: it is of other photos, features or matches.
    """
    database = project.database
    absent, others = strangers(model, feature_counts(database))
    if absent:
        raise InputError(
            f"{folder} has photos that {database} does not have ({listed(absent)}): it is another "
            "project's; name another model with `sparse`, or the `database` it was made from."
        )
    if others:
        raise InputError(
            f"{folder} was made of other features than those in {database} (of {listed(others)}); "
            "name another model with `sparse`, or the `database` it was made from."
        )
    bare = registered_names([model]) - mapped_names(database)
    if not bare:
        return
    if project.copy.is_file() and bare <= mapped_names(project.copy):
        mend = f"its matches are in {project.copy}; name that as `database`"
    else:
        mend = "match them (`colmap-netvlad pairs`, then `match`), or name the `database` it is of"
    raise InputError(
        f"{database} has no verified pair of photos of {folder} ({listed(sorted(bare))}), without "
        f"which COLMAP cannot extend it: {mend}."
    )


def extend_model(
    database: Path,
    images: Path | None,
    model: Path,
    output: Path,
    candidates: int,
    options: MappingOptions = MappingOptions(),
    finish: Finish = as_mapped,
) -> pycolmap.Reconstruction:
    """Continue incremental mapping from a model: register what the database's matches allow.

    The model itself is left as it is; the extended one is written to `output`/0.

    Args:
        database: COLMAP database with the new images' verified matches.
        images: photo folder, for the colours of points; None leaves new points black.
        model: folder of the existing model.
        output: folder of models; it appears whole or not at all.
        candidates: images that may be registered, for the progress bar.
        options: seed, threads, and positions in the model's frame where it was adjusted with such.
        finish: is called with the folder of models before it gets its name.

    Raises:
        InputError: no model there, or `output` holds something already.
    """
    read_model(model)
    with model_folder(output) as folder:
        register(database, images, folder, candidates, options, model)
        result = pycolmap.Reconstruction(folder / "0")
        finish(folder)
    return result
