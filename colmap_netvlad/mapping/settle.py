"""A last adjustment of models with positions, in which wrong matches have little say.

COLMAP's global bundle adjustment squares every reprojection error. The few wrong matches that pass
its filter of 4 px then outweigh a position: over flat ground, where a shift and a tilt look alike,
they pull single cameras many of RTK's standard deviations away, and the robust loss on positions
lets them go. With a robust loss on reprojection errors too, a position has its due say, and a wild
one still has little.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.mapping.options import MappingOptions, pipeline_options
from colmap_netvlad.mapping.output import numbered
from colmap_netvlad.mapping.priors import with_priors
from colmap_netvlad.mapping.refine import adjust_robustly, load_cache
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.errors import InputError


def settle(database: Path, folder: Path, options: MappingOptions) -> None:
    """Adjust the models that were just mapped with positions, in place; do nothing without.

    It runs in a worker, so that Ctrl-C ends it at once.

    Args:
        database: COLMAP database that the models were mapped from.
        folder: of models 0, 1, ..., in the frame of the positions.
        options: threads, and the positions.

    Raises:
        InputError: the worker failed.
    """
    models = numbered(folder)
    if options.priors is None or not models:
        return
    with progress.step("Adjusting with positions", len(models)) as bar:
        job = workers.Job(settle_models, (database, folder, models, options))
        (outcome,) = workers.run([job], 1, bar.advance, initialiser=engine.initialiser())
    if outcome.fault is not None:
        raise InputError(
            f"The photos were mapped, but the last adjustment failed: {outcome.fault}."
        )


def settle_models(
    advance: Callable[[int], None],
    database: Path,
    folder: Path,
    models: list[Path],
    options: MappingOptions,
) -> None:
    """Adjust models and write them again (in a worker)."""
    with with_priors(database, options.priors, folder) as source:
        cache = load_cache(source)
    pipeline = pipeline_options(options, colors=False)
    for path in models:
        model = pycolmap.Reconstruction(path)
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(model)
        # Convex, so that nothing is lost by where it starts; COLMAP's own for local adjustments.
        adjust_robustly(mapper, pipeline, pycolmap.LossFunctionType.SOFT_L1)
        mapper.filter_points(pipeline.get_mapper())
        mapper.end_reconstruction(False)
        model.update_point_3d_errors()
        model.write(path)
        advance(1)
