"""A georegistered model for other programs, one file a format: the table of formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from colmap_netvlad.export.geojson import write_cameras, write_footprints, write_pairs
from colmap_netvlad.export.points import write_las
from colmap_netvlad.export.shots import write_shots
from colmap_netvlad.export.table import write_table
from colmap_netvlad.export.world import World

FORMATS: dict[str, tuple[str, Callable[[World, Path], None]]] = {
    "cameras": ("cameras.geojson", write_cameras),
    "footprints": ("footprints.geojson", write_footprints),
    "pairs": ("pairs.geojson", write_pairs),
    "shots": ("shots.geojson", write_shots),
    "csv": ("cameras.csv", write_table),
    "las": ("points.las", write_las),
}
"""Name of `export --format` -> file name and writer; all need a model in the world."""

PLAIN = ("ply", "text")
"""Formats in the model's own frame, which COLMAP writes: they need no place in the world."""
