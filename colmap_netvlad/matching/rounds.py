"""Spend a budget of image pairs in rounds: match, learn from the results, choose again."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import sparse

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.graph.components import components
from colmap_netvlad.graph.pair import IndexPair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.matching.options import MATCHER_DEFAULT, MatchOptions, MatchReport
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.pairs.connect import connecting_budget, connecting_pairs
from colmap_netvlad.pairs.rounds import FITTED, next_round, split_budget
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.fusion import similarity_matrix
from colmap_netvlad.runtime.errors import InputError

PLAN_SETTING = "rounds"
"""Where the cache keeps the rounds chosen so far."""


@dataclass(frozen=True)
class RoundReport:
    """One round.

    Attributes:
        title: "round 1 of 3" or "connecting".
        pairs: pairs chosen.
        correct: those with more than `CORRECT_MATCHES` verified matches.
        seconds_choosing, seconds_matching: what choosing and matching them took, s.
        given_up: pairs given up now at a first glance, see `MatchReport`.
    """

    title: str
    pairs: int
    correct: int
    seconds_choosing: float
    seconds_matching: float
    given_up: int = 0


@dataclass(frozen=True)
class RoundsReport:
    """What `match_in_rounds` did.

    Attributes:
        matches: all rounds together.
        rounds: round by round.
        budget: pairs that could have been spent, without the connecting ones.
    """

    matches: MatchReport
    rounds: list[RoundReport] = field(default_factory=list)
    budget: int = 0


def match_in_rounds(
    project: Project,
    ranking: Ranking,
    budget: int,
    rounds: int = 3,
    matching: MatchOptions = MatchOptions(),
) -> RoundsReport:
    """Match at most `budget` pairs of a ranking's candidates in rounds, into the database.

    Pairs that were matched before this plan count as evidence, not against the budget. Where the
    verified view graph falls apart, up to `connecting_budget` more are tried between components.
    The plan is kept in the cache, so a killed run goes on with the same pairs.

    Args:
        project: its database gets the matches.
        ranking: candidates, deeper than k for the later rounds to choose from.
        budget: image pairs, at least half the number of images.
        rounds: at least 1.

    Raises:
        InputError: a budget or a number of rounds that is too small, or a ranking of another
            image set.
    """
    ids = _check(project, ranking, budget, rounds)
    plan = _Plan.load(project, ranking, budget, rounds)
    return _Run(project, ranking, budget, rounds, matching, ids, plan).spend()


def rounds_lines(report: RoundsReport) -> list[str]:
    """Return a line for each round."""
    lines = [
        f"{r.title.capitalize()}: {r.pairs:,} pairs, {r.correct:,} with more than "
        f"{CORRECT_MATCHES} verified matches"
        + (f" ({100 * r.correct / r.pairs:.0f} %)" if r.pairs else "")
        for r in report.rounds
    ]
    spent = report.matches.requested
    if spent < report.budget:
        lines.append(f"Stopped at {spent:,} of {report.budget:,} pairs: nothing promising is left.")
    return lines


def plan_budget(k: int, num_images: int) -> int:
    """Return the pairs that one round of `k` partners could match: k times the images."""
    possible = num_images * (num_images - 1) // 2
    return min(k * num_images, possible)


@dataclass
class _Plan:
    """The pairs of each round as indices, kept in the cache before they are matched."""

    cache: Path
    key: str
    rounds: list[list[IndexPair]] = field(default_factory=list)
    connecting: list[IndexPair] | None = None

    @classmethod
    def load(cls, project: Project, ranking: Ranking, budget: int, rounds: int) -> _Plan:
        digest = hashlib.sha256(repr((ranking.names, budget, rounds)).encode())
        digest.update(np.ascontiguousarray(ranking.partners).tobytes())
        key = digest.hexdigest()
        plan = cls(project.cache, key)
        with Store(project.cache) as store:
            text = store.setting(PLAN_SETTING)
        kept = json.loads(text) if text else {}
        if kept.get("key") == key:
            plan.rounds = [[(i, j) for i, j in chosen] for chosen in kept["rounds"]]
            if kept["connecting"] is not None:
                plan.connecting = [(i, j) for i, j in kept["connecting"]]
        return plan

    def save(self) -> None:
        text = json.dumps({"key": self.key, "rounds": self.rounds, "connecting": self.connecting})
        with Store(self.cache) as store:
            store.remember(PLAN_SETTING, text)


def _check(project: Project, ranking: Ranking, budget: int, rounds: int) -> dict[str, int]:
    with open_database(project.database) as database:
        ids = {image.name: image.image_id for image in database.images()}
    if tuple(ids) != ranking.names:
        raise InputError(
            f"The ranking is of {len(ranking.names)} other images than the {len(ids)} in "
            f"{project.database}; make it from this database."
        )
    if rounds < 1:
        raise InputError(f"`rounds` is {rounds}; it must be at least 1.")
    least = (len(ids) + 1) // 2
    if budget < least:
        raise InputError(
            f"The budget of {budget} pairs is too small: {len(ids)} images need at least "
            f"{least} for each to be in one pair; raise `k` or `budget`."
        )
    return ids


@dataclass
class _Run:
    """One call of `match_in_rounds`."""

    project: Project
    ranking: Ranking
    budget: int
    rounds: int
    matching: MatchOptions
    ids: dict[str, int]
    plan: _Plan
    matcher: str = MATCHER_DEFAULT
    even_seconds: float = 0.0

    def spend(self) -> RoundsReport:
        similarity = similarity_matrix(self.ranking)
        reports: list[RoundReport] = []
        allowed = 0
        for number, size in enumerate(split_budget(self.budget, self.rounds)):
            # What an earlier round did not want is there for the later ones.
            allowed += size
            spent = sum(len(chosen) for chosen in self.plan.rounds[:number])
            reports.append(self._round(number, allowed - spent, similarity))
            if reports[-1].pairs == 0:
                break
        connecting = self._connect(similarity)
        if connecting.pairs:
            reports.append(connecting)
        return self._report(reports)

    def _round(self, number: int, room: int, similarity: sparse.csr_array) -> RoundReport:
        start = time.perf_counter()
        if number == len(self.plan.rounds):
            weights = FITTED[self.ranking.compared]
            names, verified = self.ranking.names, self._verified()
            latest = self.plan.rounds[-1] if number else ()
            chosen = next_round(similarity, verified, names, room, weights, latest)
            self.plan.rounds.append(chosen)
            self.plan.save()
        seconds = time.perf_counter() - start
        title = f"round {number + 1} of {self.rounds}"
        return self._match(self.plan.rounds[number], title, seconds)

    def _connect(self, similarity: sparse.csr_array) -> RoundReport:
        """Try pairs between the components of the verified view graph, if there are several."""
        start = time.perf_counter()
        if self.plan.connecting is None:
            verified = self._verified()
            self.plan.connecting = connecting_pairs(
                similarity,
                components(len(self.ids), _correct(verified)),
                verified,
                self.ranking.names,
                connecting_budget(self.budget),
            )
            self.plan.save()
        seconds = time.perf_counter() - start
        return self._match(self.plan.connecting, "connecting", seconds)

    def _match(self, chosen: Sequence[IndexPair], title: str, choosing: float) -> RoundReport:
        names = self.ranking.names
        pairs = [(names[i], names[j]) for i, j in chosen]
        seconds, given_up = 0.0, 0
        if pairs:
            report = match_pairs(self.project.database, pairs, self.matching)
            seconds, given_up, self.matcher = report.seconds, report.given_up, report.matcher
            self.even_seconds += report.even_seconds
        verified = self._verified()
        correct = sum(verified.get(pair, 0) > CORRECT_MATCHES for pair in chosen)
        return RoundReport(title, len(chosen), correct, choosing, seconds, given_up)

    def _verified(self) -> dict[IndexPair, int]:
        """Return the verified matches of every matched pair, by indices into the names."""
        place = {image_id: i for i, image_id in enumerate(self.ids.values())}
        with open_database(self.project.database) as database:
            found = database.verified_matches()
        return {
            (min(place[a], place[b]), max(place[a], place[b])): count
            for (a, b), count in found.items()
        }

    def _report(self, reports: list[RoundReport]) -> RoundsReport:
        verified = self._verified()
        chosen = {pair for part in self.plan.rounds for pair in part}
        chosen.update(self.plan.connecting or [])
        matches = MatchReport(
            requested=len(chosen),
            already=0,
            matched=len(chosen),
            verified=sum(verified.get(pair, 0) > 0 for pair in chosen),
            seconds=sum(r.seconds_choosing + r.seconds_matching for r in reports),
            given_up=sum(r.given_up for r in reports),
            matcher=self.matcher,
            even_seconds=self.even_seconds,
        )
        return RoundsReport(matches, reports, self.budget)


def _correct(verified: dict[IndexPair, int]) -> list[IndexPair]:
    return [pair for pair, count in verified.items() if count > CORRECT_MATCHES]
