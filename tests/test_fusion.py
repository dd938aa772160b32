"""Rankings add up without a dense matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ranks import from_lists
from scipy import sparse

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.retrieval.fusion import (
    USUAL,
    above,
    combine,
    expand,
    keep_best,
    ranking_of,
    similarity_matrix,
)
from colmap_netvlad.runtime.errors import InputError


def full_ranking(scores: np.ndarray, method: str = "test", depth: int | None = None) -> Ranking:
    n = len(scores)
    lists = [
        sorted(((j, float(scores[i, j])) for j in range(n) if j != i), key=lambda p: -p[1])
        for i in range(n)
    ]
    return from_lists(tuple(f"{i}.jpg" for i in range(n)), [row[:depth] for row in lists], method)


seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.integers(2, 10))
@settings(max_examples=40, deadline=None)
def test_similarities_are_symmetric_and_do_not_change_with_the_unit(seed: int, n: int) -> None:
    scores = np.random.default_rng(seed).normal(size=(n, n))
    plain = similarity_matrix(full_ranking(scores)).toarray()
    scaled = similarity_matrix(full_ranking(scores * 100 + 7)).toarray()
    assert np.allclose(plain, plain.T)
    assert (plain[~np.eye(n, dtype=bool)] > 0).all()
    assert np.allclose(plain, scaled, atol=1e-3)


@given(seeds, st.integers(3, 10), st.integers(1, 4), st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_expansion_equals_its_definition_written_out(
    seed: int, n: int, neighbours: int, share: float
) -> None:
    similarity = similarity_matrix(full_ranking(np.random.default_rng(seed).normal(size=(n, n))))
    dense = similarity.toarray()
    expected = np.zeros_like(dense)
    for i in range(n):
        best = np.argsort(-dense[i], kind="stable")[:neighbours]
        weights = dense[i, best] / dense[i, best].sum()
        expected[i] = (1 - share) * dense[i] + share * (weights @ dense[best])
    np.fill_diagonal(expected, 0)
    expected = (expected + expected.T) / 2
    assert np.allclose(expand(similarity, neighbours, share, n).toarray(), expected)


@given(seeds, st.integers(2, 12))
@settings(max_examples=40, deadline=None)
def test_what_is_above_the_usual_has_the_same_unit_in_all_lists(seed: int, n: int) -> None:
    scores = np.random.default_rng(seed).normal(size=(n, n))
    scores += scores.T
    others = ~np.eye(n, dtype=bool)
    expected = np.maximum(scores - scores[others].mean(), 0) / max(scores[others].std(), 1e-12)
    np.fill_diagonal(expected, 0)
    np.testing.assert_allclose(above(full_ranking(scores)).toarray(), expected, atol=1e-4)
    moved = above(full_ranking(scores * 100 + 7)).toarray()
    np.testing.assert_allclose(moved, expected, atol=1e-3)


def test_an_image_without_neighbours_stays_without() -> None:
    """Standardised row by row, it would be as sure of its nearest as any other image."""
    scores = np.full((6, 6), 0.1)
    scores[0, 1] = scores[1, 0] = scores[2, 3] = scores[3, 2] = 1.0
    scores[4, 5] = scores[5, 4] = 0.11
    similar = above(full_ranking(scores)).toarray()
    assert similar[0, 1] > 1 and similar[4, 5] == 0
    assert similarity_matrix(full_ranking(scores))[4, 5] > 0


def test_the_best_partners_alone_tell_what_is_usual() -> None:
    n = USUAL + 40
    scores = np.where(np.arange(n) < USUAL, 1.0, -100.0) + np.eye(n)
    lists = full_ranking(scores + scores.T)
    cut = lists.top(USUAL)
    np.testing.assert_allclose(above(lists).toarray(), above(cut).toarray())


def test_two_weak_rankings_that_agree_beat_one_strong_voice() -> None:
    a, b = np.zeros((4, 4)), np.zeros((4, 4))
    a[0], b[0] = [0, 3, 2, 0], [0, 0, 2, 3]
    a[0, 3] = b[0, 1] = -3
    sources = [(full_ranking(scores + scores.T), 1.0) for scores in (a, b)]
    assert combine(sources, "hybrid", 3).partners[0, 0] == 2


def test_the_neighbours_of_neighbours_come_before_strangers() -> None:
    """0 and 2 share nothing that their descriptors see, but both are surely neighbours of 1."""
    scores = np.zeros((8, 8))
    for i, j in ((0, 1), (1, 2), (4, 5), (6, 7)):
        scores[i, j] = scores[j, i] = 1.0
    scores[0, 2] = scores[2, 0] = -0.01
    found = combine([(full_ranking(scores), 1.0)], "deep", 7)
    assert set(found.partners[0, :2].tolist()) == {1, 2}
    assert sorted(found.partners[0].tolist()) == [1, 2, 3, 4, 5, 6, 7], "nobody is lost"


def test_images_that_one_ranking_has_are_in_the_sum() -> None:
    names = ("a", "b", "c")
    gone = np.array([[NO_PARTNER] * 2, [2, NO_PARTNER], [1, NO_PARTNER]], np.int32)
    scores = np.where(gone == NO_PARTNER, -np.inf, 1.0).astype(np.float32)
    without = Ranking(names, gone, scores, "deep", 1.0, 2.0, ("deep note",), (("a", "blurred"),))
    whole = replace(full_ranking(np.ones((3, 3))), names=names, notes=("vlad note",))
    both = combine([(without, 1.0), (whole, 0.5)], "hybrid", 2)
    assert (both.partners != NO_PARTNER).all() and both.left_out == ()
    assert both.notes == ("deep note", "vlad note")
    assert both.seconds_describe == 1.0 and both.seconds_search > 2.0
    alone = combine([(without, 1.0)], "deep", 2)
    assert (alone.partners[0] == NO_PARTNER).all() and alone.left_out == without.left_out


def test_rankings_of_different_images_are_refused_in_one_sentence() -> None:
    one = full_ranking(np.eye(3))
    other = full_ranking(np.eye(4), "vlad")
    with pytest.raises(InputError, match="different image sets"):
        combine([(one, 1.0), (other, 1.0)], "hybrid", 2)


@given(seeds, st.integers(1, 12), st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_keep_best_keeps_the_largest_of_each_row(seed: int, n: int, depth: int) -> None:
    dense = np.random.default_rng(seed).random((n, n)).round(2)
    kept = keep_best(sparse.csr_array(dense), depth).toarray()
    for full, row in zip(dense, kept, strict=True):
        wanted = np.sort(full[full > 0])[::-1][:depth]
        assert np.sort(row[row > 0])[::-1].tolist() == wanted.tolist()


def test_a_ranking_lists_no_image_itself_and_pads_the_rest() -> None:
    similarity = sparse.csr_array(np.array([[0, 2, 1], [2, 0, 0], [1, 0, 0]], float))
    ranking = ranking_of(similarity, ("a", "b", "c"), "hybrid", 5)
    assert ranking.partners.tolist() == [[1, 2], [0, NO_PARTNER], [0, NO_PARTNER]]
    assert ranking.scores[1, 1] == -np.inf


def test_equal_scores_are_ordered_by_name() -> None:
    similarity = sparse.csr_array(np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]], float))
    assert ranking_of(similarity, ("c", "b", "a"), "hybrid", 2).partners[0].tolist() == [2, 1]
