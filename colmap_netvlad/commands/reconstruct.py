"""Pairs list -> matches -> sparse models -> report: what the command `reconstruct` does."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.commands.match import (
    MatchingReport,
    PairsOrList,
    RoundsOptions,
    match,
    view_graph_lines,
)
from colmap_netvlad.commands.match import as_json as match_json
from colmap_netvlad.mapping import MAPPERS
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import free_output
from colmap_netvlad.mapping.summary import ModelSummary, combine, registered_names, summarize
from colmap_netvlad.matching.options import MatchOptions, given_up_words
from colmap_netvlad.matching.rounds import rounds_lines
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.sequences import listed


@dataclass(frozen=True)
class ReconstructOptions:
    """Options of `reconstruct`.

    Attributes:
        mapper: name in `mapping.MAPPERS`.
        mapping: what the mapper is told.
        matching: how pairs are matched.
    """

    mapper: str = "auto"
    mapping: MappingOptions = MappingOptions()
    matching: MatchOptions = MatchOptions()


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
    """

    output: Path
    images: int
    matching: MatchingReport
    models: list[ModelSummary]
    total: ModelSummary
    missing: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)


def reconstruct(
    project: Project,
    pairs: PairsOrList = None,
    output: Path | None = None,
    options: ReconstructOptions = ReconstructOptions(),
    rounds: RoundsOptions | None = None,
) -> ReconstructReport:
    """Match pairs, map, and write the sparse models.

    It writes matches into the project's database, where COLMAP keeps them. Pairs matched before
    are not matched again.

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
    check_mapper(options.mapper)
    matching = match(project, pairs, rounds, options.matching)
    matches = matching.matches
    if not matches.verified:
        raise InputError(
            f"None of the {matches.requested} pairs could be verified, so there is nothing to "
            "reconstruct; the photos may not overlap, or the pairs list be of other photos."
        )
    target = free_output(output or project.sparse)
    start = time.monotonic()
    models = MAPPERS[options.mapper](project.database, project.images, target, options.mapping)
    seconds = {"matching": matches.seconds, "mapping": time.monotonic() - start}
    if not models:
        raise InputError(
            f"No model came out of {matches.verified} verified pairs: none has enough inliers and "
            "baseline to start from. More pairs (`k`) or more overlap may help."
        )
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
    )


def check_mapper(name: str) -> None:
    """Raise InputError unless `name` is a mapper."""
    if name not in MAPPERS:
        raise InputError(f"There is no mapper {name}; choose {', '.join(MAPPERS)}.")


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
        "seconds": report.seconds,
        **match_json(report.matching),
    }
