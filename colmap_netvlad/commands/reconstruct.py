"""Pairs list -> matches -> sparse models -> report: what the command `reconstruct` does."""

from __future__ import annotations

import hashlib
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.commands.georegister import (
    Placed,
    WorldOptions,
    georegister_in_place,
    places_for,
)
from colmap_netvlad.commands.match import (
    MatchingReport,
    PairsOrList,
    RoundsOptions,
    match,
    view_graph_lines,
)
from colmap_netvlad.commands.match import as_json as match_json
from colmap_netvlad.commands.report import (
    FlightReport,
    all_reported,
    made_before,
    report_models,
    run_of,
    save_runs,
)
from colmap_netvlad.geo.align import MIN_PLACES
from colmap_netvlad.geo.gcp import ControlList
from colmap_netvlad.geo.places import Places, find_deviations, find_places
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.mapping import MAPPERS, WITH_PRIORS
from colmap_netvlad.mapping.contradicted import dropped_lines, mapping_database, moves_of
from colmap_netvlad.mapping.extend import read_models
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import free_output, take_name
from colmap_netvlad.mapping.parallel import forget_clusters
from colmap_netvlad.mapping.priors import PositionPriors
from colmap_netvlad.mapping.summary import ModelSummary, combine, registered_names, summarize
from colmap_netvlad.matching.options import MatchOptions, given_up_words
from colmap_netvlad.matching.rounds import rounds_lines
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import remove_scratch
from colmap_netvlad.runtime.sequences import listed


@dataclass(frozen=True)
class ReconstructOptions:
    """Options of `reconstruct`.

    Attributes:
        mapper: name in `mapping.MAPPERS`.
        mapping: what the mapper is told.
        matching: how pairs are matched.
        drop_contradicted: leave pairs of look-alike places out of the mapping.
        command: the command line that asked for it, for the quality report.
        world: how models are brought into the world.
    """

    mapper: str = "auto"
    mapping: MappingOptions = MappingOptions()
    matching: MatchOptions = MatchOptions()
    world: WorldOptions = WorldOptions()
    drop_contradicted: bool = True
    command: str = ""


@dataclass(frozen=True)
class ReconstructReport:
    """What `reconstruct` did.

    Attributes:
        output: folder of the models.
        images: images in the database.
        matching: report of the matching.
        models: figures of each model, in the order of their folders.
        total: figures of all models together.
        missing: names of the images without a pose in any model.
        seconds: duration by stage, s.
        dropped: contradicted pairs that were left out of the mapping.
        quality: the quality report of each model, the largest first.
        placed: where each model is in the world; empty where that was not asked or no position
            is known.
        notes: how good the positions are taken to be, and what was put aside among them.
    """

    output: Path
    images: int
    matching: MatchingReport
    models: list[ModelSummary]
    total: ModelSummary
    missing: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    dropped: list[Pair] = field(default_factory=list)
    quality: list[FlightReport] = field(default_factory=list)
    placed: list[Placed] = field(default_factory=list)
    notes: tuple[str, ...] = ()


def reconstruct(
    project: Project,
    pairs: PairsOrList = None,
    output: Path | None = None,
    options: ReconstructOptions = ReconstructOptions(),
    rounds: RoundsOptions | None = None,
) -> ReconstructReport:
    """Match pairs, map, and write the sparse models, each with its quality report.

    It writes matches into the project's database, where COLMAP keeps them. Pairs matched before
    are not matched again; models of a run that was stopped before their reports are not mapped
    again.

    Args:
        project: database and photos.
        pairs: pairs of `make_pairs`, a pairs list or pairs of names; default: `pairs.txt` beside
            the database.
        output: folder of the models; default: `sparse` beside the database, or `sparse-2`,
            `sparse-3`, ... where there are models already.
        options: mapper, seeds, limits.
        rounds: choose pairs in rounds instead.

    Raises:
        InputError: no pairs, no features, an unknown mapper, no pair that could be verified, or
            no model at all.
    """
    check_mapper(options.mapper, use_gps=options.world.use_gps)
    control, places = _known_places(project, options.world)
    matching = match(project, pairs, rounds, options.matching)
    matches = matching.matches
    if not matches.verified:
        raise InputError(
            f"None of the {matches.requested} pairs could be verified, so there is nothing to "
            "reconstruct; the photos may not overlap, or the pairs list be of other photos."
        )
    mapping, notes = options.mapping, () if places is None else places.notes
    if options.world.use_gps and places is not None:
        mapping, note = _with_priors(project, places, options)
        notes = (note, *notes)
    run = run_of(options.command or "reconstruct, called from Python", {}, asdict(options))
    run = replace(run, source=_mapped_from(project, places, options.world))
    seconds = {"matching": matches.seconds, "mapping": 0.0}
    dropped: list[Pair] = []
    placed: list[Placed] = []
    made = made_before(output or project.sparse, run)
    target = free_output(output or project.sparse)
    start = time.monotonic()

    def finish(folder: Path) -> None:
        """Place the models, note how they were made, and give them their name."""
        nonlocal target
        if not any(folder.iterdir()):
            return
        if places is not None:
            placed.extend(
                georegister_in_place(
                    folder,
                    places,
                    control,
                    adjusted=options.world.use_gps,
                    gps_std=options.world.gps_std,
                    seed=mapping.seed,
                )
            )
        seconds["mapping"] = time.monotonic() - start
        save_runs(folder, replace(run, seconds=seconds, dropped=len(dropped)))
        target = take_name(folder, output or project.sparse)

    remove_scratch(project.folder)  # the copy that a stopped run mapped from
    moves = None
    if made is not None and not all_reported(made):
        target = made
        models = read_models(target)
        forget_clusters(target)
        notes = (f"The run that made {target} was stopped before its reports; now made.", *notes)
    else:
        mapper = MAPPERS[options.mapper]
        moves = moves_of(project) if options.drop_contradicted else None
        with mapping_database(project, moves) as (database, dropped):
            models = mapper(database, project.images, target, mapping, finish)
    if not models:
        raise InputError(
            f"No model came out of {matches.verified} verified pairs: none has enough inliers and "
            "baseline to start from. More pairs (`k`) or more overlap may help."
        )
    quality = report_models(target, project.database, project.images, moves)
    registered = registered_names(models)
    names = image_names(project.database)
    return ReconstructReport(
        output=target,
        images=len(names),
        matching=matching,
        models=[summarize(model) for model in models],
        total=combine(models),
        missing=[name for name in names if name not in registered],
        seconds=seconds,
        dropped=dropped,
        quality=quality,
        placed=placed,
        notes=notes,
    )


def _mapped_from(project: Project, places: Places | None, world: WorldOptions) -> str:
    """Return a fingerprint of what decides on a model beside the options."""
    with open_database(project.database) as database:
        digest = hashlib.sha256(database.verified_fingerprint().encode())
    if places is not None:
        digest.update(places.metres.tobytes())
    if world.gcp is not None:
        digest.update(world.gcp.path.read_bytes())
    return digest.hexdigest()


def _known_places(
    project: Project, world: WorldOptions
) -> tuple[ControlList | None, Places | None]:
    """Return ground points and known positions; None for both where models stay where they are.

    Raises:
        InputError: a place in the world is required, and too few positions are known; or the
            ground points cannot be used.
    """
    names = image_names(project.database)
    control = None if world.gcp is None else world.gcp.read(names)
    if world.georegister == "off" and not world.use_gps and control is None:
        return None, None
    places = places_for(find_places(names, project.database, project.images), control)
    if places.known >= MIN_PLACES:
        return control, places
    if world.use_gps or (world.georegister == "require" and control is None):
        asked = "`use_gps`" if world.use_gps else "`georegister` require"
        raise InputError(
            f"{places.known} of {len(names)} photos have a usable position, and {asked} needs "
            f"{MIN_PLACES}; nothing was mapped." + "".join(f" {note}" for note in places.notes)
        )
    return (None, None) if control is None else (control, places)


def _with_priors(
    project: Project, places: Places, options: ReconstructOptions
) -> tuple[MappingOptions, str]:
    """Return what the mapper is told with positions as priors, and a sentence on their accuracy."""
    given = options.world.gps_std
    deviations, stating = find_deviations(places.names, project.database, project.images, given)
    priors = PositionPriors(places.names, places.metres, deviations)
    source = f"{stating:,} photos state their own, the others have the default"
    east, _, up = np.median(deviations, axis=0).tolist()
    note = (
        f"Adjusted with {places.known:,} positions; standard deviation {east:g} m horizontally, "
        f"{up:g} m vertically in the median ({'as given' if given else source})."
    )
    return replace(options.mapping, priors=priors), note


def check_mapper(name: str, *, use_gps: bool = False) -> None:
    """Raise InputError unless `name` is a mapper, and one that takes positions if they are used."""
    if name not in MAPPERS:
        raise InputError(f"There is no mapper {name}; choose {', '.join(MAPPERS)}.")
    if use_gps and name not in WITH_PRIORS:
        raise InputError(
            f"The mapper {name} cannot adjust with positions; `use_gps` works with "
            f"{', '.join(WITH_PRIORS)}."
        )


def report_lines(report: ReconstructReport) -> list[str]:
    """Return the report in lines: rounds, pairs, minutes of each stage, images left out."""
    matching = report.matching
    matches = matching.matches
    lines = [
        *(rounds_lines(matching.rounds) if matching.rounds else []),
        f"Pairs: {matches.requested:,} ({matches.already:,} matched before, "
        f"{matches.matched:,} now), {matches.verified:,} verified{given_up_words(matches)}.",
        "Minutes: "
        + ", ".join(f"{stage} {time / 60:.1f}" for stage, time in report.seconds.items())
        + f", together {sum(report.seconds.values()) / 60:.1f}.",
        *view_graph_lines(matching.components),
    ]
    lines += dropped_lines(report.dropped)
    for number, placed in enumerate(report.placed):
        where = f"Model {number}: " if len(report.placed) > 1 else ""
        lines += [where + line for line in placed.lines()]
    lines += report.notes
    if report.missing:
        lines.append(
            f"Not registered: {len(report.missing)} of {report.images} images: "
            f"{listed(report.missing)}."
        )
    return lines


def as_json(report: ReconstructReport) -> dict[str, Any]:
    """Return what `colmap-netvlad reconstruct --json` prints."""
    return {
        "output": report.output,
        "images": report.images,
        "registered": report.total.registered,
        "total": report.total,
        "models": report.models,
        "missing": report.missing,
        "dropped": report.dropped,
        "seconds": report.seconds,
        "quality": [{"page": page.page, "verdict": page.verdict} for page in report.quality],
        "georeferences": [
            placed.georeference and placed.georeference.summary() for placed in report.placed
        ],
        **match_json(report.matching),
    }
