"""Matches -> sparse models: the table of mappers."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import pycolmap

from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import Finish
from colmap_netvlad.mapping.parallel import map_parallel
from colmap_netvlad.mapping.pipelines import map_automatic, map_global, map_hierarchical


class Mapper(Protocol):
    """A mapper writes its models to `output`/0, 1, ..., finishes them, and returns them as they
    were before."""

    def __call__(
        self,
        database: Path,
        images: Path | None,
        output: Path,
        options: MappingOptions = ...,
        finish: Finish = ...,
    ) -> list[pycolmap.Reconstruction]:
        """Reconstruct the images of `database`."""


MAPPERS: dict[str, Mapper] = {
    "incremental": map_incremental,
    "parallel": map_parallel,
    "hierarchical": map_hierarchical,
    "global": map_global,
    "auto": map_automatic,
}
"""Name of `reconstruct --mapper` -> the mapper."""

WITH_PRIORS = ("incremental", "parallel", "auto")
"""Mappers that take position priors into the adjustment."""
