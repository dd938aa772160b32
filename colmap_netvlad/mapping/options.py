"""What every mapper is told."""

from __future__ import annotations

from dataclasses import dataclass

from colmap_netvlad.mapping.priors import PositionPriors


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
