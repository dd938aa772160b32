"""The largest SIFT features confirm pairs of which few places agree, and are asked once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import Database
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.flight import open_flight
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.confirm import (
    LARGE,
    LARGEST,
    LARGEST_FEATURES,
    MOST_ASKED,
    Largest,
    agreeing_features,
    largest_features,
)
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.places import Places, agreeing_matches
from colmap_netvlad.retrieval.rerank import FEATURES_BY_CHANCE, PLENTY, rerank
from colmap_netvlad.runtime import products

MakeProject = Callable[..., Project]

Features = tuple[NDArray[np.float32], NDArray[np.uint8]]


def ground(seed: int, count: int = 200) -> Features:
    """Features of a piece of ground, as COLMAP keeps them: (N, 4) and (N, 128)."""
    rng = np.random.default_rng(seed)
    keypoints = np.column_stack(
        [rng.uniform(0, 1000, (count, 2)), rng.uniform(2, 20, count), rng.uniform(-3, 3, count)]
    )
    values = rng.exponential(size=(count, 128))
    return keypoints.astype(np.float32), sift(values)


def sift(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Descriptors of COLMAP's length."""
    values = 512 * values / np.linalg.norm(values, axis=1, keepdims=True)
    return np.round(values).clip(0, 255).astype(np.uint8)


def agreeing(one: Largest, other: Largest) -> int:
    return agreeing_features(one, [other])[0]


def seen(features: Features, turn: float, scaling: float, shift: float) -> Features:
    """The same features in a photo that is turned, scaled and shifted."""
    keypoints, descriptors = features
    x, y, scale, angle = keypoints.T
    moved = (x + 1j * y) * scaling * np.exp(1j * turn) + shift
    moved = np.column_stack([moved.real, moved.imag, scale * scaling, angle + turn])
    return moved.astype(np.float32), descriptors


@pytest.mark.parametrize(("turn", "scaling"), [(0.0, 1.0), (2.5, 1.0), (-1.2, 0.6), (3.1, 1.7)])
def test_all_features_of_one_ground_agree_however_it_was_seen(turn: float, scaling: float) -> None:
    one = ground(0)
    other = seen(one, turn, scaling, 80)
    assert agreeing(Largest.of(*one), Largest.of(*other)) == 200 > MOST_ASKED


def test_features_of_different_ground_agree_by_chance_only() -> None:
    photos = [Largest.of(*ground(seed)) for seed in range(6)]
    counts = [agreeing(one, other) for one in photos for other in photos if one != other]
    assert max(counts) <= FEATURES_BY_CHANCE


def test_the_largest_features_lie_word_after_word() -> None:
    photo = Largest.of(*ground(0, 3000))
    assert len(photo.at) == LARGEST
    ends = [word.stop for word in photo.words]
    assert [0, *ends[:-1]] == [word.start for word in photo.words] and ends[-1] == LARGEST
    assert [len(codes) for codes in photo.codes] == [w.stop - w.start for w in photo.words]


def test_small_features_count_a_half() -> None:
    keypoints, descriptors = ground(0, LARGEST)
    photo = Largest.of(keypoints, descriptors)
    assert photo.large.sum() == LARGE
    assert photo.log_scale[photo.large].min() >= photo.log_scale[~photo.large].max()
    matched = agreeing(photo, photo)
    assert matched == (LARGEST + LARGE) // 2


def test_what_looks_alike_but_lies_elsewhere_does_not_agree() -> None:
    keypoints, descriptors = ground(0)
    elsewhere = ground(1)[0], descriptors
    assert agreeing(Largest.of(keypoints, descriptors), Largest.of(*elsewhere)) <= 5


def test_what_a_photo_shows_over_and_over_confirms_nothing() -> None:
    """Palms: each is like every other, so that a match says nothing, wherever it lies."""
    keypoints, descriptors = ground(0)
    rng = np.random.default_rng(1)
    palms = sift(descriptors[:1] + rng.uniform(0, 12, descriptors.shape))
    photo = Largest.of(keypoints, palms)
    other = sift(descriptors[:1] + rng.uniform(0, 12, descriptors.shape))
    assert agreeing(photo, Largest.of(keypoints, other)) <= FEATURES_BY_CHANCE


def test_one_place_seen_in_two_ways_still_confirms() -> None:
    """SIFT gives a place two orientations where it cannot tell, with descriptors much alike."""
    keypoints, descriptors = ground(0)
    twice = np.concatenate([keypoints, keypoints + np.float32([0.5, 0, 0, 0.2])])
    photo = Largest.of(twice, np.concatenate([descriptors, descriptors]))
    assert agreeing(photo, photo) == 200


@pytest.mark.parametrize("columns", [2, 4, 6])
def test_keypoints_of_every_form_are_read(columns: int) -> None:
    keypoints, descriptors = ground(0, 30)
    scale, angle = keypoints[:, 2:].T
    shape = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1)
    whole = np.column_stack([keypoints[:, :2], shape * scale[:, None]]).astype(np.float32)
    photo = Largest.of({2: keypoints[:, :2], 4: keypoints, 6: whole}[columns], descriptors)
    assert agreeing(photo, photo) == 30


def test_keypoints_that_are_not_finite_and_photos_without_features_confirm_nothing() -> None:
    keypoints, descriptors = ground(0, 40)
    keypoints[:30] = np.nan
    photo = Largest.of(keypoints, descriptors)
    assert len(photo.at) == agreeing(photo, photo) == 10
    none = Largest.of(keypoints[:0], descriptors[:0])
    assert agreeing(photo, none) == agreeing(none, photo) == 0


def test_machines_that_multiply_floats_faster_find_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts = []
    for kind in (torch.int8, torch.float32):
        monkeypatch.setattr(products, "bytes_or_floats", lambda kind=kind: kind)
        one, other = ground(0), seen(ground(0), 1.0, 0.8, 30)
        cells = [Cells.of(np.random.default_rng(s).normal(size=(16, 9, 9))) for s in (0, 0, 1)]
        places = [Places.of(grid) for grid in cells]
        counts.append(
            (
                agreeing(Largest.of(*one), Largest.of(*other)),
                agreeing_matches(places[0], places[1]),
                agreeing_matches(places[0], places[2]),
            )
        )
    assert counts[0] == counts[1]


def test_bytes_or_floats_are_tried_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several wait for each other where other work runs, and chance would decide."""
    threads = []

    def tried(kind: torch.dtype) -> float:
        threads.append(torch.get_num_threads())
        return 0.0

    monkeypatch.setattr(products, "_seconds", tried)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        products.bytes_or_floats.__wrapped__()
        assert set(threads) == {1} and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


class Kept:
    """The features of a few photos, in place of a database."""

    def __init__(self, photos: dict[str, Features], version: int = 0) -> None:
        self.fingerprints = {name: f"{name} {version}" for name in photos}
        self._photos = photos
        self.read_of: list[str] = []

    def read(self, name: str) -> Largest:
        self.read_of.append(name)
        return Largest.of(*self._photos[name])


NAMES = tuple(f"{i}.jpg" for i in range(6))


@pytest.fixture
def store(tmp_path: Path):
    """Six photos of which the places say nothing."""
    rng = np.random.default_rng(0)
    cells = [Cells.of(rng.normal(size=(16, 8, 8))) for _ in NAMES]
    with Store(tmp_path / "project.netvlad.db") as opened:
        opened.add_descriptors("m", NAMES, NAMES, np.zeros((6, 4), np.float32), 0, cells)
        yield opened


def in_order() -> Ranking:
    others = [[j for j in range(6) if j != i] for i in range(6)]
    scores = np.tile(np.linspace(1, 0.1, 5, dtype=np.float32), (6, 1))
    return Ranking(NAMES, np.array(others, np.int32), scores, "in order")


def of_one_ground(*photos: str) -> dict[str, Features]:
    """Photos of one ground, the others of each another."""
    ground_of = {name: 99 if name in photos else i for i, name in enumerate(NAMES)}
    return {name: seen(ground(ground_of[name]), i, 1, 9 * i) for i, name in enumerate(NAMES)}


def test_a_pair_that_places_do_not_tell_is_found_by_its_features(store: Store) -> None:
    assert rerank(in_order(), store, "m", 5).partners[0, 0] == 1
    ranking = rerank(in_order(), store, "m", 5, features=Kept(of_one_ground("0.jpg", "5.jpg")))
    assert ranking.partners[0, 0] == 5 and ranking.partners[5, 0] == 0


def test_where_places_leave_no_doubt_no_feature_is_read(tmp_path: Path) -> None:
    cells = [Cells.of(np.random.default_rng(0).normal(size=(16, 12, 12)))] * 6
    assert len(cells[0].places()) > PLENTY
    kept = Kept(of_one_ground())
    with Store(tmp_path / "project.netvlad.db") as store:
        store.add_descriptors("m", NAMES, NAMES, np.zeros((6, 4), np.float32), 0, cells)
        rerank(in_order(), store, "m", 5, features=kept)
    assert kept.read_of == []


def test_features_are_asked_once_and_again_where_they_changed(store: Store) -> None:
    kept = Kept(of_one_ground("0.jpg", "5.jpg"))
    first = rerank(in_order(), store, "m", 5, features=kept)
    assert set(kept.read_of) == set(NAMES)
    assert len(kept.read_of) <= len(NAMES) + 3, "each once, three once more to see their size"
    again = Kept(of_one_ground("0.jpg", "5.jpg"))
    np.testing.assert_array_equal(
        rerank(in_order(), store, "m", 5, features=again).partners, first.partners
    )
    assert again.read_of == []
    changed = Kept(of_one_ground("0.jpg", "3.jpg"))
    changed.fingerprints |= {"0.jpg": "new", "3.jpg": "new"}
    ranking = rerank(in_order(), store, "m", 5, features=changed)
    assert ranking.partners[0, 0] == 3
    with Store(store.path) as opened:
        numbers = set(opened.cell_numbers("m").values())
        numbers |= set(opened.cell_numbers(LARGEST_FEATURES).values())
        assert set(opened.agreements()[0].ravel().tolist()) <= numbers, "what was counted before"


def test_photos_without_features_are_told_by_their_places(store: Store) -> None:
    photos = of_one_ground("0.jpg", "5.jpg")
    del photos["2.jpg"]
    ranking = rerank(in_order(), store, "m", 5, features=Kept(photos))
    assert ranking.partners[0, 0] == 5
    assert sorted(ranking.partners[2].tolist()) == [0, 1, 3, 4, 5]


def test_features_of_another_kind_or_none_are_not_asked(
    project_copy: MakeProject, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy()
    monkeypatch.setattr(Database, "has_sift", lambda self: False)
    monkeypatch.setattr(Database, "sift_descriptors", lambda *_: pytest.fail("read"))
    with open_flight(project) as flight:
        assert largest_features(flight) is None
    report = make_pairs(project, "netvlad-o-lite", RetrievalOptions(k=3, model=tiny_checkpoint))
    assert report.pairs


def test_keypoints_and_descriptors_that_do_not_belong_together_are_none(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_flight(project_copy()) as flight:
        features = largest_features(flight)
        assert features is not None
        name = flight.names[0]
        assert len(features.read(name).at) > 100
        monkeypatch.setattr(Database, "sift_descriptors", lambda *_: np.zeros((5, 128), np.uint8))
        assert len(features.read(name).at) == 0
