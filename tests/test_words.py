"""Words of the flight's own: photos of one kind of ground are told apart by what differs there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from ranks import rank

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.codes import decode
from colmap_netvlad.cache.ranking import NO_PARTNER
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval import words as module
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.search import EXACT_UP_TO, nearest, nearest_by
from colmap_netvlad.retrieval.words import (
    AXES,
    LEAST_WORDS,
    MODELS_SHARE,
    MOST_WORDS,
    InWords,
    Words,
    describe,
    models_share,
    rank_in_words,
    serves,
    words_of,
)
from colmap_netvlad.runtime import products

SIDE, STEP, PHOTOS = 8, 3, 40
NEAR = 2
"""Photos so many steps apart still share a quarter of their ground."""


def strip(channels: int = 48, seed: int = 0) -> list[Cells]:
    """Photos along a strip of one kind of ground: a common feature, and a tenth of its own."""
    rng = np.random.default_rng(seed)
    ground = rng.normal(size=(channels, SIDE, SIDE + STEP * PHOTOS)) + 10
    return [Cells.of(ground[:, :, STEP * i : STEP * i + SIDE]) for i in range(PHOTOS)]


def alike(photos: int = PHOTOS, dim: int = 16) -> NDArray[np.float32]:
    """Descriptors of a model that tell nothing apart."""
    vectors = 10 + np.random.default_rng(1).normal(size=(photos, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def share_found(partners: NDArray[np.int32]) -> float:
    """Share of the true partners among as many candidates."""
    found = wanted = 0
    for i in range(PHOTOS):
        true = {j for j in range(PHOTOS) if j != i and abs(i - j) <= NEAR}
        found += len(true & set(partners[i, : len(true)].tolist()))
        wanted += len(true)
    return found / wanted


def in_words(cells: list[Cells], seed: int = 0) -> NDArray[np.int8]:
    words = Words.learn(cells.__getitem__, len(cells), seed)
    return describe(words, cells.__getitem__, len(cells))


def test_partners_are_found_that_the_model_does_not_see() -> None:
    assert share_found(nearest(alike(), 2 * NEAR)[0]) < 0.3
    assert share_found(nearest_by(InWords(in_words(strip())), 2 * NEAR)[0]) > 0.9


@pytest.mark.parametrize("channels", [8, 48])
def test_the_same_flight_and_seed_give_the_same_descriptors(channels: int) -> None:
    cells = strip(channels)
    first = in_words(cells)
    assert first.shape == (PHOTOS, LEAST_WORDS * min(channels, AXES))
    np.testing.assert_array_equal(first, in_words(cells))
    assert (first != in_words(cells, seed=1)).any()


@pytest.mark.parametrize("kind", [torch.int8, torch.float32])
def test_cosines_are_those_of_the_descriptors_part_by_part(
    kind: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(products, "bytes_or_floats", lambda: kind)
    monkeypatch.setattr(module, "BLOCK_ROWS", 7)
    codes = in_words(strip())
    vectors = decode(codes)
    photos = InWords(codes)
    assert [len(codes[rows]) for rows in photos.parts()] == [7] * 5 + [5]
    for rows in photos.parts():
        for columns in photos.parts():
            np.testing.assert_allclose(
                photos.block(rows, columns), vectors[rows] @ vectors[columns].T, atol=1e-5
            )
    partners, scores = nearest_by(photos, 5)
    expected_partners, expected_scores = nearest(vectors, 5)
    np.testing.assert_allclose(scores, expected_scores, atol=1e-5)
    assert (partners == expected_partners).mean() > 0.99, "but for equal ones"


def test_the_more_words_the_less_the_model_counts() -> None:
    shares = [models_share(words) for words in (16, 100, MODELS_SHARE, 256, 800, MOST_WORDS)]
    assert shares == sorted(shares, reverse=True)
    assert shares[2] == 1 and shares[-1] == 0


def test_words_are_enough_for_few_photos_and_fit_in_memory_for_many() -> None:
    assert [words_of(photos) for photos in (1, 2, 16, 100, 256, 300, 2048, 5000)] == [
        16,
        32,
        256,
        256,
        256,
        300,
        2048,
        2048,
    ]
    for photos in (10_000, 15_000, 20_000):
        assert photos * words_of(photos) * AXES <= 640 * 2**20
    assert words_of(20_000) > 1000


def test_a_wide_field_has_fewer_votes_than_its_cells() -> None:
    field = np.tile(np.float32([1, 0, 0]), (90, 1))
    houses = np.eye(3, dtype=np.float32)[1:]
    rarity = module._rarity(np.concatenate([field, houses]))
    assert 0.9 < rarity[:90].sum() < 1.1
    assert (rarity[90:] > 0.6).all() and (rarity <= 1).all()


def test_photos_without_texture_are_described_as_nothing() -> None:
    blank = Cells.of(np.zeros((48, SIDE, SIDE)))
    codes = in_words([*strip()[1:], blank])
    assert not codes[-1].any() and codes[:-1].any(axis=1).all()
    assert not in_words([blank] * 5).any()


def test_words_serve_unless_all_are_compared_or_a_search_is_asked_for() -> None:
    assert serves(RetrievalOptions(rerank=100), 102)
    assert not serves(RetrievalOptions(rerank=100), 101), "all pairs are compared"
    assert serves(RetrievalOptions(rerank=0), 3), "descriptors alone"
    assert not serves(RetrievalOptions(exact=False), 1000)
    assert not serves(RetrievalOptions(exact=True, rerank=0), 1000), "the model's, as the paper's"
    assert not serves(RetrievalOptions(), EXACT_UP_TO + 1)


def test_photos_left_out_have_no_partners_and_are_nobodys(tmp_path: Path) -> None:
    names = [f"{i}.jpg" for i in range(PHOTOS)]
    with Store(tmp_path / "project.netvlad.db") as store:
        store.add_descriptors("m", names[1:], names[1:], alike()[1:], 0, strip()[1:])
        sources = rank_in_words(
            store,
            "m",
            names,
            {"0.jpg": "is no photo"},
            RetrievalOptions(),
            10,
            "deep",
            ["39 of 39"],
        )
    assert [share for _, share in sources] == [1.0, models_share(LEAST_WORDS)]
    for ranking, _ in sources:
        assert ranking.partners.shape == (PHOTOS, 10)
        assert (ranking.partners[0] == NO_PARTNER).all() and not (ranking.partners[1:] == 0).any()
        assert ranking.left_out == (("0.jpg", "is no photo"),)
    assert sources[0][0].notes == ("39 of 39", "ranked by 256 words of the flight's own")


def test_deep_methods_choose_few_of_many_candidates_by_words(
    project_copy, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    all_compared = rank(project, tiny_checkpoint, RetrievalOptions(k=5))
    assert not any("words" in note for note in all_compared.notes)
    few = rank(project, tiny_checkpoint, RetrievalOptions(k=5, rerank=5))
    assert any("144 words" in note for note in few.notes), "no more than cells, 12 a photo"
    assert few.compared
