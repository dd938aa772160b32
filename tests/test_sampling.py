"""Batches: the roles of the paper's eq. 6 to 8, determinism, and what cannot be sampled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training.augment import (
    Augmentation,
    PseudoOptions,
    View,
    draw_view,
    pseudo_scene,
    render,
    visible,
)
from colmap_netvlad.training.sampling import (
    Batch,
    Query,
    Sampler,
    SamplingOptions,
    nearest_of_other_scenes,
)
from colmap_netvlad.training.scenes import Scene, symmetric
from colmap_netvlad.training.visibility import by_views


def strip(name: str, images: int, reach: int = 3) -> Scene:
    """A scene whose photos lie on a line: photo i sees the ground of those within `reach`."""
    pairs = [
        (i, j, 20 * (reach + 1 - (j - i)))
        for i in range(images)
        for j in range(i + 1, min(i + reach, images - 1) + 1)
    ]
    return Scene(
        name=name,
        images=Path(name),
        names=tuple(f"{i}.jpg" for i in range(images)),
        common_points=symmetric(pairs, images),
        matches=symmetric(pairs, images),
        sizes=np.tile(np.array([40, 30], np.int32), (images, 1)),
        model=np.zeros(images, np.int32),
        poses=np.zeros((images, 7)),
        points=100,
        method="exhaustive",
    )


def scenes(count: int, images: int = 12) -> list[Scene]:
    return [strip(f"scene{i}", images) for i in range(count)]


def roles(batch: Batch, row: int) -> tuple[int, int]:
    return batch.samples[row]


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 1000),
    count=st.integers(2, 6),
    positives=st.integers(1, 3),
    same_flight=st.integers(0, 2),
)
def test_nontrivial_batches_obey_the_equations(
    seed: int, count: int, positives: int, same_flight: int
) -> None:
    flights = scenes(count)
    options = SamplingOptions(positives=positives, same_flight=same_flight, seed=seed)
    for batch in Sampler(flights, options).batches(epoch=0, count=4):
        anchors = [roles(batch, q.anchor) for q in batch.queries]
        assert len({scene for scene, _ in anchors}) == len(anchors) == min(5, count)
        for query in batch.queries:
            scene, anchor = roles(batch, query.anchor)
            similarity = flights[scene].common_points.toarray()
            own = [roles(batch, row) for row in query.positives]
            assert len(set(own)) == positives
            assert {s for s, _ in own} == {scene}
            shared = [similarity[anchor, image] for _, image in own]
            assert min(shared) > options.epsilon
            assert shared == sorted(shared, reverse=True)
            others = {
                roles(batch, row) for q in batch.queries if q is not query for row in q.positives
            }
            negatives = {roles(batch, row) for row in query.negatives}
            flight = {(s, i) for s, i in negatives if s == scene}
            assert negatives - flight == others
            assert len(flight) <= same_flight
            apart = set(flights[scene].apart(anchor).tolist())
            assert {i for _, i in flight} <= apart


def test_batch_of_the_paper_has_five_anchors_with_three_positives() -> None:
    (batch,) = Sampler(scenes(7), SamplingOptions()).batches(0, 1)
    assert len(batch.samples) == 5 * (1 + 3)
    assert all(len(q.negatives) == 4 * 3 for q in batch.queries)


def test_apart_means_no_common_points_and_no_common_neighbour() -> None:
    scene = strip("a", 12, reach=3)
    assert scene.apart(0).tolist() == [7, 8, 9, 10, 11]
    unknown = strip("b", 12, reach=3)
    lonely = Scene(
        **{
            **unknown.__dict__,
            "common_points": symmetric([(0, 1, 50)], 12),
            "matches": symmetric([(0, 1, 50)], 12),
        }
    )
    assert lonely.apart(5).size == 0, "a photo that matched nothing may lie anywhere"
    assert lonely.apart(0).size == 0


def test_the_same_seed_and_epoch_give_the_same_batches() -> None:
    flights = scenes(4)
    first = Sampler(flights, SamplingOptions(seed=5, same_flight=1))
    again = Sampler(flights, SamplingOptions(seed=5, same_flight=1))
    assert first.batches(2, 6) == again.batches(2, 6)
    assert first.batches(2, 6) != first.batches(3, 6)
    other = Sampler(flights, SamplingOptions(seed=6, same_flight=1))
    assert first.batches(2, 6) != other.batches(2, 6)


def test_global_mining_takes_the_nearest_photos_of_other_scenes() -> None:
    flights = scenes(4, images=9)
    rng = np.random.default_rng(0)
    descriptors = [rng.normal(size=(9, 5)) for _ in flights]
    descriptors = [d / np.linalg.norm(d, axis=1, keepdims=True) for d in descriptors]
    sampler = Sampler(flights, SamplingOptions(mining="global", scenes=3, positives=1))
    for batch in sampler.batches(0, 5, descriptors):
        for query in batch.queries:
            scene, anchor = roles(batch, query.anchor)
            negatives = [roles(batch, row) for row in query.negatives]
            assert len({s for s, _ in negatives} - {scene}) == 2
            for other, image in negatives:
                distances = np.linalg.norm(descriptors[other] - descriptors[scene][anchor], axis=1)
                assert image == distances.argmin()
    origins = [scene.origin for scene in flights]
    assert len(nearest_of_other_scenes(descriptors, origins, 0, 0)) == 3


def with_cuts(flights: list[Scene]) -> list[Scene]:
    """The flights, and a pseudo-scene of each of their photos."""
    cut = PseudoOptions(views=5, seed=2)
    return flights + [pseudo_scene(s, i, (40, 30), cut) for s in flights for i in range(len(s))]


@pytest.mark.parametrize("mining", ["nontrivial", "global"])
def test_a_cut_of_a_photo_is_no_negative_of_its_own_flight(mining: str) -> None:
    """Neither of a photo of the flight, nor of another cut of it."""
    flights = with_cuts(scenes(3))
    rng = np.random.default_rng(0)
    descriptors = [rng.normal(size=(len(scene), 5)) for scene in flights]
    options = SamplingOptions(mining=mining, scenes=3, positives=1, epsilon=5, pseudo_share=0.5)
    cuts = anchors = 0
    for batch in Sampler(flights, options).batches(0, 20, descriptors):
        origins = [flights[scene].origin for scene, _ in batch.samples]
        assert len({origins[query.anchor] for query in batch.queries}) == 3
        for query in batch.queries:
            of_negatives = [origins[row] for row in query.negatives]
            assert origins[query.anchor] not in of_negatives
            assert len(of_negatives) == len(set(of_negatives)) == 2
            anchors += 1
            cuts += flights[batch.samples[query.anchor][0]].crops is not None
    assert 0.3 < cuts / anchors < 0.7


def test_a_flight_of_too_few_photos_still_gives_its_cuts_to_a_batch() -> None:
    flights = with_cuts([strip("whole", 12), strip("tiny", 2)])
    options = SamplingOptions(positives=2, epsilon=5, pseudo_share=0.3)
    for batch in Sampler(flights, options).batches(0, 10):
        assert {flights[scene].origin for scene, _ in batch.samples} == {"whole", "tiny"}


def test_one_flight_and_its_cuts_are_one_scene() -> None:
    with pytest.raises(InputError, match=r"one usable scene only \(scene0\)"):
        Sampler(with_cuts(scenes(1)), SamplingOptions(positives=2, pseudo_share=0.3))


def test_flight_batches_use_all_relations_of_many_photos_of_few_flights() -> None:
    flights = scenes(3, images=15)
    options = SamplingOptions(mining="flight", scenes=2, flight_photos=10)
    (batch,) = Sampler(flights, options).batches(0, 1)
    assert len(batch.samples) == 20 and len({scene for scene, _ in batch.samples}) == 2
    assert len(batch.queries) > 15
    for query in batch.queries:
        scene, anchor = roles(batch, query.anchor)
        similarity = flights[scene].common_points.toarray()[anchor]
        apart = set(flights[scene].apart(anchor).tolist())
        own = {i for s, i in batch.samples if s == scene}
        assert {roles(batch, r) for r in query.negatives} == {(scene, i) for i in apart & own}
        assert {roles(batch, r) for r in query.positives} == {
            (scene, int(i)) for i in np.flatnonzero(similarity > 15) if i in own
        }


def test_unmatched_photos_are_negatives_where_all_pairs_were_tried() -> None:
    scene = strip("a", 12, reach=3)
    assert scene.unmatched(0).tolist() == [4, 5, 6, 7, 8, 9, 10, 11]
    partly = Scene(**{**scene.__dict__, "method": "bow"})
    assert partly.unmatched(0).tolist() == partly.apart(0).tolist() == [7, 8, 9, 10, 11]
    weak = Scene(**{**scene.__dict__, "matches": symmetric([(0, 5, 12), (0, 6, 3)], 12)})
    assert weak.unmatched(0).tolist() == [4, 6, 7, 8, 9, 10, 11], "12 matches are too many"
    assert weak.matched(0).size == 0


def test_one_scene_alone_is_refused_unless_same_flight_negatives_are_asked_for() -> None:
    with pytest.raises(InputError, match="one usable scene only"):
        Sampler(scenes(1), SamplingOptions())
    with pytest.raises(InputError, match="one usable scene only"):
        Sampler(scenes(1), SamplingOptions(mining="global", same_flight=1))
    (batch,) = Sampler(scenes(1, 20), SamplingOptions(same_flight=2)).batches(0, 1)
    assert batch.queries[0].negatives
    with pytest.raises(InputError, match="surely apart"):
        Sampler(scenes(1, 5), SamplingOptions(same_flight=2))


def test_a_scene_with_too_few_photos_is_left_out_and_named() -> None:
    sampler = Sampler([*scenes(2), strip("tiny", 3)], SamplingOptions())
    assert len(sampler.left_out) == 1
    assert "tiny" in sampler.left_out[0] and "3 photos" in sampler.left_out[0]
    assert all(s != 2 for batch in sampler.batches(0, 10) for s, _ in batch.samples)
    with pytest.raises(InputError, match="No scene can give a batch"):
        Sampler([strip("tiny", 3), strip("small", 2)], SamplingOptions())


def test_views_that_show_other_parts_of_two_photos_are_no_positives() -> None:
    """Two photos of the same ground: GS is counted over what both views show."""
    photo = (400, 300)
    options = PseudoOptions(views=6, seed=1)
    scene = pseudo_scene(strip("a", 2), 0, photo, options)
    assert len(scene) == 6
    batch = Batch(((0, 0), (0, 1), (0, 2)), (Query(0, (1, 2), ()),))
    whole = np.stack([np.eye(3)] * 3)
    kept = by_views(batch, [scene], whole, photo, 0)
    similarity = scene.common_points.toarray()
    (query,) = kept.queries
    assert set(query.positives) == {i for i in (1, 2) if similarity[0, i] > 0}
    assert [similarity[0, i] for i in query.positives] == sorted(
        (similarity[0, i] for i in query.positives), reverse=True
    )
    aside = whole.copy()
    aside[1] = [[1, 0, 5], [0, 1, 0], [0, 0, 1]]  # shows nothing of the cut
    (query,) = by_views(batch, [scene], aside, photo, 0).queries
    assert 1 not in query.positives and 1 in query.negatives
    aside[2] = aside[1]
    assert by_views(batch, [scene], aside, photo, 0).queries == ()
    unknown = [strip("b", 3)]
    assert by_views(batch, unknown, aside, photo, 0) == batch, "nothing is known of observations"


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), width=st.integers(100, 500), height=st.integers(100, 500))
def test_overlap_of_pseudo_scenes_is_that_of_their_pixels(
    seed: int, width: int, height: int
) -> None:
    """Paint what view 0 shows on the photo; view 1 finds as much of it as GS says."""
    photo = (width, height)
    scene = pseudo_scene(strip("a", 2), 1, photo, PseudoOptions(views=2, seed=seed))
    assert scene.crops is not None
    inside = np.zeros((height, width, 3), np.uint8)
    for y in range(height):
        xs = (np.arange(width) + 0.5 - width / 2) / max(photo)
        ys = np.full(width, (y + 0.5 - height / 2) / max(photo))
        inside[y] = 255 * visible(scene.crops[0], np.stack([xs, ys], 1), photo)[0][:, None]
    shown = render(inside, View(np.eye(3)), photo, scene.crops[1])
    # Grid points of view 1 that are painted, against GS of the two views.
    assert scene.observations is not None
    _, at = scene.observations.of(1)
    columns = np.clip(np.rint(at[:, 0] * max(photo) + width / 2 - 0.5), 0, width - 1)
    rows = np.clip(np.rint(at[:, 1] * max(photo) + height / 2 - 0.5), 0, height - 1)
    painted = int((shown[rows.astype(int), columns.astype(int), 0] > 127).sum())
    assert abs(painted - scene.common_points[0, 1]) <= 0.08 * len(at) + 2


def test_views_are_the_same_for_the_same_seed_and_turn_by_any_angle() -> None:
    turns = []
    for seed in range(40):
        drawn = [
            draw_view(np.random.default_rng(seed), (400, 300), (96, 64), Augmentation())
            for _ in range(2)
        ]
        assert np.array_equal(drawn[0].homography, drawn[1].homography)
        x, y = drawn[0].homography[:2, 0]
        turns.append(np.degrees(np.arctan2(y, x)) % 360)
    assert all(any(low <= t < low + 90 for t in turns) for low in (0, 90, 180, 270))


def test_a_view_without_changes_is_the_photo() -> None:
    photo = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    assert np.array_equal(render(photo, View(np.eye(3)), (64, 48)), photo)
    half = render(photo, View(np.eye(3)), (32, 24))
    assert abs(float(half.mean()) - float(photo.mean())) < 3
    bright = render(photo, View(np.eye(3), brightness=30.0), (64, 48))
    assert bright.mean() > photo.mean() + 15
