"""Batches: the roles of the paper's eq. 6 to 8, determinism, and what cannot be sampled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_netvlad.errors import InputError
from colmap_netvlad.training.sampling import (
    Batch,
    Sampler,
    SamplingOptions,
    nearest_of_other_scenes,
)
from colmap_netvlad.training.scenes import Scene, symmetric


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
    assert len(nearest_of_other_scenes(descriptors, 0, 0)) == 3


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
