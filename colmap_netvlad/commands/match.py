"""What `colmap-netvlad match` does: image pairs -> verified matches in the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from colmap_netvlad.colmap.copies import renew_copy
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.commands.pairs import PairsReport
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.graph.verified import verified_components
from colmap_netvlad.matching.options import MatchOptions, MatchReport, given_up_words
from colmap_netvlad.matching.rounds import (
    RoundsReport,
    match_in_rounds,
    plan_budget,
    rounds_lines,
)
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.pairs.connect import apart_lines
from colmap_netvlad.pairs.lists import SUFFIXES, read_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import InputError

DEFAULT_OPTIONS = MatchOptions()

PairsOrList = PairsReport | str | Path | Sequence[Pair] | None
"""Pairs of `make_pairs`, a pairs list on disk, pairs of names; None: the project's pairs list."""


@dataclass(frozen=True)
class RoundsOptions:
    """How a budget of pairs is spent in rounds; see `matching.rounds`.

    Attributes:
        rounds: at least 1.
        budget: most pairs that are matched; None: k times the number of images.
        method: retrieval method that ranks the candidates.
        retrieval: k and what else the method takes.
    """

    rounds: int = 3
    budget: int | None = None
    method: str = "hybrid"
    retrieval: RetrievalOptions = field(default_factory=RetrievalOptions)


@dataclass(frozen=True)
class MatchingReport:
    """What `match` did.

    Attributes:
        matches: the matching.
        components: image names of each component of the verified view graph, largest first.
        rounds: round by round, where it was done in rounds.
    """

    matches: MatchReport
    components: list[list[str]]
    rounds: RoundsReport | None = None


def match(
    project: Project,
    pairs: PairsOrList = None,
    rounds: RoundsOptions | None = None,
    options: MatchOptions = DEFAULT_OPTIONS,
) -> MatchingReport:
    """Match and verify pairs, or spend a budget of pairs in rounds, into the project's database.

    Pairs matched before are not matched again.

    Args:
        pairs: what to match, unless it is done in rounds.
        rounds: how to choose pairs in rounds.

    Raises:
        InputError: no pairs, no features, a database that cannot be written, or as
            `match_in_rounds`.
    """
    if rounds is None:
        spent = None
        matches = match_pairs(project.database, _chosen(project, pairs), options)
    else:
        spent = _spend(project, rounds, options)
        matches = spent.matches
    return MatchingReport(matches, verified_components(project.database), spent)


def working_copy(project: Project) -> Project:
    """Return the project on a copy of its database, `<name>.copy.db` beside it, same cache.

    A copy that is there is brought up to date, with the matches in it.

    Raises:
        InputError: as `renew_copy`.
    """
    renew_copy(project.database, project.copy)
    return Project(project.copy, project.images, project.cache)


def report_lines(report: MatchingReport) -> list[str]:
    """Return what `colmap-netvlad match` prints: rounds, pairs, what is apart."""
    matches = report.matches
    return [
        *(rounds_lines(report.rounds) if report.rounds else []),
        f"Pairs: {matches.requested:,} ({matches.already:,} matched before, "
        f"{matches.matched:,} now), {matches.verified:,} verified{given_up_words(matches)}, "
        f"{matches.seconds / 60:.1f} minutes.",
        *view_graph_lines(report.components),
    ]


def as_json(report: MatchingReport) -> dict[str, Any]:
    """Return what `colmap-netvlad match --json` prints."""
    return {
        "matches": report.matches,
        "rounds": report.rounds.rounds if report.rounds else [],
        "components": report.components,
    }


def view_graph_lines(groups: Sequence[Sequence[str]]) -> list[str]:
    """Return which images no verified pair joins to the rest, or nothing."""
    if len(groups) < 2:
        return []
    return [
        f"View graph: {len(groups)} components; apart from the largest of {len(groups[0]):,} "
        "images are (a larger `k`, or `rounds`, may join them):",
        *(f"  {line}" for line in apart_lines(groups)),
    ]


def _chosen(project: Project, pairs: PairsOrList) -> list[Pair]:
    if isinstance(pairs, PairsReport):
        return [(pair.name1, pair.name2) for pair in pairs.pairs]
    if pairs is not None and not isinstance(pairs, str | Path):
        return list(pairs)
    listed = _newest_list(project) if pairs is None else Path(pairs)
    if not listed.is_file():
        raise InputError(
            f"There is no pairs list {listed}; make it with `colmap-netvlad pairs`, name one with "
            "`pairs`, or match in `rounds`, which need none."
        )
    chosen = read_pairs(listed, image_names(project.database))
    if not chosen:
        raise InputError(f"{listed} lists no pairs; run `colmap-netvlad pairs`.")
    return chosen


def _newest_list(project: Project) -> Path:
    """Return the list that `pairs` wrote last: COLMAP's, or the complete one where names do not fit
    in that."""
    lists = [project.pairs.with_suffix(suffix) for suffix in SUFFIXES.values()]
    written = [path for path in lists if path.is_file()]
    return max(written, key=lambda path: path.stat().st_mtime_ns, default=project.pairs)


def _spend(project: Project, rounds: RoundsOptions, options: MatchOptions) -> RoundsReport:
    ranking = rank_project(project, rounds.method, rounds.retrieval)
    budget = rounds.budget
    if budget is None:
        budget = plan_budget(rounds.retrieval.k, len(ranking.names))
    return match_in_rounds(project, ranking, budget, rounds.rounds, options)
