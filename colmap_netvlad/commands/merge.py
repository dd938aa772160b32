"""Models into one: what the command `merge` does."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycolmap

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import feature_counts, image_names
from colmap_netvlad.commands.georegister import (
    Placed,
    find_models,
    georegister_in_place,
    read_model,
)
from colmap_netvlad.geo.align import MIN_PLACES
from colmap_netvlad.geo.places import find_places
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import free_output, model_folder, take_name
from colmap_netvlad.mapping.summary import ModelSummary, strangers, summarize
from colmap_netvlad.mapping.together import join_and_adjust
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import MatchReport, match_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import temporary_prefix

DEPTH = 100
"""Candidates of each image among which its partners in other models are looked for."""


@dataclass(frozen=True)
class MergeOptions:
    """Options of `merge_models`.

    Attributes:
        method: retrieval method.
        retrieval: what it takes, and the seed; its k is not used.
        across: partners of each image in other models that are matched.
    """

    method: str = "hybrid"
    retrieval: RetrievalOptions = field(default_factory=RetrievalOptions)
    across: int = 10

    @property
    def seed(self) -> int:
        """Of matching, RANSAC and adjustment."""
        return self.retrieval.seed


@dataclass(frozen=True)
class MergeReport:
    """What `merge_models` did.

    Attributes:
        output: folder of the models.
        before: (name, registered images) of each model that was given.
        members: for each model written, the names of those it was made of.
        models: figures of each model written.
        refused: (name, reason) of models that share points with another but do not fit.
        matches: report of the matching.
        placed: where each model is in the world; empty where no positions are known.
    """

    output: Path
    before: list[tuple[str, int]]
    members: list[list[str]]
    models: list[ModelSummary]
    refused: list[tuple[str, str]]
    matches: MatchReport
    placed: list[Placed]


def merge_models(
    project: Project,
    sparse: Sequence[Path],
    output: Path | None = None,
    options: MergeOptions = MergeOptions(),
) -> MergeReport:
    """Join models of one project's photos through pairs across them.

    Each image is matched with its most likely partners in other models; the matches, which are
    written into the database, say which 3D points are one. The models given are left as they are;
    one that joins no other is written unchanged beside the joined one.

    Args:
        project: its database has the photos of all models, with features.
        sparse: models, or folders of models 0, 1, ...
        output: a new folder of models; default: `sparse`, `sparse-2`, ... beside the database.
        options: how pairs are found.

    Raises:
        InputError: fewer than two models, photos that the database does not have, or an output
            that holds something already.
    """
    given = [(path, folder) for path in sparse for folder in find_models(path)]
    if len(given) < 2:
        raise InputError("One model alone cannot be merged; name two or more as `sparse`.")
    names = [str(folder) for _, folder in given]
    features = feature_counts(project.database)
    target = free_output(project.sparse) if output is None else output
    with (
        model_folder(target) as folder,
        tempfile.TemporaryDirectory(
            prefix=temporary_prefix(folder.parent / "merge"), dir=folder.parent
        ) as scratch,
    ):
        homes: list[set[str]] = []
        copies: list[tuple[str, Path]] = []
        for number, name in enumerate(names):
            model = read_model(Path(name))
            homes.append({model.image(i).name for i in model.reg_image_ids()})
            copies.append(
                (name, _in_database(name, model, project, features, Path(scratch, str(number))))
            )
        pairs = pairs_across(_ranking(project, options), homes, options.across)
        matches = match_pairs(project.database, pairs, MatchOptions(seed=options.seed))
        told = _join(project, copies, folder, options)
        placed = _georegister(project, folder, options.seed)
        if output is None:
            target = take_name(folder, project.sparse)
    return MergeReport(
        output=target,
        before=[(name, len(home)) for name, home in zip(names, homes, strict=True)],
        members=[group["members"] for group in told],
        models=[summarize(read_model(path)) for path in find_models(target)],
        refused=[(name, why) for group in told for name, why in group["refused"]],
        matches=matches,
        placed=placed,
    )


def merge_lines(report: MergeReport) -> list[str]:
    """Return what `colmap-netvlad merge` prints."""
    lines = [
        f"Pairs across: {report.matches.requested:,} ({report.matches.already:,} matched before), "
        f"{report.matches.verified:,} verified."
    ]
    for number, (members, model) in enumerate(zip(report.members, report.models, strict=True)):
        what = " + ".join(members) if len(members) > 1 else f"{members[0]}, unchanged"
        lines.append(
            f"Model {number}: {what}: {model.registered:,} images, {model.points:,} points, "
            f"{model.mean_reprojection_error:.3f} px."
        )
    alone = [members[0] for members in report.members if len(members) == 1]
    reasons = dict(report.refused)
    if len(report.members) > 1:
        lines += [
            f"Not joined: {name}: {reasons.get(name, 'no verified match joins it to another')}."
            for name in alone
        ]
    for placed in report.placed:
        lines += [f"Model {placed.name}: {line}" for line in placed.lines()]
    return [*lines, f"Models are in {report.output}."]


def pairs_across(ranking: Ranking, homes: Sequence[set[str]], across: int) -> list[tuple[str, str]]:
    """Return each image with its best partners in models that it is not in itself."""
    lives = {name: {n for n, home in enumerate(homes) if name in home} for name in ranking.names}
    pairs: dict[tuple[str, str], None] = {}
    for i, name in enumerate(ranking.names):
        row = ranking.partners[i]
        partners = (ranking.names[j] for j in row[row != NO_PARTNER].astype(np.int64))
        foreign = [
            other
            for other in partners
            if lives[name] and lives[other] and not lives[name] & lives[other]
        ]
        for other in foreign[:across]:
            pairs[min(name, other), max(name, other)] = None
    return sorted(pairs)


def _ranking(project: Project, options: MergeOptions) -> Ranking:
    retrieval = replace(options.retrieval, k=options.across)
    return rank_project(project, options.method, retrieval, max(DEPTH, options.across))


def _in_database(
    name: str,
    model: pycolmap.Reconstruction,
    project: Project,
    features: Mapping[str, int],
    target: Path,
) -> Path:
    """Write a copy of a model with the image ids of the database, and return its folder.

    Args:
        features: how many the database has of each image.
    """
    absent, namesakes = strangers(model, features)
    if absent:
        raise InputError(
            f"{len(absent)} photos of {name} (first: {absent[0]}) are not in "
            f"{project.database}: bring the projects into one database first (COLMAP's "
            "database_merger; image names stay and must differ), or import all photos into one "
            "with `colmap-netvlad features`."
        )
    if namesakes:
        raise InputError(
            f"{len(namesakes)} photos of {name} (first: {namesakes[0]}) have other features than "
            f"those of their names in {project.database}: they are other photos, or their features "
            "were made anew. Put photos with equal names into two folders of one, and begin with "
            "`colmap-netvlad features` on it."
        )
    with engine.opened(project.database) as opened:
        model.transcribe_image_ids_to_database(opened)
    target.mkdir()
    model.write(target)
    return target


def _join(
    project: Project, copies: list[tuple[str, Path]], folder: Path, options: MergeOptions
) -> list[dict]:
    with progress.step("Joining and adjusting (%)", 100) as bar:
        job = workers.Job(
            join_and_adjust,
            (project.database, project.images, copies, folder, MappingOptions(seed=options.seed)),
        )
        (outcome,) = workers.run([job], 1, bar.advance, initialiser=engine.initialiser())
    if outcome.fault is not None:
        raise InputError(f"The models could not be joined: {outcome.fault}.")
    note = folder / "merge.json"
    told: list[dict] = json.loads(note.read_text(encoding="utf-8"))
    note.unlink()
    return told


def _georegister(project: Project, output: Path, seed: int) -> list[Placed]:
    places = find_places(image_names(project.database), project.database, project.images)
    if places.known < MIN_PLACES:
        return []
    return georegister_in_place(output, places, seed=seed)
