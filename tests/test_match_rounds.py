"""Rounds on a rendered flight: budget, resume, and what is said when nothing matches."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ranks import rank

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.graph.verified import verified_components
from colmap_netvlad.matching import rounds as match_rounds
from colmap_netvlad.matching.rounds import match_in_rounds, plan_budget
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError


@pytest.fixture
def flight_ranking(project_copy: Callable[..., Project]) -> tuple[Project, Ranking]:
    project = project_copy()
    return project, rank(project, "vlad", RetrievalOptions(k=11))


def matched(project: Project) -> set[tuple[int, int]]:
    with open_database(project.database) as database:
        return database.matched_pairs()


def test_the_budget_is_kept_and_the_pairs_are_in_the_database(
    flight_ranking: tuple[Project, Ranking],
) -> None:
    project, ranking = flight_ranking
    report = match_in_rounds(project, ranking, budget=18, rounds=3)
    assert sum(r.pairs for r in report.rounds if r.title != "connecting") <= 18
    assert report.matches.requested == len(matched(project))
    assert [r.title for r in report.rounds][:2] == ["round 1 of 3", "round 2 of 3"]
    assert len(verified_components(project.database)[0]) == 12


def test_a_killed_run_goes_on_with_the_same_pairs(
    flight_ranking: tuple[Project, Ranking],
    project_copy: Callable[..., Project],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    project, ranking = flight_ranking
    undisturbed = match_in_rounds(project, ranking, budget=18, rounds=3)

    killed = project_copy(name="killed")
    whole = match_rounds.match_pairs
    calls = []

    def dies_in_the_second_round(
        database: Path, pairs: list[tuple[str, str]], *rest: object
    ) -> object:
        calls.append(len(pairs))
        if len(calls) == 2:
            whole(database, pairs[:2], *rest)  # type: ignore[arg-type]
            raise KeyboardInterrupt
        return whole(database, pairs, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(match_rounds, "match_pairs", dies_in_the_second_round)
    with pytest.raises(KeyboardInterrupt):
        match_in_rounds(killed, ranking, budget=18, rounds=3)
    monkeypatch.setattr(match_rounds, "match_pairs", whole)
    resumed = match_in_rounds(killed, ranking, budget=18, rounds=3)
    assert matched(killed) == matched(project)
    assert [(r.title, r.pairs, r.correct) for r in resumed.rounds] == [
        (r.title, r.pairs, r.correct) for r in undisturbed.rounds
    ]


def test_running_again_matches_nothing_more(flight_ranking: tuple[Project, Ranking]) -> None:
    project, ranking = flight_ranking
    match_in_rounds(project, ranking, budget=12, rounds=2)
    before = matched(project)
    match_in_rounds(project, ranking, budget=12, rounds=2)
    assert matched(project) == before


def test_where_everything_fails_the_rounds_stop_early(
    flight_ranking: tuple[Project, Ranking],
) -> None:
    project, ranking = flight_ranking
    rng = np.random.default_rng(0)
    with closing(sqlite3.connect(project.database)) as connection:
        rows = connection.execute("SELECT image_id, rows FROM descriptors").fetchall()
        for image_id, count in rows:
            noise = rng.integers(0, 256, (count, 128), dtype=np.uint8).tobytes()
            connection.execute(
                "UPDATE descriptors SET data = ? WHERE image_id = ?", (noise, image_id)
            )
        connection.commit()
    report = match_in_rounds(project, ranking, budget=60, rounds=6)
    assert sum(r.correct for r in report.rounds) == 0
    assert sum(r.pairs for r in report.rounds) < 60
    assert len(verified_components(project.database)) == 12


def test_a_ranking_of_other_images_is_one_sentence(
    flight_ranking: tuple[Project, Ranking],
) -> None:
    project, ranking = flight_ranking
    other = replace(ranking, names=tuple(reversed(ranking.names)))
    with pytest.raises(InputError, match="make it from this database"):
        match_in_rounds(project, other, budget=18)


@pytest.mark.parametrize(
    ("budget", "rounds", "said"), [(5, 3, "at least 6"), (18, 0, "`rounds` is 0")]
)
def test_too_small_a_budget_is_one_sentence_and_matches_nothing(
    flight_ranking: tuple[Project, Ranking], budget: int, rounds: int, said: str
) -> None:
    project, ranking = flight_ranking
    with pytest.raises(InputError, match=said):
        match_in_rounds(project, ranking, budget, rounds)
    assert matched(project) == set()


def test_a_budget_is_never_more_than_all_pairs(flight_database: Path) -> None:
    count = len(image_names(flight_database))
    assert plan_budget(1000, count) == count * (count - 1) // 2
    assert plan_budget(2, count) == 2 * count
