"""A last adjustment of models with positions, in which wrong matches have little say.

COLMAP's global bundle adjustment squares every reprojection error. The few wrong matches that pass
its filter of 4 px then outweigh a position: over flat ground, where a shift and a tilt look alike,
they pull single cameras many of RTK's standard deviations away, and the robust loss on positions
lets them go. With a robust loss on reprojection errors too, a position has its due say, and a wild
one still has little.

That adjustment ends where gradients are small, as those of positions good to metres always are. No
similarity changes a reprojection error, so the one that suits the positions best is found apart.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from colmap_netvlad.colmap import engine
from colmap_netvlad.mapping.options import MappingOptions, pipeline_options
from colmap_netvlad.mapping.output import numbered
from colmap_netvlad.mapping.priors import LOSS_SCALE, PositionPriors
from colmap_netvlad.mapping.refine import adjust_robustly, load_cache
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.errors import InputError

MIN_POSITIONS = 3
"""Positions that a similarity needs."""

Floats = NDArray[np.float64]


def settle(database: Path, folder: Path, options: MappingOptions) -> None:
    """Adjust the models that were just mapped with positions, in place; do nothing without.

    It runs in a worker, so that Ctrl-C ends it at once.

    Args:
        database: that the models were mapped from, with the positions (`priors.with_priors`).
        folder: of models 0, 1, ..., in the frame of the positions.
        options: threads, and the positions.

    Raises:
        InputError: the worker failed.
    """
    models = numbered(folder)
    if options.priors is None or not models:
        return
    with progress.step("Adjusting with positions", len(models)) as bar:
        job = workers.Job(settle_models, (database, models, options))
        (outcome,) = workers.run([job], 1, bar.advance, initialiser=engine.initialiser())
    if outcome.fault is not None:
        raise InputError(
            f"The photos were mapped, but the last adjustment failed: {outcome.fault}."
        )


def settle_models(
    advance: Callable[[int], None], database: Path, models: list[Path], options: MappingOptions
) -> None:
    """Adjust models and write them again (in a worker)."""
    cache = load_cache(database)
    for path in models:
        model = pycolmap.Reconstruction(path)
        settle_model(model, cache, options)
        model.write(path)
        advance(1)


def settle_model(
    model: pycolmap.Reconstruction, cache: pycolmap.DatabaseCache, options: MappingOptions
) -> None:
    """Adjust one model, in place; do nothing without positions."""
    if options.priors is None:
        return
    pipeline = pipeline_options(options, colors=False)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    # Convex, so that nothing is lost by where it starts; COLMAP's own for local adjustments.
    adjust_robustly(mapper, pipeline, pycolmap.LossFunctionType.SOFT_L1)
    mapper.filter_points(pipeline.get_mapper())
    mapper.end_reconstruction(False)
    model.transform(best_similarity(model, options.priors))
    model.update_point_3d_errors()


def best_similarity(model: pycolmap.Reconstruction, priors: PositionPriors) -> pycolmap.Sim3d:
    """Return the similarity with the least cost of the positions, for a model that lies nearly so.

    The cost is the adjustment's own: by standard deviations, with Cauchy's loss.
    """
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    rows = [
        row
        for row, (name, place) in enumerate(zip(priors.names, priors.metres, strict=True))
        if name in images and np.isfinite(place[:2]).all()
    ]
    if len(rows) < MIN_POSITIONS:
        return pycolmap.Sim3d()
    centres = np.array([images[priors.names[row]].projection_center() for row in rows])
    places = np.nan_to_num(priors.metres[rows])
    weights = np.isfinite(priors.metres[rows]) / priors.deviations[rows]
    middle = centres.mean(axis=0)
    size = np.sqrt(((centres - middle) ** 2).sum(axis=1).mean())

    def similarity(values: Floats) -> pycolmap.Sim3d:
        turn = np.exp(values[0] / size) * Rotation.from_rotvec(values[1:4] / size).as_matrix()
        return pycolmap.Sim3d(np.column_stack([turn, middle - turn @ middle + values[4:]]))

    def misfits(values: Floats) -> Floats:
        matrix = similarity(values).matrix()
        misfit = (centres @ matrix[:, :3].T + matrix[:, 3] - places) * weights
        square = (misfit**2).sum(axis=1, keepdims=True) / LOSS_SCALE**2 + 1e-12  # not 0 / 0
        robust: Floats = (misfit * np.sqrt(np.log1p(square) / square)).ravel()
        return robust

    return similarity(least_squares(misfits, np.zeros(7), x_scale="jac").x)
