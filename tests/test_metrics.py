"""The measures of section 4.1.2, by hand-computed cases and by properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ranks import from_lists
from sklearn.metrics import average_precision_score

from colmap_netvlad import metrics
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.graph.pair import as_pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES, correct_pairs

NAMES = ("a", "b", "c", "d", "e")


def ranking_of(lists: list[list[int]], **times: float) -> Ranking:
    rows = [[(j, 1.0 - r / 10) for r, j in enumerate(row)] for row in lists]
    return from_lists(NAMES[: len(lists)], rows, "hand", **times)


def test_sixteen_matches_are_correct_and_fifteen_are_not():
    verified = {("a", "b"): 15, ("a", "c"): 16, ("b", "c"): 0}
    assert correct_pairs(verified) == {("a", "c")}


def test_accuracy_is_correct_pairs_over_retrieved_pairs():
    verified = {("a", "b"): 100, ("a", "c"): 3, ("c", "d"): 16}
    retrieved = [("b", "a"), ("a", "c"), ("d", "c"), ("a", "e")]
    assert metrics.accuracy(retrieved, verified) == 2 / 4


def test_accuracy_counts_a_pair_given_twice_once():
    assert metrics.accuracy([("a", "b"), ("b", "a"), ("a", "c")], {("a", "b"): 99}) == 1 / 2


def test_accuracy_of_nothing_is_not_a_number():
    assert math.isnan(metrics.accuracy([], {("a", "b"): 99}))


def test_recall_is_the_share_of_true_pairs_found():
    truth = [("a", "b"), ("a", "c"), ("d", "c")]
    assert metrics.recall([("b", "a"), ("c", "d"), ("a", "e")], truth) == 2 / 3
    assert math.isnan(metrics.recall([("a", "b")], []))


def test_average_precision_by_hand():
    # a's true partners b, c, d are at ranks 1, 3 and nowhere: (1/1 + 2/3 + 0) / 3.
    ranking = ranking_of([[1, 4, 2], [0], [0], [], []])
    precisions = metrics.average_precisions(ranking, [("a", "b"), ("a", "c"), ("a", "d")])
    assert precisions["a"] == pytest.approx((1 + 2 / 3) / 3)
    assert precisions["b"] == precisions["c"] == 1.0
    assert precisions["d"] == 0.0
    assert "e" not in precisions


def test_average_precision_of_a_cut_list_is_over_what_it_can_show():
    ranking = ranking_of([[1, 2], [0, 2], [0, 1], [0, 1], [0, 1]])
    truth = [("a", "b"), ("a", "c"), ("a", "d"), ("a", "e")]
    assert metrics.average_precisions(ranking, truth)["a"] == 1.0


def test_a_method_with_shorter_lists_is_not_favoured():
    truth = [("a", "b"), ("a", "c"), ("a", "d"), ("a", "e")]
    short = ranking_of([[1, 2], [], [], [], []])
    assert short.depth == 2
    assert metrics.average_precisions(short, truth, depth=4)["a"] == 2 / 4
    assert metrics.mean_average_precision(short, truth, depth=4) == pytest.approx(2 / 4 / 5)


def test_mean_average_precision_without_truth_is_not_a_number():
    assert math.isnan(metrics.mean_average_precision(ranking_of([[1], [0]]), []))


def test_efficiency_is_the_sum_of_both_times():
    ranking = ranking_of([[1], [0]], seconds_describe=2.5, seconds_search=0.25)
    assert metrics.efficiency(ranking) == 2.75


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Ranking, set[tuple[str, str]]]:
    n = draw(st.integers(2, 9))
    names = tuple(f"i{i}" for i in range(n))
    lists = []
    for i in range(n):
        order = draw(st.permutations([j for j in range(n) if j != i]))
        lists.append([(j, -float(r)) for r, j in enumerate(order)])
    every = [(names[i], names[j]) for i in range(n) for j in range(i + 1, n)]
    return from_lists(names, lists, "random"), draw(st.sets(st.sampled_from(every), min_size=1))


def pairs_of(ranking: Ranking, k: int) -> set[tuple[str, str]]:
    return {
        as_pair(ranking.names[i], ranking.names[j])
        for i, row in enumerate(ranking.top(k).partners.tolist())
        for j in row
    }


@settings(deadline=None)
@given(scenes(), st.integers(1, 8))
def test_accuracy_times_retrieved_equals_recall_times_truth(scene, k):
    ranking, truth = scene
    retrieved = pairs_of(ranking, k)
    verified = dict.fromkeys(truth, CORRECT_MATCHES + 1)
    found_by_accuracy = metrics.accuracy(retrieved, verified) * len(retrieved)
    assert found_by_accuracy == pytest.approx(metrics.recall(retrieved, truth) * len(truth))


@settings(deadline=None)
@given(scenes())
def test_full_rankings_recall_everything_and_precision_is_in_range(scene):
    ranking, truth = scene
    assert metrics.recall(pairs_of(ranking, ranking.depth), truth) == 1.0
    assert 0 < metrics.mean_average_precision(ranking, truth) <= 1


@settings(deadline=None)
@given(scenes())
def test_true_partners_first_gives_precision_one(scene):
    ranking, truth = scene
    index = {name: i for i, name in enumerate(ranking.names)}
    true = {(index[a], index[b]) for a, b in truth} | {(index[b], index[a]) for a, b in truth}
    partners = np.array(
        [
            sorted(row, key=lambda j, i=i: (i, j) not in true)
            for i, row in enumerate(ranking.partners.tolist())
        ],
        dtype=np.int32,
    )
    best = Ranking(ranking.names, partners, ranking.scores, "oracle")
    assert metrics.mean_average_precision(best, truth) == 1.0


@settings(deadline=None)
@given(scenes())
def test_average_precision_equals_scikit_learns(scene):
    ranking, truth = scene
    true_of: dict[str, set[str]] = {}
    for a, b in truth:
        true_of.setdefault(a, set()).add(b)
        true_of.setdefault(b, set()).add(a)
    for i, name in enumerate(ranking.names):
        if name in true_of:
            labels = [ranking.names[j] in true_of[name] for j in ranking.partners[i]]
            expected = average_precision_score(labels, ranking.scores[i])
            ours = metrics.average_precisions(ranking, truth)[name]
            assert ours == pytest.approx(expected)
