"""What every mapper is told."""

from __future__ import annotations

from dataclasses import dataclass

import pycolmap

from colmap_netvlad.mapping.priors import LOSS_SCALE, PositionPriors
from colmap_netvlad.runtime.machine import usable_processors

SHARE_OF_SMALL = 0.8
"""Of a flight of few images a model may have this share, where that is below `min_model_size`."""


@dataclass(frozen=True)
class MappingOptions:
    """Options that all mappers share; the rest is COLMAP's default.

    Attributes:
        seed: seed of every random choice.
        min_model_size: smaller models are dropped, images (COLMAP's `min_model_size`).
        max_models: most models that are tried (COLMAP's `max_num_models`).
        threads: threads; None: all processors. Above 50,000 residuals COLMAP's bundle adjustment
            adds in the order its threads finish, so only one thread gives the same last digits
            twice.
        cluster_size: images of a cluster of `parallel` and `hierarchical` before it is expanded
            for overlap; None: a measured default.
        memory: bytes that the workers of `parallel` may take together; None: a share of the
            machine's.
        priors: known positions, which are part of every bundle adjustment, robustly; the model
            is then in their frame. Incremental and parallel mapping take them.
    """

    seed: int = 0
    min_model_size: int = 10
    max_models: int = 50
    threads: int | None = None
    cluster_size: int | None = None
    memory: float | None = None
    priors: PositionPriors | None = None

    def least_images(self, images: int) -> int:
        """Return the images of the smallest model that is kept of so many, as COLMAP counts."""
        return min(self.min_model_size, max(2, int(SHARE_OF_SMALL * images)))


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
