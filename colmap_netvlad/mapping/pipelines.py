"""COLMAP's hierarchical and global mapping, and the automatic choice of a mapper."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions, pipeline_options
from colmap_netvlad.mapping.output import Finish, as_mapped, largest_first, model_folder
from colmap_netvlad.mapping.parallel import CLUSTER_IMAGES, map_parallel
from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.machine import usable_processors

logger = logging.getLogger(__name__)

PARALLEL_IMAGES = 500
"""From this many images with features on, parallel mapping is chosen (measured, see
docs/parallel-sfm.md)."""

OVERLAP_SHARE = 0.1
"""Images that COLMAP's neighbouring clusters share, of a cluster: its default, 50 of 500."""


def map_automatic(
    database: Path,
    images: Path | None,
    output: Path,
    options: MappingOptions = MappingOptions(),
    finish: Finish = as_mapped,
) -> list[pycolmap.Reconstruction]:
    """Map incrementally below `PARALLEL_IMAGES` images, in parallel from there on."""
    with open_database(database) as opened:
        count = len(opened.keypoint_counts())
    mapper = map_parallel if count >= PARALLEL_IMAGES else map_incremental
    return mapper(database, images, output, options, finish)


@dataclass(frozen=True)
class _Request:
    """What a mapper in a worker is to map; `images` None leaves points black."""

    database: Path
    images: Path | None
    options: MappingOptions


def run_hierarchical(advance: Callable[[int], None], request: _Request, folder: Path) -> None:
    """Run COLMAP's hierarchical mapper (in a worker) and write models `folder`/0, 1, ..."""
    options, images = request.options, request.images
    size = options.cluster_size or CLUSTER_IMAGES
    pipeline = pycolmap.HierarchicalPipelineOptions()
    pipeline.incremental_options = pipeline_options(options, colors=images is not None)
    pipeline.clustering_options.leaf_max_num_images = size
    pipeline.clustering_options.image_overlap = max(3, math.ceil(OVERLAP_SHARE * size))
    pipeline.num_threads = options.threads or usable_processors()
    _write(
        pycolmap.hierarchical_mapping(request.database, images or folder, folder, options=pipeline),
        folder,
    )


def run_global(advance: Callable[[int], None], request: _Request, folder: Path) -> None:
    """Run COLMAP's global mapper (in a worker) and write models `folder`/0, 1, ..."""
    options = request.options
    pipeline = pycolmap.GlobalPipelineOptions()
    pipeline.random_seed = options.seed
    with open_database(request.database) as database:
        pipeline.min_model_size = options.least_images(len(database.keypoint_counts()))
    pipeline.num_threads = options.threads or usable_processors()
    images = request.images or folder
    _write(pycolmap.global_mapping(request.database, images, folder, options=pipeline), folder)


def _map(
    how: str,
    function: Callable[..., None],
    database: Path,
    images: Path | None,
    output: Path,
    options: MappingOptions = MappingOptions(),
    finish: Finish = as_mapped,
) -> list[pycolmap.Reconstruction]:
    """Run a mapper that cannot be cancelled in a worker, which Ctrl-C ends."""
    with model_folder(output) as folder:
        logger.info("Mapping %s; COLMAP tells no progress of this mapper.", how)
        job = workers.Job(function, (_Request(database, images, options), folder))
        (outcome,) = workers.run([job], 1, lambda count: None, initialiser=engine.initialiser())
        if outcome.fault is not None:
            raise InputError(f"COLMAP could not map {how}: {outcome.fault}.")
        models = largest_first(folder)
        finish(folder)
        return models


def _write(models: dict[int, pycolmap.Reconstruction], folder: Path) -> None:
    """Write the models that COLMAP has not written itself."""
    for index, model in models.items():
        target = folder / str(index)
        if not target.exists():
            target.mkdir()
            model.write(target)


map_hierarchical = partial(_map, "hierarchically", run_hierarchical)
"""COLMAP's hierarchical mapper (see `incremental.map_incremental`)."""

map_global = partial(_map, "globally", run_global)
"""COLMAP's global mapper, GLOMAP (see `incremental.map_incremental`)."""
