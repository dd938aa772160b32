"""Pairs list -> matches -> sparse models -> report: what the command `reconstruct` does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from rich.table import Table

from colmap_netvlad.colmap.database import copy_database, image_names, open_database
from colmap_netvlad.commands.georegister import (
    ControlFile,
    Placed,
    georegister_in_place,
    places_for,
)
from colmap_netvlad.geo.align import MIN_PLACES
from colmap_netvlad.geo.gcp import ControlList
from colmap_netvlad.geo.places import Places, find_deviations, find_places
from colmap_netvlad.graph.verified import verified_components
from colmap_netvlad.mapping import MAPPERS, WITH_PRIORS
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import free_output
from colmap_netvlad.mapping.priors import PositionPriors
from colmap_netvlad.mapping.summary import ModelSummary, combine, registered_names, summarize
from colmap_netvlad.matching.run import MatchOptions, MatchReport, match_pairs
from colmap_netvlad.pairs.connect import apart_lines
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError

MISSING_SHOWN = 10
"""Names of unregistered images that are printed."""


@dataclass(frozen=True)
class ReconstructOptions:
    """Options of `reconstruct`.

    Attributes:
        mapper: name in `mapping.MAPPERS`.
        mapping: what the mapper is told.
        matching: how pairs are matched.
        georegister: whether models are brought into the world: auto (where positions are known),
            off, require.
        use_gps: adjust with the positions as priors.
        gps_deviation: standard deviation of positions, m horizontal and vertical, for all
            photos; None: what each photo states, else `geo.places.DEFAULT_DEVIATIONS`.
        gcp: ground points, which place the models and are held in a last adjustment.
    """

    mapper: str = "incremental"
    mapping: MappingOptions = MappingOptions()
    matching: MatchOptions = MatchOptions()
    georegister: Literal["auto", "off", "require"] = "auto"
    use_gps: bool = False
    gps_deviation: tuple[float, float] | None = None
    gcp: ControlFile | None = None


@dataclass(frozen=True)
class ReconstructReport:
    """What `reconstruct` did.

    Attributes:
        output: folder of the models.
        images: images in the database.
        matches: report of the matching.
        models: figures of each model, in the order of their folders.
        total: figures of all models together.
        missing: names of the images without a pose in any model.
        seconds: duration by stage, s.
        components: image names of each component of the verified view graph, largest first.
        placed: where each model is in the world; empty where that was not asked or no position
            is known.
        notes: what was put aside among the positions.
    """

    output: Path
    images: int
    matches: MatchReport
    models: list[ModelSummary]
    total: ModelSummary
    missing: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    components: list[list[str]] = field(default_factory=list)
    placed: list[Placed] = field(default_factory=list)
    notes: tuple[str, ...] = ()


def reconstruct(
    project: Project,
    pairs: Path | None = None,
    output: Path | None = None,
    options: ReconstructOptions = ReconstructOptions(),
) -> ReconstructReport:
    """Match the pairs of a list, map, and write the sparse models.

    It writes matches into the project's database, where COLMAP keeps them. Pairs matched before
    are not matched again.

    Args:
        project: database and photos.
        pairs: the pairs list; default: `pairs.txt` beside the database.
        output: folder of the models; default: `sparse` beside the database, or `sparse-2`,
            `sparse-3`, ... where there are models already.
        options: mapper, seeds, limits.

    Raises:
        InputError: no pairs list, no features, an unknown mapper, or no model at all.
    """
    check_mapper(options.mapper, use_gps=options.use_gps)
    with open_database(project.database) as colmap:
        names = [row.name for row in colmap.images()]
    chosen = read_pairs(_existing(pairs or project.pairs), names)
    if not chosen:
        raise InputError(f"{pairs or project.pairs} lists no pairs; run `colmap-netvlad pairs`.")
    matches = match_pairs(project.database, chosen, options.matching)
    return map_and_report(project, matches, output, options)


def map_and_report(
    project: Project,
    matches: MatchReport,
    output: Path | None = None,
    options: ReconstructOptions = ReconstructOptions(),
) -> ReconstructReport:
    """Map a database whose pairs are matched, and sum up.

    Raises:
        InputError: no pair was verified, or no model came out of it.
    """
    check_mapper(options.mapper, use_gps=options.use_gps)
    if not matches.verified:
        raise InputError(
            f"None of the {matches.requested} pairs could be verified, so there is nothing to "
            "reconstruct; the photos may not overlap, or the pairs list be of other photos."
        )
    control = None if options.gcp is None else options.gcp.read(image_names(project.database))
    places = _places(project, control, options)
    mapping = options.mapping
    priors_note: tuple[str, ...] = ()
    if options.use_gps and places is not None:
        mapping, priors_note = _with_priors(project, places, options)
    target = free_output(output or project.sparse)
    start = time.monotonic()
    models = MAPPERS[options.mapper](project.database, project.images, target, mapping)
    seconds = {"matching": matches.seconds, "mapping": time.monotonic() - start}
    if not models:
        raise InputError(
            f"No model came out of {matches.verified} verified pairs: none has enough inliers and "
            "baseline to start from. More pairs (--k) or more overlap may help."
        )
    placed = (
        []
        if places is None
        else georegister_in_place(
            target, places, control, adjusted=options.use_gps, seed=options.mapping.seed
        )
    )
    registered = registered_names(models)
    names = image_names(project.database)
    return ReconstructReport(
        output=target,
        images=len(names),
        matches=matches,
        models=[summarize(model) for model in models],
        total=combine(models),
        missing=[name for name in names if name not in registered],
        seconds=seconds,
        components=verified_components(project.database),
        placed=placed,
        notes=(*priors_note, *(() if places is None else places.notes)),
    )


def _places(
    project: Project, control: ControlList | None, options: ReconstructOptions
) -> Places | None:
    """Return the known positions, or None where models stay where they are.

    Raises:
        InputError: a place in the world is required, and too few positions are known.
    """
    if options.georegister == "off" and not options.use_gps and control is None:
        return None
    places = find_places(image_names(project.database), project.database, project.images)
    places = places_for(places, control)
    if places.known >= MIN_PLACES:
        return places
    if options.use_gps or (options.georegister == "require" and control is None):
        asked = "--use-gps" if options.use_gps else "--georegister require"
        raise InputError(
            f"{places.known} of {len(places.names)} photos have a usable position, and "
            f"{asked} needs {MIN_PLACES}; nothing was mapped."
            + "".join(f" {note}" for note in places.notes)
        )
    return None if control is None else places


def _with_priors(
    project: Project, places: Places, options: ReconstructOptions
) -> tuple[MappingOptions, tuple[str, ...]]:
    """Return what the mapper is told with positions as priors, and a sentence on their accuracy."""
    deviations, stating = find_deviations(
        places.names, project.database, project.images, options.gps_deviation
    )
    priors = PositionPriors(places.names, places.metres, deviations)
    if options.gps_deviation is not None:
        source = "as given"
    else:
        source = f"{stating:,} state their own, the others have the default"
    east, _, up = np.median(deviations, axis=0).tolist()
    note = (
        f"Adjusted with {places.known:,} positions; standard deviation {east:g} m horizontally, "
        f"{up:g} m vertically in the median ({source})."
    )
    return replace(options.mapping, priors=priors), (note,)


def working_copy(project: Project) -> Project:
    """Return the project on a copy of its database, `<name>.copy.db` beside it.

    A copy of the same images and features is taken up again, with the matches in it; any other
    is replaced.

    Raises:
        InputError: the copy cannot be written.
    """
    copy = project.database.with_suffix(".copy.db")
    if not (copy.exists() and _features(copy) == _features(project.database)):
        copy_database(project.database, copy, matches=True)
    return Project(copy, project.images)


def check_mapper(name: str, *, use_gps: bool = False) -> None:
    """Raise InputError unless `name` is a mapper, and one that takes positions if they are used."""
    if name not in MAPPERS:
        raise InputError(f"There is no mapper {name}; choose {', '.join(MAPPERS)}.")
    if use_gps and name not in WITH_PRIORS:
        raise InputError(
            f"The mapper {name} cannot adjust with positions; --use-gps works with "
            f"{', '.join(WITH_PRIORS)}."
        )


def report_table(report: ReconstructReport) -> Table:
    """Return the figures of every component, and in total where there are several."""
    table = Table(title=f"Sparse model in {report.output}", title_justify="left")
    table.add_column("Component")
    for column in (
        "Registered\nimages",
        "3D points",
        "Mean reprojection\nerror (px)",
        "Mean track\nlength",
        "Observations",
    ):
        table.add_column(column, justify="right", no_wrap=True)
    for index, model in enumerate(report.models):
        table.add_row(str(index), *_cells(model, report.images))
    if len(report.models) > 1:
        table.add_section()
        table.add_row("total", *_cells(report.total, report.images))
    return table


def report_lines(report: ReconstructReport) -> list[str]:
    """Return what stands below the table: pairs, minutes of each stage, images left out."""
    matches = report.matches
    lines = [
        f"Pairs: {matches.requested:,} ({matches.already:,} matched before, "
        f"{matches.matched:,} now), {matches.verified:,} verified.",
        "Minutes: "
        + ", ".join(f"{stage} {time / 60:.1f}" for stage, time in report.seconds.items())
        + f", together {sum(report.seconds.values()) / 60:.1f}.",
    ]
    lines += view_graph_lines(report.components)
    for number, placed in enumerate(report.placed):
        where = f"Model {number}: " if len(report.placed) > 1 else ""
        lines += [where + line for line in placed.lines()]
    lines += report.notes
    if report.missing:
        lines.append(
            f"Not registered: {len(report.missing)} of {report.images} images: "
            f"{_first(report.missing)}."
        )
    return lines


def view_graph_lines(groups: Sequence[Sequence[str]]) -> list[str]:
    """Return which images no verified pair joins to the rest, or nothing."""
    if len(groups) < 2:
        return []
    return [
        f"View graph: {len(groups)} components; apart from the largest of {len(groups[0]):,} "
        "images are (a larger --k, or --rounds, may join them):",
        *(f"  {line}" for line in apart_lines(groups)),
    ]


def _cells(model: ModelSummary, images: int) -> tuple[str, ...]:
    return (
        f"{model.registered:,} of {images:,}",
        f"{model.points:,}",
        f"{model.mean_reprojection_error:.3f}",
        f"{model.mean_track_length:.2f}",
        f"{model.observations:,}",
    )


def _first(names: Sequence[str]) -> str:
    shown = ", ".join(names[:MISSING_SHOWN])
    return shown if len(names) <= MISSING_SHOWN else f"{shown}, ..."


def _existing(pairs: Path) -> Path:
    if not pairs.is_file():
        raise InputError(
            f"There is no pairs list {pairs}; make it with `colmap-netvlad pairs`, or name one "
            "with --pairs."
        )
    return pairs


def _features(database: Path) -> tuple[list[tuple[int, str]], dict[int, int]]:
    with open_database(database) as colmap:
        return [(row.image_id, row.name) for row in colmap.images()], colmap.keypoint_counts()
