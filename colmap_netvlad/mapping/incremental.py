"""COLMAP's incremental mapping: matches -> sparse models."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.mapping.options import MappingOptions, pipeline_options
from colmap_netvlad.mapping.output import Finish, as_mapped, largest_first, model_folder
from colmap_netvlad.mapping.priors import with_priors
from colmap_netvlad.mapping.settle import settle
from colmap_netvlad.runtime import progress


def map_incremental(
    database: Path,
    images: Path | None,
    output: Path,
    options: MappingOptions = MappingOptions(),
    finish: Finish = as_mapped,
) -> list[pycolmap.Reconstruction]:
    """Reconstruct the matched images and write `output`/0, 1, ..., the largest first.

    Args:
        database: COLMAP database with verified matches.
        images: photo folder, for the colours of points; None leaves them black.
        output: folder of the models; it appears whole, or not at all on a fault or Ctrl-C.
        options: seed and limits.
        finish: is called with the folder of the models before it gets its name.

    Returns:
        The models, the largest first; empty where nothing could be reconstructed.

    Raises:
        InputError: `output` holds something already, or cannot be written.
    """
    with open_database(database) as colmap:
        total = len(colmap.keypoint_counts())
    with model_folder(output) as folder:
        register(database, images, folder, total, options)
        models = largest_first(folder)
        finish(folder)
    return models


def register(
    database: Path,
    images: Path | None,
    folder: Path,
    total: int,
    options: MappingOptions,
    model: Path | None = None,
) -> None:
    """Let COLMAP register images into `folder`/0, 1, ..., and adjust once more with positions.

    Args:
        total: images that may be registered, for the progress bar.
        model: folder of the model to continue, into `folder`/0; None: begin anew.
    """
    pipeline = pipeline_options(options, colors=images is not None)
    target = folder
    if model is not None:
        # Continuing a model, COLMAP writes straight into its output folder.
        pipeline.multiple_models, target = False, folder / "0"
        target.mkdir()
    with with_priors(database, options.priors, folder.parent) as source:
        with progress.step("Registering images", total) as bar:
            engine.call(
                pycolmap.incremental_mapping,
                folder,
                source,
                images or folder,
                target,
                options=pipeline,
                input_path=model or "",
                initial_image_pair_callback=lambda: bar.advance(2),
                next_image_callback=bar.advance,
            )
        settle(source, folder, options)
