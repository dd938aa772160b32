"""Nearest neighbours: every image gets its k partners, whichever way they are found."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_netvlad.retrieval import search
from colmap_netvlad.retrieval.search import nearest


def clustered(count: int, dim: int, seed: int, clusters: int = 8) -> np.ndarray:
    generator = np.random.default_rng(seed)
    centres = generator.normal(size=(clusters, dim))
    vectors = centres[generator.integers(0, clusters, count)] + generator.normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def by_definition(vectors: np.ndarray, k: int) -> np.ndarray:
    similarity = vectors.astype(np.float64) @ vectors.T.astype(np.float64)
    np.fill_diagonal(similarity, -np.inf)
    return np.argsort(-similarity, axis=1, kind="stable")[:, :k]


@settings(max_examples=40, deadline=None)
@given(
    count=st.integers(2, 60),
    k=st.integers(1, 70),
    duplicates=st.integers(0, 10),
    exact=st.booleans(),
    seed=st.integers(0, 100),
)
def test_every_image_has_k_partners_none_twice_and_never_itself(
    count: int, k: int, duplicates: int, exact: bool, seed: int
) -> None:
    vectors = clustered(count, 12, seed)
    vectors[:duplicates] = vectors[0]
    partners, scores = nearest(vectors, k, exact, seed)
    assert partners.shape == scores.shape == (count, min(k, count - 1))
    for i, row in enumerate(partners.tolist()):
        assert i not in row
        assert len(set(row)) == len(row)
        assert all(0 <= j < count for j in row)
    assert (np.diff(scores, axis=1) <= 1e-6).all()


@settings(max_examples=25, deadline=None)
@given(count=st.integers(2, 120), k=st.integers(1, 30), seed=st.integers(0, 100))
def test_exact_search_in_blocks_equals_the_definition(count: int, k: int, seed: int) -> None:
    vectors = clustered(count, 16, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "BLOCK_ROWS", 17)
        partners, scores = nearest(vectors, k, exact=True)
    expected = by_definition(vectors, min(k, count - 1))
    similarity = vectors @ vectors.T
    np.testing.assert_allclose(scores, np.take_along_axis(similarity, expected, 1), atol=1e-5)
    assert (partners == expected).mean() > 0.99  # rounding may swap equals


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 100), order_seed=st.integers(0, 100))
def test_exact_search_does_not_depend_on_the_order_of_images(seed: int, order_seed: int) -> None:
    vectors = clustered(50, 16, seed)
    order = np.random.default_rng(order_seed).permutation(50)
    partners, _ = nearest(vectors, 5, exact=True)
    shuffled, _ = nearest(vectors[order], 5, exact=True)
    for i in range(50):
        assert set(order[shuffled[i]]) == set(partners[order[i]])


def test_hnsw_finds_nearly_all_true_neighbours_and_the_same_twice() -> None:
    vectors = clustered(3000, 32, 0, clusters=100)
    first, _ = nearest(vectors, 10, exact=False, seed=3)
    second, _ = nearest(vectors, 10, exact=False, seed=3)
    np.testing.assert_array_equal(first, second)
    truth = by_definition(vectors, 10)
    found = np.mean([len(set(a) & set(b)) / 10 for a, b in zip(first, truth, strict=True)])
    assert found > 0.95


def test_hnsw_serves_images_that_its_graph_does_not_reach() -> None:
    # 100 equal vectors: the graph around them returns each other, often not the query itself.
    vectors = np.tile(clustered(1, 8, 0), (100, 1))
    partners, scores = nearest(vectors, 99, exact=False)
    assert all(sorted({i, *row}) == list(range(100)) for i, row in enumerate(partners.tolist()))
    np.testing.assert_allclose(scores, 1, atol=1e-3)


def test_reduced_search_finds_what_exact_search_finds_and_the_same_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # More values than axes; which of its group are nearest to a photo lies beside the axes.
    vectors = clustered(1500, 600, 0, clusters=40)
    monkeypatch.setattr(search, "EXACT_UP_TO", 0)
    monkeypatch.setattr(search, "AXES", 64)
    monkeypatch.setattr(search, "SAMPLE", 500)
    first, scores = nearest(vectors, 20)
    second, _ = nearest(vectors, 20)
    np.testing.assert_array_equal(first, second)
    truth, true_scores = nearest(vectors, 20, exact=True)
    found = np.mean([len(set(a) & set(b)) / 20 for a, b in zip(first, truth, strict=True)])
    assert found > 0.98
    np.testing.assert_allclose(scores, true_scores, atol=0.01)
    monkeypatch.setattr(search, "SHORTLIST", 0)
    alone, _ = nearest(vectors, 20)
    assert np.mean([len(set(a) & set(b)) / 20 for a, b in zip(alone, truth, strict=True)]) < found


def test_the_sample_of_reduced_search_keeps_no_more_than_its_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vectors = clustered(4000, 256, 0)
    monkeypatch.setattr(search, "BLOCK_BYTES", 1 << 16)
    tracemalloc.start()
    sample = search._spread(vectors.astype(np.float16), 64)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(sample) == 64
    assert peak < vectors.nbytes / 2 + 4 * sample.nbytes + (1 << 18)  # beside the float16 itself


@given(count=st.integers(2, 40), k=st.integers(1, 50), dim=st.integers(1, 9), copies=st.booleans())
@settings(max_examples=30, deadline=None)
def test_reduced_search_gives_every_image_others_and_none_twice(
    count: int, k: int, dim: int, copies: bool
) -> None:
    vectors = clustered(count, dim, count, clusters=3)
    if copies:
        vectors[:] = vectors[0]
    k = min(k, count - 1)
    partners, scores = search._reduced(vectors, k)
    assert partners.shape == scores.shape == (count, k)
    for i, row in enumerate(partners.tolist()):
        assert i not in row
        assert len(set(row)) == k


def test_the_method_of_search_is_chosen_by_the_number_of_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vectors = clustered(30, 8, 0)
    used = []
    for name in ("nearest_by", "_reduced", "_hnsw"):
        real = getattr(search, name)
        monkeypatch.setattr(
            search, name, lambda *a, name=name, real=real: used.append(name) or real(*a)
        )
    nearest(vectors, 3)
    monkeypatch.setattr(search, "EXACT_UP_TO", 29)
    nearest(vectors, 3)
    nearest(vectors, 3, exact=True)
    nearest(vectors, 3, exact=False)
    assert used == ["nearest_by", "_reduced", "nearest_by", "_hnsw"]


def test_half_precision_and_a_single_image_are_served() -> None:
    assert nearest(clustered(1, 8, 0), 5)[0].shape == (1, 0)
    partners, scores = nearest(clustered(9, 8, 0).astype(np.float16), 2)
    assert partners.shape == (9, 2)
    assert scores.dtype == np.float32
