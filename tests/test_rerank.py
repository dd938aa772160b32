"""Candidates compared place by place: what agrees counts, and nothing is compared twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from ranks import rank

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.cli import cli
from colmap_netvlad.retrieval import counts
from colmap_netvlad.retrieval import rerank as module
from colmap_netvlad.retrieval.asking import AT_A_TIME, PARTNERS
from colmap_netvlad.retrieval.options import COMPARED, RetrievalOptions
from colmap_netvlad.retrieval.places import Places, agreeing_matches
from colmap_netvlad.retrieval.rerank import CHANCE, SURE, rerank

SIDE, STEP, PHOTOS = 12, 4, 9
"""A strip of ground seen by photos of SIDE x SIDE cells, each STEP cells after the one before."""


def ground(seed: int = 0) -> NDArray[np.float32]:
    """(D, SIDE, length) random features of the ground under the whole strip."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(32, SIDE, SIDE + STEP * (PHOTOS - 1))).astype(np.float32)


def photo(number: int, turns: int = 0, seed: int = 0) -> Cells:
    """The features of a photo of the strip, the camera turned by quarter turns."""
    cut = ground(seed)[:, :, STEP * number : STEP * number + SIDE]
    return Cells.of(np.rot90(cut, turns, axes=(1, 2)))


def agreeing(one: Cells, other: Cells) -> int:
    return agreeing_matches(Places.of(one), Places.of(other))


@pytest.fixture
def store(tmp_path: Path):
    with Store(tmp_path / "project.netvlad.db") as opened:
        keep(opened, range(PHOTOS))
        yield opened


def keep(store: Store, numbers, seed: int = 0, content: str = "") -> None:
    """Describe photos of the strip; every other one was taken with the camera turned."""
    names = [f"{n}.jpg" for n in numbers]
    vectors = np.zeros((len(names), 4), np.float32)
    local = [photo(n, n % 2, seed) for n in numbers]
    store.add_descriptors("m", names, [f"{n}{content}" for n in names], vectors, 0, local)


def by_chance(seed: int = 1, photos: int = PHOTOS) -> Ranking:
    """All others of each photo in random order, as if descriptors said nothing."""
    rng = np.random.default_rng(seed)
    partners = np.array(
        [rng.permutation([j for j in range(photos) if j != i]) for i in range(photos)], np.int32
    )
    scores = np.tile(np.linspace(1, 0.1, photos - 1, dtype=np.float32), (photos, 1))
    return Ranking(tuple(f"{i}.jpg" for i in range(photos)), partners, scores, "chance")


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 6), st.floats(1e-3, 1e3))
@settings(max_examples=30, deadline=None)
def test_features_come_back_with_their_directions(seed: int, h: int, w: int, unit: float) -> None:
    features = np.random.default_rng(seed).normal(size=(64, h, w)) * unit
    kept = Cells.of(features)
    assert kept.codes.shape == (h, w, 64)
    flat = features.reshape(64, -1).T
    cosines = (kept.vectors() * flat).sum(axis=1) / np.linalg.norm(flat, axis=1)
    assert (cosines > 0.999).all()
    assert [tuple(xy) for xy in kept.places().astype(int)] == [
        (x, y) for y in range(h) for x in range(w)
    ]


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
@pytest.mark.parametrize("apart", [0, 1, 2])
def test_every_place_that_both_photos_show_agrees_whatever_way_the_camera_turned(
    turns: int, apart: int
) -> None:
    shared = SIDE * (SIDE - STEP * apart)
    assert agreeing(photo(2), photo(2 + apart, turns)) >= shared


def test_photos_of_different_ground_agree_by_chance_only() -> None:
    counts = [agreeing(photo(0, seed=2 * i), photo(0, seed=2 * i + 1)) for i in range(20)]
    assert max(counts) <= CHANCE + 3
    assert np.median(counts) <= CHANCE


def test_the_count_is_the_same_every_time() -> None:
    one, other = photo(0), photo(1, 3)
    assert len({agreeing(one, other) for _ in range(5)}) == 1


def test_places_without_texture_do_not_agree() -> None:
    mask = np.zeros((32, SIDE, SIDE), np.float32)
    mask[:, 0, 0] = mask[:, 5, 7] = 1
    assert agreeing(Cells.of(np.zeros_like(mask)), photo(0)) == 0
    assert agreeing(Cells.of(mask), Cells.of(mask)) <= 2


def test_neighbours_on_the_ground_come_first_whatever_order_they_were_found_in(
    store: Store,
) -> None:
    ranking = rerank(by_chance(), store, "m", PHOTOS - 1)
    assert ranking.compared
    for i, row in enumerate(ranking.partners):
        overlapping = [j for j in range(PHOTOS) if 0 < abs(i - j) <= 2]
        assert set(row[: len(overlapping)]) == set(overlapping)
        assert abs(int(row[0]) - i) == 1
        assert sorted(row) == [j for j in range(PHOTOS) if j != i], "nobody is lost"
    assert (np.diff(ranking.scores, axis=1) <= 0).all()


def test_no_more_candidates_are_compared_than_asked_for(store: Store, monkeypatch) -> None:
    asked = []

    def count(one: Places, other: Places) -> int:
        asked.append(1)
        return agreeing_matches(one, other)

    monkeypatch.setattr(module, "agreeing_matches", count)
    ranking = rerank(by_chance(), store, "m", PHOTOS - 1, depth=2)
    assert PHOTOS <= len(asked) <= 2 * PHOTOS
    for i, row in enumerate(ranking.partners.tolist()):
        assert sorted(row) == [j for j in range(PHOTOS) if j != i], "the others follow"


def test_a_neighbour_whom_the_descriptors_overlooked_is_found_by_way_of_its_neighbours(
    store: Store,
) -> None:
    candidates = by_chance()
    first = np.array([1, 2, 3, 4, 5, 6, 7, 8, 7])  # each found the next photo of the strip first
    partners = np.array(
        [
            [f, *(j for j in row if j != f)]
            for f, row in zip(first, candidates.partners, strict=True)
        ]
    )
    partners[0] = [1, 8, 7, 6, 5, 4, 3, 2]
    found = Ranking(candidates.names, partners, candidates.scores, "chance")
    assert set(rerank(found, store, "m", 2, depth=2).partners[0, :2]) == {1, 2}


CIRCLE = 90
"""Images each of which has the ones after it as candidates, the nearest first."""


@pytest.fixture
def compared_in_a_circle(tmp_path: Path, monkeypatch):
    """Return a function: matches that agree of pairs -> (the pairs compared, the ranking)."""

    def run(
        agreeing: dict[tuple[int, int], int],
        otherwise: int = 0,
        depth: int = CIRCLE - 1,
    ):
        pairs = set()

        def count(one: Places, other: Places) -> int:
            pair = tuple(sorted(int(places.codes[0].argmax()) for places in (one, other)))
            pairs.add(pair)
            return agreeing.get(pair, otherwise)

        monkeypatch.setattr(module, "agreeing_matches", count)
        names = tuple(f"{n:02d}.jpg" for n in range(CIRCLE))
        cells = [Cells.of(np.eye(CIRCLE)[n].reshape(CIRCLE, 1, 1)) for n in range(CIRCLE)]
        after = np.arange(1, CIRCLE)
        partners = ((np.arange(CIRCLE)[:, None] + after) % CIRCLE).astype(np.int32)
        scores = np.tile(1 / after.astype(np.float32), (CIRCLE, 1))
        with Store(tmp_path / "circle.db") as store:
            store.add_descriptors("m", names, names, np.zeros((CIRCLE, 4)), 0, cells)
            candidates = Ranking(names, partners, scores, "circle")
            ranking = rerank(candidates, store, "m", 5, depth)
        return pairs, ranking

    return run


def circle_pairs(image: int, places: range) -> set[tuple[int, int]]:
    """The pairs of an image with its candidates at these places, counted from 1."""
    others = [(image + place) % CIRCLE for place in places]
    return {(min(image, other), max(image, other)) for other in others}


SURELY = SURE + 1
NEAR = {
    (min(pair), max(pair)): SURELY
    for apart in range(1, PARTNERS // 2 + 1)
    for pair in ((i, (i + apart) % CIRCLE) for i in range(CIRCLE))
}
"""Each image has as many sure partners as make it stop: those next to it on either side."""


def test_who_finds_nothing_more_stops_asking(compared_in_a_circle) -> None:
    pairs, ranking = compared_in_a_circle(NEAR)
    assert pairs >= set(NEAR)
    assert len(pairs) < CIRCLE * (CIRCLE - 1) // 3
    assert set(ranking.partners[7, :PARTNERS]) == {4, 5, 6, 8, 9, 10}
    assert ranking.partners.shape == (CIRCLE, CIRCLE - 1), "the others follow in their own order"


@pytest.mark.parametrize("matches", [0, SURELY - 1])
def test_who_has_hardly_a_sure_partner_asks_to_the_end(compared_in_a_circle, matches: int) -> None:
    alone = {pair: count for pair, count in NEAR.items() if 7 not in pair}
    pairs, _ = compared_in_a_circle(alone | {(6, 7): matches})
    assert pairs >= circle_pairs(7, range(1, CIRCLE))
    assert len(pairs) < CIRCLE * (CIRCLE - 1) // 2, "the others stopped"


def test_where_all_are_partners_all_candidates_are_compared(compared_in_a_circle) -> None:
    pairs, _ = compared_in_a_circle({}, otherwise=SURELY)
    assert len(pairs) == CIRCLE * (CIRCLE - 1) // 2


def test_no_image_asks_for_more_than_the_depth(compared_in_a_circle) -> None:
    pairs, _ = compared_in_a_circle({}, otherwise=SURELY, depth=AT_A_TIME + 3)
    assert CIRCLE * (AT_A_TIME + 3) // 2 <= len(pairs) <= CIRCLE * (AT_A_TIME + 3)


def test_what_was_compared_is_not_compared_again(store: Store, monkeypatch) -> None:
    first = rerank(by_chance(), store, "m", 5)
    monkeypatch.setattr(module, "agreeing_matches", None)
    again = rerank(by_chance(), store, "m", 5)
    np.testing.assert_array_equal(again.partners, first.partners)
    assert again.seconds_search > 0, "what it took the first time is in the report"


def test_a_new_and_a_changed_photo_cost_their_own_pairs_only(store: Store, monkeypatch) -> None:
    rerank(by_chance(photos=PHOTOS - 1), store, "m", 5)
    keep(store, [3], seed=9, content="changed")
    asked = []
    monkeypatch.setattr(module, "agreeing_matches", lambda one, other: asked.append(1) or 0)
    rerank(by_chance(), store, "m", 5)
    assert len(asked) == (PHOTOS - 1) + (PHOTOS - 2)


def test_a_run_that_was_stopped_goes_on_where_it_was(store: Store, monkeypatch) -> None:
    monkeypatch.setattr(counts, "KEEP_PAIRS", 1)
    monkeypatch.setattr(counts, "usable_processors", lambda: 1)  # one thread: pairs in their order
    asked = []

    def stopped(one: Places, other: Places) -> int:
        asked.append(1)
        if len(asked) > 20:
            raise KeyboardInterrupt
        return agreeing_matches(one, other)

    with monkeypatch.context() as patch:
        patch.setattr(module, "agreeing_matches", stopped)
        with pytest.raises(KeyboardInterrupt):
            rerank(by_chance(), store, "m", 5)
    kept = len(store.agreements()[0])
    assert 0 < kept <= 20
    rest = []
    monkeypatch.setattr(module, "agreeing_matches", lambda one, other: rest.append(1) or 0)
    rerank(by_chance(), store, "m", 5)
    assert len(rest) == PHOTOS * (PHOTOS - 1) // 2 - kept


def test_an_image_without_local_features_keeps_its_own_order(store: Store) -> None:
    candidates = by_chance(photos=PHOTOS + 1)
    ranking = rerank(candidates, store, "m", PHOTOS)
    np.testing.assert_array_equal(ranking.partners[PHOTOS], candidates.partners[PHOTOS])


def test_an_image_that_was_left_out_stays_out(store: Store) -> None:
    candidates = by_chance()
    partners = np.where(candidates.partners == 4, NO_PARTNER, candidates.partners)
    partners = np.take_along_axis(partners, np.argsort(partners == NO_PARTNER, 1, kind="stable"), 1)
    partners[4] = NO_PARTNER
    without = Ranking(
        candidates.names, partners, candidates.scores, "chance", left_out=(("4.jpg", "is empty"),)
    )
    ranking = rerank(without, store, "m", 5)
    assert (ranking.partners[4] == NO_PARTNER).all()
    assert 4 not in ranking.partners


def test_a_cache_of_before_forgets_longer_cells_and_keeps_what_is_not_described(
    tmp_path: Path,
) -> None:
    path = tmp_path / "project.netvlad.db"
    with Store(path) as store:
        store.remember("a", "setting")
        store.add_descriptors("m", ["a"], ["1"], np.ones((1, 4), np.float32) / 2, 0)
        keep(store, [0])
        store._db.execute("ALTER TABLE cells RENAME TO local_features")
        store._db.execute("DROP TABLE photos")
        store._db.execute("CREATE TABLE rankings (method TEXT)")
        store._db.execute("PRAGMA user_version = 1")
    for _ in range(2):
        with Store(path) as store:
            assert store.setting("a") == "setting"
            assert store.described("m") == store.described_in_cells("m") == {}
            assert store.photos() == {}
            keep(store, [0])
            assert store.described_in_cells("m") == {"0.jpg": "0.jpg"}
            store._db.execute("DELETE FROM cells")
            store._db.execute("DELETE FROM descriptors")
            assert "rankings" not in store._db.table_names()


def test_what_was_counted_for_a_photo_that_changed_is_pruned(tmp_path: Path) -> None:
    path = tmp_path / "project.netvlad.db"
    with Store(path) as store:
        keep(store, range(PHOTOS))
        rerank(by_chance(), store, "m", 5)
        before = len(store.agreements()[0])
        keep(store, [3], seed=9, content="changed")
        gone = set(store.agreements()[0].ravel().tolist()) - set(store.cell_numbers("m").values())
        assert gone, "the old photo's counts are still there"
    with Store(path) as store:
        pairs = store.agreements()[0]
        assert not gone & set(pairs.ravel().tolist())
        assert 0 < len(pairs) < before


def test_deep_methods_compare_unless_told_not_to(project_copy, tiny_checkpoint: Path) -> None:
    project = project_copy()
    plain = rank(project, tiny_checkpoint, RetrievalOptions(k=11, rerank=0, exact=True))
    with Store(project.cache) as store:
        assert store.agreements()[0].shape == (0, 2), "nothing is kept that is not asked for"
        assert plain.compared is False
    compared = rank(project, tiny_checkpoint, RetrievalOptions(k=11))
    assert compared.compared
    assert compared.notes[0].startswith("12 of 12"), "descriptors without local features"
    assert (compared.partners != plain.partners).any()
    assert rank(project, "vlad", RetrievalOptions(k=5)).compared is False


def test_the_option_has_the_default_of_the_library() -> None:
    for command in ("pairs", "compare"):
        option = next(p for p in cli.commands[command].params if p.name == "rerank")
        assert option.default == COMPARED == RetrievalOptions().rerank


def test_fewer_than_no_candidates_are_refused(project_copy) -> None:
    project = project_copy()
    result = CliRunner().invoke(cli, ["pairs", "--db", str(project.database), "--rerank", "-1"])
    assert result.exit_code == 2 and "--rerank" in result.output
