"""What is asked to be compared: the likely pairs, a few at a time, and no more than these."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.retrieval.asking import AT_A_TIME, LISTED, PARTNERS, Asking

IMAGES = 90
USUAL = 7

NOTHING = sparse.csr_array((IMAGES, IMAGES))


def in_a_circle() -> NDArray[np.float64]:
    """(N, N) 1 / rank where each image's candidates are the nearest on a circle."""
    apart = np.abs(np.subtract.outer(np.arange(IMAGES), np.arange(IMAGES)))
    apart = np.minimum(apart, IMAGES - apart).astype(np.float64)
    ranks = np.argsort(np.argsort(apart, axis=1, kind="stable"), axis=1)
    return np.divide(1.0, ranks, out=np.zeros_like(apart), where=ranks > 0)


def symmetric(pairs: list[tuple[int, int]], value: float = 1.0) -> sparse.csr_array:
    matrix = np.zeros((IMAGES, IMAGES))
    for i, j in pairs:
        matrix[i, j] = matrix[j, i] = value
    return sparse.csr_array(matrix)


ACROSS = range(IMAGES // 2 - PARTNERS // 2, IMAGES // 2)

PLENTY = symmetric([(i, (i + apart) % IMAGES) for i in range(IMAGES) for apart in ACROSS])
"""Each image has as many sure partners as make it stop, far from what it asks for."""


def ask_all(
    asking: Asking, votes: sparse.csr_array = NOTHING, sure: sparse.csr_array = PLENTY
) -> tuple[NDArray[np.bool_], int]:
    """Ask to the end, compare all that is asked for: (who asked for whom, passes)."""
    asked, compared, passes = np.zeros((IMAGES, IMAGES), np.bool_), NOTHING, 0
    while (chosen := asking.next(votes, compared, sure)).nnz:
        new = chosen.toarray() > 0
        assert not (new & (compared.toarray() > 0)).any(), "what was compared is not asked again"
        assert (new.sum(axis=1) <= AT_A_TIME).all()
        asked |= new
        compared = sparse.csr_array((asked | asked.T).astype(np.float64))
        passes += 1
    return asked, passes


def test_the_best_of_both_lists_are_asked_for_first() -> None:
    asking = Asking(sparse.csr_array(in_a_circle()), IMAGES - 1)
    first = asking.next(NOTHING, NOTHING, PLENTY).toarray() > 0
    half = AT_A_TIME // 2
    for i in range(IMAGES):
        near = {(i + d) % IMAGES for d in range(-half, half + 1) if d}
        assert set(np.flatnonzero(first[i])) == near


def test_who_has_partners_stops_where_none_is_likely_any_more() -> None:
    asked, passes = ask_all(Asking(sparse.csr_array(in_a_circle()), IMAGES - 1))
    compared = (asked | asked.T).sum(axis=1)
    assert AT_A_TIME < compared[USUAL] < (IMAGES - 1) / 2
    assert passes > 1, "all look at what was found before they go on"


def test_who_has_hardly_a_partner_asks_to_the_end() -> None:
    few = PLENTY.tolil()
    few[USUAL], few[:, USUAL] = 0, 0
    asked, _ = ask_all(Asking(sparse.csr_array(in_a_circle()), IMAGES - 1), sure=few.tocsr())
    compared = (asked | asked.T).sum(axis=1)
    assert compared[USUAL] == IMAGES - 1
    assert compared[USUAL + IMAGES // 4] < (IMAGES - 1) / 2


def test_who_finds_nothing_but_partners_asks_on_until_it_finds_others() -> None:
    def compared(partners: int) -> int:
        sure = PLENTY + symmetric([(USUAL, (USUAL + d) % IMAGES) for d in range(1, partners)])
        sure = sparse.csr_array((sure.toarray() > 0).astype(np.float64))
        asked, _ = ask_all(Asking(sparse.csr_array(in_a_circle()), IMAGES - 1), sure=sure)
        return int((asked | asked.T)[USUAL].sum())

    assert compared(partners=IMAGES) == IMAGES - 1
    assert compared(partners=AT_A_TIME) < (IMAGES - 1) / 2


def test_no_image_asks_for_more_than_the_depth() -> None:
    asked, _ = ask_all(Asking(sparse.csr_array(in_a_circle()), depth=AT_A_TIME + 3), sure=NOTHING)
    assert asked.sum(axis=1).max() == AT_A_TIME + 3


def test_whom_the_neighbours_vote_for_is_asked_for_though_no_list_has_it() -> None:
    order = in_a_circle()
    far = (USUAL + IMAGES // 2) % IMAGES
    order[USUAL, far] = order[far, USUAL] = 0.0
    without, _ = ask_all(Asking(sparse.csr_array(order), IMAGES - 1))
    assert not (without | without.T)[USUAL, far]
    votes = symmetric([(USUAL, far)], np.log1p(3.0))
    asked, _ = ask_all(Asking(sparse.csr_array(order), IMAGES - 1), votes)
    assert asked[USUAL, far]
    assert asked[far, USUAL]


def test_one_list_alone_speaks_for_a_pair_less_far_down_than_both() -> None:
    def asks(rank: int, other: int) -> bool:
        order = np.zeros((IMAGES, IMAGES))
        order[USUAL, USUAL + 1], order[USUAL + 1, USUAL] = 1 / rank, 1 / other
        asking = Asking(sparse.csr_array(order), IMAGES - 1)
        return bool(asking.next(NOTHING, NOTHING, PLENTY)[USUAL, USUAL + 1] > 0)

    assert asks(20, 20)
    assert asks(5, 2 * LISTED)
    assert not asks(20, 2 * LISTED)
    assert not asks(LISTED, LISTED)


def test_among_thousands_a_pass_for_next_to_nobody_is_not_made() -> None:
    images = 1000
    order = sparse.csr_array(([1.0, 1.0], ([1, 2], [2, 1])), shape=(images, images))
    asking = Asking(order, 100)
    nothing = sparse.csr_array((images, images))
    everyone = sparse.csr_array(np.ones((images, images)))
    assert asking.next(nothing, nothing, everyone).nnz == 0


@given(st.integers(0, 2**32 - 1), st.integers(1, IMAGES - 1), st.floats(0, 0.2))
@settings(max_examples=30, deadline=None)
def test_whatever_the_order_and_the_votes_it_comes_to_an_end(
    seed: int, depth: int, density: float
) -> None:
    rng = np.random.default_rng(seed)
    ranks = np.array([rng.permutation(IMAGES) for _ in range(IMAGES)])
    order = np.divide(1.0, ranks, out=np.zeros(ranks.shape), where=ranks > 0)
    np.fill_diagonal(order, 0.0)
    drawn = np.triu(rng.exponential(1.0, ranks.shape) * (rng.random(ranks.shape) < density), 1)
    sure = np.triu(rng.random(ranks.shape) < density, 1).astype(np.float64)
    asked, _ = ask_all(
        Asking(sparse.csr_array(order), depth),
        sparse.csr_array(drawn + drawn.T),
        sparse.csr_array(sure + sure.T),
    )
    assert 0 < asked.sum(axis=1).max() <= depth
    assert not asked.diagonal().any()
