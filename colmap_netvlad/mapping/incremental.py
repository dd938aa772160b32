"""COLMAP's incremental mapping: matches -> sparse models."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import Finish, as_mapped, model_folder
from colmap_netvlad.mapping.priors import LOSS_SCALE, with_priors
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.machine import usable_processors


def map_incremental(
    database: Path,
    images: Path | None,
    output: Path,
    options: MappingOptions = MappingOptions(),
    finish: Finish = as_mapped,
) -> list[pycolmap.Reconstruction]:
    """Reconstruct the matched images and write `output`/0, 1, ... as COLMAP does.

    Args:
        database: COLMAP database with verified matches.
        images: photo folder, for the colours of points; None leaves them black.
        output: folder of the models; it appears whole, or not at all on a fault or Ctrl-C.
        options: seed and limits.
        finish: is called with the folder of the models before it gets its name.

    Returns:
        The models in COLMAP's order; empty where nothing could be reconstructed.

    Raises:
        InputError: `output` holds something already, or cannot be written.
    """
    with open_database(database) as colmap:
        total = len(colmap.keypoint_counts())
    with (
        model_folder(output) as folder,
        with_priors(database, options.priors, folder.parent) as source,
        progress.step("Registering images", total) as bar,
    ):
        models = engine.call(
            pycolmap.incremental_mapping,
            folder,
            source,
            images or folder,
            folder,
            options=pipeline_options(options, colors=images is not None),
            initial_image_pair_callback=lambda: bar.advance(2),
            next_image_callback=bar.advance,
        )
        finish(folder)
    return [models[index] for index in sorted(models)]


def pipeline_options(
    options: MappingOptions, *, colors: bool
) -> pycolmap.IncrementalPipelineOptions:
    """Return COLMAP's options of incremental mapping, every seed set."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.min_model_size = options.min_model_size
    pipeline.max_num_models = options.max_models
    pipeline.extract_colors = colors
    pipeline.random_seed = options.seed
    pipeline.mapper.random_seed = options.seed
    pipeline.triangulation.random_seed = options.seed
    if options.priors is not None:
        pipeline.use_prior_position = True
        pipeline.use_robust_loss_on_prior_position = True
        pipeline.prior_position_loss_scale = LOSS_SCALE
    pipeline.num_threads = pipeline.mapper.num_threads = options.threads or usable_processors()
    return pipeline
