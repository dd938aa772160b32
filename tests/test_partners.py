"""Rig frames, cameras and sequences decide who may and who must be partners."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from ranks import from_lists

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.pairs.rules import (
    join_pairs,
    sequential_pairs,
    with_camera_quota,
    without_same_frame,
)
from colmap_netvlad.pairs.union import ImagePair


def ranking_of(rows: list[list[int]]) -> Ranking:
    names = tuple(f"{i}.jpg" for i in range(len(rows)))
    lists = [[(j, 1.0 - 0.1 * r) for r, j in enumerate(row)] for row in rows]
    return from_lists(names, lists, "test")


def test_photos_of_one_frame_are_no_partners_and_the_others_move_up() -> None:
    ranking = ranking_of([[1, 2, 3], [0, 3, 2], [3, 0, 1], [2, 1, 0]])
    kept = without_same_frame(ranking, [7, 7, 8, None])
    assert kept.partners.tolist() == [
        [2, 3, NO_PARTNER],
        [3, 2, NO_PARTNER],
        [3, 0, 1],
        [2, 1, 0],
    ]
    assert kept.scores[0, 2] == -np.inf


def test_images_without_a_frame_lose_nobody() -> None:
    ranking = ranking_of([[1], [0]])
    assert without_same_frame(ranking, [None, None]).partners.tolist() == [[1], [0]]


def test_the_quota_replaces_the_last_own_partners_by_the_best_foreign_ones() -> None:
    ranking = ranking_of([[1, 2, 3, 4, 5], *[[0]] * 5])
    kept = with_camera_quota(ranking, [1, 1, 1, 1, 2, 2], k=3, share=0.34)
    assert kept.partners[0].tolist() == [1, 4, 5]
    assert with_camera_quota(ranking, [1, 1, 1, 1, 2, 2], k=3, share=0.0).partners[0].tolist() == [
        1,
        2,
        3,
    ]


@given(st.integers(2, 10), st.integers(1, 12), st.floats(0, 1), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_the_quota_is_kept_as_far_as_there_are_foreign_photos(
    n: int, k: int, share: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rows = [[int(j) for j in rng.permutation(n) if j != i] for i in range(n)]
    cameras = rng.integers(0, 3, n)
    kept = with_camera_quota(ranking_of(rows), cameras.tolist(), k, share)
    for i, row in enumerate(kept.partners):
        chosen = [int(j) for j in row if j != NO_PARTNER]
        foreign = int((cameras != cameras[i]).sum())
        assert len(chosen) == min(k, n - 1)
        assert len(set(chosen)) == len(chosen)
        assert i not in chosen
        got = sum(cameras[j] != cameras[i] for j in chosen)
        assert got >= min(int(np.ceil(share * k)), foreign, len(chosen))
        assert chosen == [j for j in rows[i] if j in chosen]


def test_a_sequence_counts_numbers_as_numbers_and_stays_in_its_folder() -> None:
    names = ["b/IMG_10.jpg", "b/IMG_9.jpg", "b/IMG_8.jpg", "a/IMG_11.jpg"]
    assert sequential_pairs(names, 1) == [
        ("b/IMG_8.jpg", "b/IMG_9.jpg"),
        ("b/IMG_9.jpg", "b/IMG_10.jpg"),
    ]
    assert len(sequential_pairs(names, 9)) == 3


def test_signs_that_look_like_digits_are_letters() -> None:
    assert sequential_pairs(["x10.jpg", "\u24601.jpg", "x\u00b22.jpg", "x9.jpg"], 1) == [
        ("x9.jpg", "x10.jpg"),
        ("x10.jpg", "x\u00b22.jpg"),
        ("x\u00b22.jpg", "\u24601.jpg"),
    ]


def test_the_user_s_pairs_are_joined_in_once_and_in_order() -> None:
    names = ["a", "b", "c"]
    pairs = [ImagePair("a", "c", 0.5, 1)]
    joined = join_pairs(pairs, [("c", "a"), ("c", "b"), ("b", "b")], names)
    assert joined == [ImagePair("a", "c", 0.5, 1), ImagePair("b", "c", 0.0, 0)]
