"""New photos into an existing project: only what is new costs anything."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.colmap.features import (
    FeatureOptions,
    FeatureReport,
    check_folder,
    extract_features,
)
from colmap_netvlad.commands.georegister import Placed, keep_place
from colmap_netvlad.commands.report import (
    PAGE,
    FlightReport,
    made_before,
    read_run,
    report_models,
    run_of,
    save_runs,
)
from colmap_netvlad.geo.georeference import Place, read_place
from colmap_netvlad.geo.places import find_deviations, find_places
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.graph.verified import verified_by_name
from colmap_netvlad.mapping.contradicted import dropped_lines, mapping_database, moves_of
from colmap_netvlad.mapping.extend import check_origin, extend_model, largest_model, read_model
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import free_output, numbered, outputs, take_name
from colmap_netvlad.mapping.priors import PositionPriors
from colmap_netvlad.mapping.summary import ModelSummary, registered_names, summarize
from colmap_netvlad.matching.options import MatchOptions, MatchReport, given_up_words
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.photos.files import find_photos
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import remove_scratch
from colmap_netvlad.runtime.sequences import listed

BEGUN_SETTING = "adding"
"""The cache's setting with what is being added, JSON."""


@dataclass(frozen=True)
class Begun:
    """An addition that has not come to its end: the database may have the photos.

    Attributes:
        photos: their names.
        model: folder of the model they are to join.
        output: folder of models for the extended one, once it is known.
    """

    photos: Sequence[str] = ()
    model: str = ""
    output: str = ""


@dataclass(frozen=True)
class AddOptions:
    """Options of `add_photos`.

    Attributes:
        method: retrieval method.
        retrieval: k and what else the method takes.
        among_new: pair the new photos with each other too, not only with the old ones.
        features: how the new photos are imported.
        seed: of matching and mapping.
        matching: who matches; its seed is set from here.
        drop_contradicted: leave pairs of look-alike places out of the mapping.
        command: the command line that asked for it, for the quality report.
    """

    method: str = "hybrid"
    retrieval: RetrievalOptions = field(default_factory=RetrievalOptions)
    among_new: bool = False
    features: FeatureOptions = field(default_factory=FeatureOptions)
    seed: int = 0
    matching: MatchOptions = field(default_factory=MatchOptions)
    drop_contradicted: bool = True
    command: str = ""


@dataclass(frozen=True)
class AddReport:
    """What `add_photos` did.

    Attributes:
        new: names of the photos added.
        features: report of the import.
        matches: report of the matching.
        before, after: the model without and with the new photos.
        output: folder of the extended model.
        unregistered: new photos without a pose in the model.
        seconds: duration by stage, s.
        quality: the extended model's quality report.
        placed: where it is in the world; None where the model given was nowhere.
        dropped: contradicted pairs that were left out of the mapping.
    """

    new: list[str]
    features: FeatureReport
    matches: MatchReport
    before: ModelSummary
    after: ModelSummary
    output: Path
    unregistered: list[str]
    seconds: dict[str, float]
    quality: list[FlightReport] = field(default_factory=list)
    placed: Placed | None = None
    dropped: list[Pair] = field(default_factory=list)


def add_photos(
    project: Project,
    model: Path | None = None,
    options: AddOptions = AddOptions(),
    output: Path | None = None,
) -> AddReport:
    """Import the photos the database does not have, and register them into a model.

    Photos that were imported before, but never matched, are new as well.

    Features, descriptors, pairs, matches and poses are computed for the new photos alone; pairs
    are between a new photo and an old one. The model given is left as it is; where it is in the
    world, the larger one is in the same frame. Where it was stopped, it goes on with the same
    photos.

    Args:
        project: its photo folder holds the new photos beside the old ones; its database gets
            their features and matches.
        model: folder of the existing sparse model; None: see `newest_model`.
        output: folder of models for the extended one; default `sparse`, `sparse-2`, ...

    Raises:
        InputError: no new photos, a folder that lacks the old photos, no such model, or one that
            was made from another database.
    """
    model = (model or newest_model(project)).absolute()
    folder = project.need_images()
    begun = _begun(project)
    if begun.photos and _extends(model) == begun.model:
        model = Path(begun.model)  # the newest model is what the stopped run had made of it
    before = read_model(model)
    check_origin(project, model, before)
    pending = _unmatched(project.database) | set(begun.photos)
    pending -= {image.name for image in before.images.values()}
    old = tuple(name for name in image_names(project.database) if name not in pending)
    new = _new_photos(folder, old)
    _remember(project, Begun(new, str(model)))
    seconds: dict[str, float] = {}

    start = time.monotonic()
    features = extract_features(folder, project.database, options.features)
    usable = sorted(set(image_names(project.database)) & set(new))
    if not usable:
        raise InputError(
            f"None of the {len(new)} new photos in {folder} can be used "
            f"(first: {features.bad[0][0]} {features.bad[0][1]})."
        )
    seconds["features"] = time.monotonic() - start

    start = time.monotonic()
    pairs = _pairs_of_new(project, set(usable), options)
    seconds["retrieval"] = time.monotonic() - start

    matches = match_pairs(project.database, pairs, replace(options.matching, seed=options.seed))
    seconds["matching"] = matches.seconds

    start = time.monotonic()
    told = {**asdict(options), "model": str(model)}
    run = run_of(options.command or "add, called from Python", {}, told)
    with open_database(project.database) as database:
        run = replace(run, source=database.verified_fingerprint())

    dropped: list[Pair] = []
    place, placed = read_place(model), None
    priors = priors_of(project, place) if place is not None and place.adjusted else None

    made = made_before(output or project.sparse, run) if begun.photos else None
    target = made or free_output(output or project.sparse)
    _remember(project, Begun(new, str(model), str(target.absolute())))

    def finish(models: Path) -> None:
        """Bring the model to where the one given is, note how it was made, and name it."""
        nonlocal placed, target
        if place is not None:
            adjusted = priors is not None
            placed = keep_place(model, models / "0", project.database, folder, adjusted=adjusted)
        seconds["mapping"] = time.monotonic() - start
        save_runs(models, replace(run, seconds=seconds, dropped=len(dropped)))
        target = take_name(models, output or project.sparse)

    remove_scratch(project.folder)  # the copy that a stopped run mapped from
    moves = None
    if made is not None:
        after = read_model(target / "0")
        seconds["mapping"] = 0.0
    else:
        mapping = MappingOptions(seed=options.seed, priors=priors)
        moves = moves_of(project) if options.drop_contradicted else None
        with mapping_database(project, moves, before) as (kept, dropped):
            after = extend_model(kept, folder, model, target, len(usable), mapping, finish)
        _remember(project, Begun(new, str(model), str(target.absolute())))
    quality = report_models(target, project.database, folder, moves)
    registered = registered_names([after])
    _remember(project, Begun())
    return AddReport(
        new=usable,
        features=features,
        matches=matches,
        before=summarize(before),
        after=summarize(after),
        output=target,
        unregistered=[name for name in usable if name not in registered],
        seconds=seconds,
        quality=quality,
        placed=placed,
        dropped=dropped,
    )


def priors_of(project: Project, place: Place) -> PositionPriors:
    """Return the positions of all photos in the frame of a model that was adjusted with them."""
    names = image_names(project.database)
    places = find_places(names, project.database, project.images, place.frame)
    deviations, _ = find_deviations(names, project.database, project.images, place.gps_std)
    return PositionPriors(places.names, places.metres, deviations)


def add_lines(report: AddReport) -> list[str]:
    """Return what `colmap-netvlad add` prints."""
    registered = len(report.new) - len(report.unregistered)
    lines = [
        f"New photos: {len(report.new):,}, {registered:,} registered "
        f"({report.before.registered:,} -> {report.after.registered:,} images, "
        f"{report.before.points:,} -> {report.after.points:,} points, reprojection error "
        f"{report.before.mean_reprojection_error:.3f} -> "
        f"{report.after.mean_reprojection_error:.3f} px).",
        f"Pairs: {report.matches.matched:,} matched, {report.matches.verified:,} verified"
        f"{given_up_words(report.matches)}.",
        "Minutes: "
        + ", ".join(f"{stage} {time / 60:.1f}" for stage, time in report.seconds.items())
        + ".",
    ]
    if report.unregistered:
        lines.append(
            f"Not registered: {listed(report.unregistered)}; photos that overlap only other "
            "new ones need `among_new`, or new pairs and a new model."
        )
    lines += dropped_lines(report.dropped)
    if report.placed is not None:
        lines += report.placed.lines()
    return [*lines, f"The extended model is in {report.output}."]


def newest_model(project: Project) -> Path:
    """Return the largest model in the highest-numbered `sparse`, `sparse-2`, ... of a workspace.

    Raises:
        InputError: there is none.
    """
    for folder in reversed(outputs(project.sparse)):
        if models := numbered(folder):
            return largest_model(models)
    raise InputError(
        f"There is no model in {project.sparse}; run `colmap-netvlad reconstruct`, or name one "
        "with `sparse`."
    )


def _extends(model: Path) -> str | None:
    """Return the folder of the model that one was made of by `add`; None for any other."""
    run = read_run(model)
    return None if run is None else run.options.get("model")


def _begun(project: Project) -> Begun:
    """Return the addition that has not come to its end; one of no photos where there is none."""
    with Store(project.cache) as store:
        kept = store.setting(BEGUN_SETTING)
    try:
        begun = Begun(**json.loads(kept or "{}"))
        return Begun() if _ended(begun) else begun
    except (ValueError, TypeError):  # damaged
        return Begun()


def _ended(begun: Begun) -> bool:
    """Whether all that an addition writes is there: only its note is still to be taken back."""
    extended = Path(begun.output) / "0"
    return _extends(extended) == begun.model and (extended / PAGE).is_file()


def _remember(project: Project, begun: Begun) -> None:
    with Store(project.cache) as store:
        store.remember(BEGUN_SETTING, json.dumps(asdict(begun)))


def _unmatched(database: Path) -> set[str]:
    """Return the photos of which no pair was tried."""
    tried = {name for pair in verified_by_name(database) for name in pair}
    return set(image_names(database)) - tried


def _new_photos(folder: Path, old: tuple[str, ...]) -> list[str]:
    there = find_photos(folder)
    check_folder(folder, there, old)
    known = set(old)
    new = [name for name in there if name not in known]
    if not new:
        raise InputError(
            f"There are no new photos in {folder}: the database has all {len(there)} of them, and "
            "matched them; photos that the model lacks need other pairs (`colmap-netvlad pairs`, "
            "then `reconstruct`)."
        )
    return new


def _pairs_of_new(project: Project, new: set[str], options: AddOptions) -> list[tuple[str, str]]:
    """Return each new photo with its k best partners among the old ones (or among all)."""
    k = options.retrieval.k
    # Where new photos are not to be partners, a list full of them must not be the end of it.
    least = k if options.among_new else k + len(new)
    ranking = rank_project(project, options.method, options.retrieval, least)
    pairs: list[tuple[str, str]] = []
    for i, name in enumerate(ranking.names):
        if name in new:
            partners = _partners(ranking, i, new, options.among_new)[:k]
            pairs.extend((name, partner) for partner in partners)
    return pairs


def _partners(ranking: Ranking, image: int, new: set[str], among_new: bool) -> list[str]:
    row = ranking.partners[image]
    names = [ranking.names[j] for j in row[row != NO_PARTNER].astype(np.int64)]
    return names if among_new else [name for name in names if name not in new]
