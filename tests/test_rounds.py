"""Matching in rounds: what is chosen, and that nobody starves."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ranks import from_lists
from scipy import sparse

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.pairs.rounds import (
    FITTED,
    LEAST_PROBABILITY,
    SATURATION,
    find_candidates,
    least_probability,
    next_round,
    split_budget,
    take_turns,
)
from colmap_netvlad.retrieval.fusion import similarity_matrix


@st.composite
def flights(draw: st.DrawFn) -> tuple[Ranking, dict[tuple[int, int], int]]:
    """A random ranking of 2 to 12 images and random results of some tested pairs."""
    n = draw(st.integers(2, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    similarity = rng.normal(size=(n, n)).round(draw(st.integers(0, 3)))
    similarity = similarity + similarity.T
    depth = draw(st.integers(1, n - 1))
    lists = [
        sorted(((j, similarity[i, j]) for j in range(n) if j != i), key=lambda p: (-p[1], p[0]))
        for i in range(n)
    ]
    names = tuple(f"{c:03d}.jpg" for c in rng.permutation(n))
    ranking = from_lists(names, [row[:depth] for row in lists], "test")
    tested = {
        pair: int(rng.choice([0, CORRECT_MATCHES, CORRECT_MATCHES + 1, 60, 500]))
        for pair in combinations(range(n), 2)
        if rng.random() < draw(st.floats(0, 0.7))
    }
    return ranking, tested


@given(flights(), st.integers(0, 80))
@settings(max_examples=60, deadline=None)
def test_the_budget_is_never_exceeded_and_no_pair_is_tested_twice(
    flight: tuple[Ranking, dict[tuple[int, int], int]], budget: int
) -> None:
    ranking, tested = flight
    chosen = next_round(similarity_matrix(ranking), tested, ranking.names, budget)
    assert len(chosen) <= budget
    assert len(set(chosen)) == len(chosen)
    assert all(i < j for i, j in chosen)
    assert not set(chosen) & set(tested)


@given(flights(), st.integers(0, 80))
@settings(max_examples=60, deadline=None)
def test_every_image_is_served_before_any_takes_a_second_turn(
    flight: tuple[Ranking, dict[tuple[int, int], int]], budget: int
) -> None:
    ranking, _ = flight
    similarity = similarity_matrix(ranking)
    candidates = find_candidates(similarity, {})
    value = candidates.evidence[:, 0]
    chosen = take_turns(candidates.first, candidates.second, value, ranking.names, budget)
    best = dict(zip(zip(candidates.first, candidates.second, strict=True), value, strict=True))
    served = {image for pair in chosen for image in pair}
    starving = {image for pair in best for image in pair} - served
    if starving:
        # Somebody starves only while the budget did not last for one turn each: then every
        # chosen pair is the best pair of one of its images.
        for i, j in chosen:
            rivals_i = max(v for pair, v in best.items() if i in pair)
            rivals_j = max(v for pair, v in best.items() if j in pair)
            assert best[i, j] in (rivals_i, rivals_j)


@given(flights(), st.integers(1, 80), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_the_choice_does_not_depend_on_the_order_of_the_images(
    flight: tuple[Ranking, dict[tuple[int, int], int]], budget: int, seed: int
) -> None:
    ranking, tested = flight
    n = len(ranking.names)
    new_of_old = np.random.default_rng(seed).permutation(n)
    names = [""] * n
    lists: list[list[tuple[int, float]]] = [[] for _ in range(n)]
    for old, new in enumerate(new_of_old):
        names[new] = ranking.names[old]
        lists[new] = [
            (int(new_of_old[p]), float(s))
            for p, s in zip(ranking.partners[old], ranking.scores[old], strict=True)
            if p >= 0
        ]
    shuffled = from_lists(tuple(names), lists, "test")
    shuffled_tested = {
        (min(a, b), max(a, b)): count
        for (a, b), count in (
            ((int(new_of_old[i]), int(new_of_old[j])), c) for (i, j), c in tested.items()
        )
    }

    def named(of: Ranking, verified: dict[tuple[int, int], int]) -> set[frozenset[str]]:
        chosen = next_round(similarity_matrix(of), verified, of.names, budget)
        return {frozenset((of.names[i], of.names[j])) for i, j in chosen}

    assert named(ranking, tested) == named(shuffled, shuffled_tested)


@given(flights())
@settings(max_examples=40, deadline=None)
def test_the_evidence_equals_its_definition_written_out(
    flight: tuple[Ranking, dict[tuple[int, int], int]],
) -> None:
    ranking, tested = flight
    n = len(ranking.names)
    similarity = similarity_matrix(ranking)
    dense = similarity.toarray()
    assert np.allclose(dense, dense.T)
    strength, correct, failed = (np.zeros((n, n)) for _ in range(3))
    for (i, j), count in tested.items():
        for a, b in ((i, j), (j, i)):
            good = count > CORRECT_MATCHES
            correct[a, b] = good
            failed[a, b] = not good
            strength[a, b] = min(count / SATURATION, 1) if good else 0
    candidates = find_candidates(similarity, tested)
    for i, j, row in zip(candidates.first, candidates.second, candidates.evidence, strict=True):
        agreeing = sum(
            strength[i, m] * correct[m, j] + strength[j, m] * correct[m, i] for m in range(n)
        )
        failing = sum(
            strength[i, m] * failed[m, j] + strength[j, m] * failed[m, i] for m in range(n)
        )
        support = sum(
            strength[i, m] * dense[m, j] / max(strength[i].sum(), 1)
            + strength[j, m] * dense[m, i] / max(strength[j].sum(), 1)
            for m in range(n)
        )
        expected = [
            dense[i, j],
            np.log1p(agreeing),
            np.log1p(failing),
            np.log((agreeing + 0.5) / (agreeing + failing + 1.5)),
            support,
        ]
        assert row == pytest.approx(expected, abs=1e-9)


def test_a_pair_whose_neighbours_verify_comes_before_one_whose_neighbours_fail() -> None:
    # 0-1 and 1-2 verified, 0-3 and 3-4 tested: 3 overlaps with 0, but 4 failed against 3's kin.
    ranking = from_lists(
        tuple("abcdef"),
        [[(j, 1.0) for j in range(6) if j != i] for i in range(6)],
        "flat",
    )
    tested = {(0, 1): 80, (1, 2): 80, (0, 3): 80, (1, 4): 0, (0, 4): 0, (2, 4): 0}
    chosen = next_round(similarity_matrix(ranking), tested, ranking.names, 20)
    place = {pair: rank for rank, pair in enumerate(chosen)}
    assert place[0, 2] < place.get((3, 4), 99)
    assert place[1, 3] < place.get((3, 4), 99)


def test_a_later_round_stops_where_nothing_is_promising() -> None:
    ranking = from_lists(
        tuple("abcd"), [[(j, 1.0) for j in range(4) if j != i] for i in range(4)], "flat"
    )
    similarity = similarity_matrix(ranking)
    failed = {(0, 1): 0, (0, 2): 0, (1, 2): 0}
    assert next_round(similarity, failed, ranking.names, 10) == []
    all_tested = dict.fromkeys(combinations(range(4), 2), 80)
    assert next_round(similarity, all_tested, ranking.names, 10) == []
    assert next_round(similarity, {(0, 1): 80}, ranking.names, 10) != []


def test_a_round_that_did_better_than_was_probable_lets_the_next_go_on() -> None:
    # A strip of 40 images whose ranking says nothing: partners of partners are all that is known.
    names = tuple(f"{i:02d}" for i in range(40))
    lists = [[(j, 1.0) for j in range(i - 6, i + 7) if j != i and 0 <= j < 40] for i in range(40)]
    similarity = similarity_matrix(from_lists(names, lists, "flat"))
    before = {(i, i + 1): 40 for i in range(0, 39, 2)}
    latest = [(i, i + 1) for i in range(1, 39, 2)]
    weights = FITTED[True]

    def least(count: int) -> float:
        return least_probability(similarity, before | dict.fromkeys(latest, count), weights, latest)

    assert least(0) == LEAST_PROBABILITY == least_probability(similarity, before, weights, ())
    assert 0.0 < least(40) < LEAST_PROBABILITY / 2
    tested = before | dict.fromkeys(latest, 40)
    careful, bold = (
        next_round(similarity, tested, names, 999, weights, pairs) for pairs in ([], latest)
    )
    assert set(careful) < set(bold)


def test_an_image_with_two_candidates_is_not_starved_by_a_crowd() -> None:
    first = [0, 0, 0, 1, 1, 2, 3]
    second = [1, 2, 3, 2, 3, 3, 4]
    value = [0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.1]
    chosen = take_turns(first, second, value, tuple("abcde"), 4)
    assert (3, 4) in chosen
    turns = Counter(image for pair in chosen for image in pair)
    assert set(turns) == {0, 1, 2, 3, 4}


@given(st.integers(0, 1000), st.integers(1, 12))
def test_rounds_share_the_budget(budget: int, rounds: int) -> None:
    sizes = split_budget(budget, rounds)
    assert sum(sizes) == budget
    assert max(sizes) - min(sizes) <= 1


def test_candidates_stay_sparse_on_a_long_flight() -> None:
    n, depth = 3000, 20
    rng = np.random.default_rng(0)
    partners = (np.arange(n)[:, None] + 1 + np.arange(depth)) % n
    scores = rng.random((n, depth)).astype(np.float32)
    order = np.argsort(-scores, axis=1)
    ranking = Ranking(
        tuple(f"{i:05d}" for i in range(n)),
        np.take_along_axis(partners, order, 1).astype(np.int32),
        np.take_along_axis(scores, order, 1),
        "line",
    )
    similarity = similarity_matrix(ranking)
    assert sparse.issparse(similarity)
    assert similarity.nnz <= 2 * n * depth
    tested = dict.fromkeys(next_round(similarity, {}, ranking.names, n), 50)
    assert len(find_candidates(similarity, tested).first) < n * depth * depth
