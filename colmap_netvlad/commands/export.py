"""Models for other programs: what the command `export` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from pyproj import CRS

from colmap_netvlad.commands.georegister import find_models, read_model
from colmap_netvlad.export import FORMATS, PLAIN
from colmap_netvlad.export.world import World
from colmap_netvlad.geo.frames import check_area, lacking_grids, read_crs
from colmap_netvlad.geo.georeference import read_frame
from colmap_netvlad.graph.verified import verified_by_name
from colmap_netvlad.mapping.output import free_output, model_folder, named
from colmap_netvlad.runtime.errors import InputError


@dataclass(frozen=True)
class ExportReport:
    """What `export` wrote.

    Attributes:
        output: folder of the files; of several models, a folder for each in it.
        files: names relative to it.
        crs: the projected system of tables and point clouds; None where none was needed.
        notes: what to know of it, sentences.
    """

    output: Path
    files: list[str]
    crs: str | None
    notes: tuple[str, ...] = ()


def export(
    sparse: Path,
    formats: Sequence[str] = (),
    output: Path | None = None,
    database: Path | None = None,
    crs: str | None = None,
) -> ExportReport:
    """Write a model in the formats of other programs.

    Args:
        sparse: a model, or a folder of models 0, 1, ...; left as it is.
        formats: names in `FORMATS` and `PLAIN`; empty: all.
        output: a new folder; default: `<sparse>-export`.
        database: for the verified pairs; None: pairs are those with common 3D points.
        crs: projected system of tables and point clouds; default: the UTM zone of the model.

    Raises:
        InputError: no model, one that is not in the world for a format that needs it, an unknown
            or unprojected system, one for another part of the world, or `output` holds something
            already.
    """
    sparse = named(sparse)
    folders = find_models(sparse)
    formats = formats or (*FORMATS, *PLAIN)
    projected = None if crs is None else _projected(crs)
    verified = None if database is None else verified_by_name(database)
    frames = {
        folder: read_frame(folder) for folder in folders if any(name in FORMATS for name in formats)
    }
    output = output or free_output(sparse.with_name(f"{sparse.name}-export"))
    name: str | None = None
    notes: list[str] = []
    with model_folder(output) as temporary:
        for folder in folders:
            target = temporary if folder == sparse else temporary / folder.name
            target.mkdir(exist_ok=True)
            model = read_model(folder)
            if folder in frames:
                system = projected or CRS.from_epsg(frames[folder].epsg)
                origin = frames[folder].to_wgs84(np.zeros((1, 3)))
                check_area(system, origin)
                if name is None:
                    name = system.name
                    notes = lacking_grids(system, origin)
                world = World(model, frames[folder], system, verified)
                for chosen in formats:
                    if chosen in FORMATS:
                        file, write = FORMATS[chosen]
                        write(world, target / file)
            _write_plain(model, formats, target)
        files = sorted(
            path.relative_to(temporary).as_posix()
            for path in temporary.rglob("*")
            if path.is_file()
        )
    return ExportReport(output, files, name, tuple(notes))


def report_lines(report: ExportReport) -> list[str]:
    """Return what `colmap-netvlad export` prints."""
    system = "" if report.crs is None else f"; CSV, LAS and shots in {report.crs}"
    return [*report.files, *report.notes, f"{len(report.files)} files in {report.output}{system}."]


def _write_plain(model: pycolmap.Reconstruction, formats: Sequence[str], target: Path) -> None:
    if "ply" in formats:
        model.export_PLY(target / "points.ply")
    if "text" in formats:
        (target / "text").mkdir()
        model.write_text(target / "text")


def _projected(name: str) -> CRS:
    crs = read_crs(name)
    if not crs.is_projected:
        raise InputError(
            f"{crs.name} is in degrees; name a projected system as `crs`, EPSG:32632 for example."
        )
    return crs
