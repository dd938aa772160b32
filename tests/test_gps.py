"""Nearness is added to similarity, and excludes nobody."""

from __future__ import annotations

import numpy as np
import pytest
from ranks import from_lists
from scipy import sparse

from colmap_netvlad.cache.ranking import NO_PARTNER
from colmap_netvlad.photos.positions import Positions
from colmap_netvlad.retrieval.gps import NEUTRAL, add_nearness, near_first


def on_a_line(*x: float) -> Positions:
    metres = np.array([[value, 0.0, 100.0] for value in x])
    return Positions(metres, ())


def uniform(n: int) -> sparse.csr_array:
    return sparse.csr_array(np.ones((n, n)) - np.eye(n))


def test_near_photos_gain_more_than_far_ones() -> None:
    scores = add_nearness(uniform(4), on_a_line(0, 10, 20, 1000), 1, 2.0).toarray()
    assert np.allclose(scores, scores.T)
    assert scores[0, 1] > scores[0, 2] > scores[0, 3] >= 1.0
    assert scores.max() <= 3.0


def test_a_photo_without_a_position_neither_gains_nor_loses() -> None:
    positions = on_a_line(0, 10, np.nan, 30)
    scores = add_nearness(uniform(4), positions, 2, 2.0).toarray()
    assert scores[2, [0, 1, 3]] == pytest.approx([1 + 2.0 * NEUTRAL] * 3)


def test_heights_do_not_count() -> None:
    positions = on_a_line(0, 10, 20)
    raised = Positions(positions.metres + np.diag([0, 500, 0])[:, [0, 2, 1]], ())
    one = add_nearness(uniform(3), positions, 1, 1.0).toarray()
    assert np.allclose(one, add_nearness(uniform(3), raised, 1, 1.0).toarray())


def test_neighbours_on_the_ground_become_candidates() -> None:
    nobody = sparse.csr_array((3, 3))
    scores = add_nearness(nobody, on_a_line(0, 10, 500), 1, 1.0).toarray()
    assert scores[0, 1] > 0.5
    assert scores.diagonal().tolist() == [0, 0, 0]


def test_without_positions_nothing_changes_in_the_order() -> None:
    positions = on_a_line(np.nan, np.nan, np.nan)
    similarity = sparse.csr_array(np.array([[0, 2, 1], [2, 0, 3], [1, 3, 0]], float))
    scores = add_nearness(similarity, positions, 1, 1.0).toarray()
    assert scores == pytest.approx(similarity.toarray() + NEUTRAL * (1 - np.eye(3)))


def test_near_first_keeps_those_left_out_without_partners() -> None:
    ranking = from_lists(
        ("a", "b", "c", "d"),
        [[(1, 0.2), (2, 0.9)], [(0, 0.2), (2, 0.1)], [(0, 0.9), (1, 0.1)], []],
        "deep",
        left_out=(("d", "is empty"),),
    )
    nearer = near_first(ranking, on_a_line(0, 1, 900, 2)).top(1)
    assert nearer.partners[3].tolist() == [NO_PARTNER]
    assert 3 not in nearer.partners[:3]
    assert "positions of 3 of 4 photos used" in nearer.notes


def test_useless_positions_leave_the_ranking_as_it_is() -> None:
    ranking = from_lists(("a", "b", "c"), [[(2, 2.0), (1, 1.0)], [(0, 1.0)], [(0, 1.0)]], "deep")
    nearer = near_first(ranking, on_a_line(np.nan, np.nan, np.nan))
    assert nearer.partners.tolist() == ranking.partners.tolist()
