"""Words of the flight's own: photos of one kind of ground are told apart by what differs there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from ranks import rank

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.ranking import NO_PARTNER
from colmap_netvlad.cache.store import Store
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.search import EXACT_UP_TO, nearest
from colmap_netvlad.retrieval.words import (
    MOST_WORDS,
    InWords,
    Words,
    describe,
    models_share,
    rank_in_words,
    serves,
)

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
    vectors = InWords(in_words(strip()), alike(), share=0)
    assert share_found(nearest(vectors, 2 * NEAR)[0]) > 0.9


@pytest.mark.parametrize("channels", [8, 48])
def test_the_same_flight_and_seed_give_the_same_descriptors(channels: int) -> None:
    cells = strip(channels)
    first = in_words(cells)
    assert first.shape == (PHOTOS, PHOTOS * min(channels, 32))
    np.testing.assert_array_equal(first, in_words(cells))
    assert (first != in_words(cells, seed=1)).any()


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_cosines_are_those_in_words_and_of_the_model_by_their_shares(share: float) -> None:
    codes = in_words(strip())
    vectors = InWords(codes, alike(), share)
    rows = vectors[0:PHOTOS]
    assert rows.shape == vectors.shape
    own = InWords(codes, alike(), 0)[0:PHOTOS]
    expected = (own @ own.T + share * alike() @ alike().T) / (1 + share)
    np.testing.assert_allclose(rows @ rows.T, expected, atol=1e-5)
    np.testing.assert_array_equal(vectors[7:9], rows[7:9])


def test_the_more_words_the_less_the_model_counts() -> None:
    shares = [models_share(words) for words in (1, 10, 101, 136, 500, MOST_WORDS)]
    assert shares == sorted(shares, reverse=True)
    assert shares[3] == 1 and shares[-1] == 0


def test_photos_without_texture_are_described_as_nothing() -> None:
    blank = Cells.of(np.zeros((48, SIDE, SIDE)))
    codes = in_words([*strip()[1:], blank])
    assert not codes[-1].any() and codes[:-1].any(axis=1).all()
    assert not in_words([blank] * 5).any()


def test_words_serve_where_there_is_a_choice_to_make() -> None:
    assert serves(RetrievalOptions(rerank=100), 102)
    assert not serves(RetrievalOptions(rerank=100), 101), "all pairs are compared"
    assert not serves(RetrievalOptions(rerank=0), 1000), "the model's descriptors alone"
    assert not serves(RetrievalOptions(exact=False), 1000)
    assert not serves(RetrievalOptions(), EXACT_UP_TO + 1)


def test_photos_left_out_have_no_partners_and_are_nobodys(tmp_path: Path) -> None:
    names = [f"{i}.jpg" for i in range(PHOTOS)]
    with Store(tmp_path / "project.netvlad.db") as store:
        store.add_descriptors("m", names[1:], names[1:], alike()[1:], 0, strip()[1:])
        ranking = rank_in_words(
            store,
            "m",
            names,
            {"0.jpg": "is no photo"},
            RetrievalOptions(),
            10,
            "deep",
            ["39 of 39"],
        )
    assert ranking.partners.shape == (PHOTOS, 10)
    assert (ranking.partners[0] == NO_PARTNER).all() and not (ranking.partners[1:] == 0).any()
    assert ranking.left_out == (("0.jpg", "is no photo"),)
    assert ranking.notes == ("39 of 39", "candidates by 39 words of the flight's own")


def test_deep_methods_choose_few_of_many_candidates_by_words(
    project_copy, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    all_compared = rank(project, tiny_checkpoint, RetrievalOptions(k=5))
    assert not any("words" in note for note in all_compared.notes)
    few = rank(project, tiny_checkpoint, RetrievalOptions(k=5, rerank=5))
    assert any("12 words" in note for note in few.notes)
    assert few.compared
