"""Sub-models are joined by their shared points, or refused."""

import numpy as np
import pycolmap
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from colmap_netvlad.mapping.merge import (
    MIN_SHARED_POINTS,
    Refused,
    SubModel,
    join,
    merge,
    seen_once,
    shared_points,
    similarity,
)

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-50, 50, (400, 3)) * [1, 1, 0.1]
"""Ground points; the keypoint index of a point is its row, in every image."""


def pose(image: int) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([-10.0 * image, 0, 100]))


def sub_model(
    name: str,
    images: range,
    points: range,
    world: pycolmap.Sim3d | None = None,
    focal: float = 800.0,
) -> SubModel:
    """A sub-model in which every image sees every point, in a world of its own."""
    world = world or pycolmap.Sim3d()
    matrix = world.matrix()
    keys = np.array([image << 32 | point for image in images for point in points], np.int64)
    return SubModel(
        name,
        poses={i: world.transform_camera_world(pose(i)) for i in images},
        cameras={1: (np.array([focal, 500, 375, 0.0]), len(images))},
        rigs={},
        xyz=POINTS[points] @ matrix[:, :3].T + matrix[:, 3],
        color=np.zeros((len(points), 3), np.uint8),
        keys=keys,
        owner=np.tile(np.arange(len(points)), len(images)),
        pixel=100 / 800 * world.scale,
    )


WORLD = pycolmap.Sim3d(
    3.0, pycolmap.Rotation3d(np.array([0.1, 0.1, 0.7, 0.7])), np.array([5.0, -7.0, 2.0])
)


def centre(model: SubModel, image: int) -> np.ndarray:
    matrix = model.poses[image].matrix()
    return -matrix[:, :3].T @ matrix[:, 3]


def test_points_are_shared_through_common_observations() -> None:
    a, b = sub_model("a", range(1, 5), range(0, 30)), sub_model("b", range(4, 8), range(20, 60))
    assert shared_points(a, b).tolist() == [[20 + k, k] for k in range(10)]
    assert len(shared_points(a, sub_model("c", range(5, 9), range(0, 30)))) == 0


def test_similarity_of_shared_points_is_the_one_between_the_worlds() -> None:
    a = sub_model("a", range(1, 5), range(0, 100))
    b = sub_model("b", range(4, 8), range(50, 150), WORLD)
    found = similarity(a, b, shared_points(a, b))
    assert found.matrix() == pytest.approx(WORLD.inverse().matrix(), abs=1e-6)


def test_joined_model_has_tracks_poses_and_one_camera_of_both() -> None:
    a = sub_model("a", range(1, 5), range(0, 100), focal=800)
    b = sub_model("b", range(4, 6), range(50, 150), WORLD, focal=830)
    joined = join(a, b)
    assert sorted(joined.poses) == [1, 2, 3, 4, 5]
    assert len(joined.xyz) == 150
    assert len(joined.keys) == len(set(joined.keys.tolist())) == 4 * 100 + 2 * 100 - 50
    assert (np.diff(joined.keys) > 0).all()
    lengths = np.bincount(joined.owner)
    assert sorted(set(lengths.tolist())) == [2, 4, 5]
    assert centre(joined, 5) == pytest.approx([50, 0, -100], abs=1e-5)
    keypoint = joined.keys & 0xFFFFFFFF
    assert joined.xyz[joined.owner] == pytest.approx(POINTS[keypoint], abs=1e-5)
    params, images = joined.cameras[1]
    assert params[0] == pytest.approx((800 * 4 + 830 * 2) / 6)
    assert images == 6


def test_a_track_sees_each_image_once() -> None:
    a = sub_model("a", range(1, 4), range(0, 100))
    b = sub_model("b", range(3, 6), range(0, 100), WORLD)
    # In b, image 1 sees each point through another keypoint than in a.
    wrong = np.array([1 << 32 | (1000 + point) for point in range(100)], np.int64)
    b.keys = np.concatenate([wrong, b.keys])
    b.owner = np.concatenate([np.arange(100), b.owner])
    joined = join(a, b)
    seen = np.stack([joined.owner, joined.keys >> 32], axis=1)
    assert len(np.unique(seen, axis=0)) == len(seen)
    assert not np.isin(wrong, joined.keys).any()


def test_too_few_shared_points_are_refused() -> None:
    a = sub_model("a", range(1, 5), range(0, 30))
    b = sub_model("b", range(4, 8), range(30 - MIN_SHARED_POINTS + 1, 60))
    with pytest.raises(Refused, match="shares only 19 points"):
        join(a, b)


def test_outlier_sub_model_is_refused_and_reported_and_others_joined() -> None:
    a = sub_model("a", range(1, 9), range(0, 100))
    bent = sub_model("bent", range(6, 12), range(30, 100), WORLD)
    bent.xyz = np.random.default_rng(1).uniform(-50, 50, bent.xyz.shape)
    c = sub_model("c", range(7, 11), range(60, 160), WORLD)
    first, second = merge([a, bent, c])
    assert first.members == ["a", "c"]
    assert [name for name, _ in first.refused] == ["bent"]
    assert "agree" in first.refused[0][1]
    assert second.members == ["bent"]


def test_shared_points_on_one_line_are_refused() -> None:
    a = sub_model("a", range(1, 5), range(0, 50))
    a.xyz = np.linspace(0, 1, 50)[:, None] * [[30.0, 20.0, 0.0]] + RNG.normal(0, 1e-3, (50, 3))
    b = sub_model("b", range(4, 8), range(0, 50))
    b.xyz = a.xyz * 2
    with pytest.raises(Refused, match="one line"):
        join(a, b)


def test_sub_models_are_joined_in_the_order_of_shared_points() -> None:
    base = sub_model("base", range(1, 10), range(0, 200))
    few = sub_model("few", range(9, 12), range(170, 300), WORLD)
    many = sub_model("many", range(9, 13), range(100, 220), WORLD)
    assert merge([few, base, many])[0].members == ["base", "many", "few"]


def test_a_sub_model_without_a_share_in_others_stays_a_model_of_its_own() -> None:
    a, b = sub_model("a", range(1, 6), range(0, 50)), sub_model("b", range(6, 9), range(0, 50))
    assert [merged.members for merged in merge([a, b])] == [["a"], ["b"]]
    assert merge([]) == []


def test_a_refused_sub_model_is_tried_again_when_more_is_joined() -> None:
    a = sub_model("a", range(1, 9), range(0, 100))
    late = sub_model("late", range(8, 12), range(60, 300), WORLD)
    late.xyz[:40] = RNG.permutation(late.xyz[:40])  # all that it shares with `a`
    bridge = sub_model("bridge", range(8, 11), range(70, 300), WORLD)
    merged = merge([a, late, bridge])[0]
    assert merged.members == ["a", "bridge", "late"]
    assert merged.refused == []


@settings(deadline=None, max_examples=20)
@given(st.floats(0.01, 100), st.integers(0, 10**6), st.floats(0, 0.5))
@example(1.0, 111264, 0.140625)
def test_similarity_is_found_for_any_scale_in_spite_of_outliers(scale, seed, outliers) -> None:
    rng = np.random.default_rng(seed)
    turn = pycolmap.Rotation3d(rng.normal(size=4))
    turn.normalize()
    world = pycolmap.Sim3d(scale, turn, rng.normal(size=3) * 100)
    a = sub_model("a", range(1, 5), range(0, 200))
    b = sub_model("b", range(4, 8), range(0, 200), world)
    wrong = rng.random(200) < outliers
    b.xyz[wrong] = b.xyz[wrong][rng.permutation(wrong.sum())]
    joined = join(a, b)
    assert centre(joined, 6) == pytest.approx([60, 0, -100], abs=0.2)


@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_an_image_sees_a_point_once_the_first_time(kind: type[np.integer]) -> None:
    rng = np.random.default_rng(0)
    owner, image = rng.integers(0, 40, 2000).astype(kind), rng.integers(2**31 - 30, 2**31, 2000)
    keys = image << 32 | np.arange(2000)
    first: dict[tuple[int, int], int] = {}
    for row, seen in enumerate(zip(owner.tolist(), image.tolist(), strict=True)):
        first.setdefault(seen, row)
    assert seen_once(keys, owner).tolist() == list(first.values())
