"""Correspondences of local features: which are drawn, where they are read, what they cost."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_netvlad.models.aggregation import AdaptedNetVLAD, NetVLAD
from colmap_netvlad.training.augment import Augmentation, PseudoOptions, draw_view, pseudo_scene
from colmap_netvlad.training.correspondences import (
    TOO_NEAR,
    Correspondences,
    correspondence_loss,
    draw_correspondences,
    sample,
    too_near,
)
from colmap_netvlad.training.sampling import Batch
from colmap_netvlad.training.scenes import Scene, symmetric

PHOTO = (400, 300)
VIEW = (96, 64)


def cuts(seed: int, views: int = 5) -> Scene:
    """Views cut from one photo: point p of the grid is the same place of the photo in each."""
    bare = Scene(
        name="a",
        images=Path("a"),
        names=("0.jpg", "1.jpg"),
        common_points=symmetric([], 2),
        matches=symmetric([], 2),
        sizes=np.tile(np.array(PHOTO, np.int32), (2, 1)),
        model=np.zeros(2, np.int32),
        poses=np.zeros((2, 7)),
        points=0,
        method="exhaustive",
    )
    return pseudo_scene(bare, 0, PHOTO, PseudoOptions(views=views, seed=seed))


def back(homography: np.ndarray, at: np.ndarray) -> np.ndarray:
    moved = np.linalg.inv(homography) @ [*at, 1.0]
    return moved[:2] / moved[2]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(2, 60))
def test_the_two_places_of_a_correspondence_show_the_same_ground(seed: int, count: int) -> None:
    scenes = [cuts(seed), cuts(seed + 1)]
    rng = np.random.default_rng(seed)
    samples = tuple((scene, image) for scene in (0, 1) for image in range(5))
    views = [draw_view(rng, PHOTO, VIEW, Augmentation()).homography for _ in samples]
    homographies = np.stack(views)
    batch = Batch(samples, ())
    drawn = list(draw_correspondences(batch, scenes, homographies, VIEW, count, rng))
    assert drawn, "views of one photo have points in common"
    for found in drawn:
        assert 1 < len(found) <= count
        assert len({samples[row][0] for row in found.rows.ravel().tolist()}) == 1
        assert (found.rows[0] != found.rows[1]).all(), "two views, not one twice"
        assert (np.abs(found.at) <= np.array(VIEW) / max(VIEW) / 2 + 1e-9).all()
        for rows, places in zip(found.rows.T.tolist(), found.at.transpose(1, 0, 2), strict=True):
            ground = []
            for row, at in zip(rows, places, strict=True):
                scene, image = samples[row]
                crops = scenes[scene].crops
                assert crops is not None
                ground.append(back(homographies[row] @ crops[image], at))
            np.testing.assert_allclose(ground[0], ground[1], atol=1e-4)


def test_scenes_without_known_points_give_no_correspondences() -> None:
    scene = cuts(0)
    unknown = Scene(**{**scene.__dict__, "observations": None})
    same = np.stack([np.eye(3)] * 2)
    rng = np.random.default_rng(0)
    batch = Batch(((0, 0), (0, 1)), ())
    assert list(draw_correspondences(batch, [unknown], same, VIEW, 9, rng)) == []


@pytest.mark.parametrize("size", [(96, 64), (64, 96)])
def test_features_are_read_where_the_points_are(size: tuple[int, int]) -> None:
    """A map that holds its own coordinates gives them back."""
    width, height = size[0] // 8, size[1] // 8
    xs = ((np.arange(width) + 0.5) / width - 0.5) * size[0] / max(size)
    ys = ((np.arange(height) + 0.5) / height - 0.5) * size[1] / max(size)
    maps = torch.from_numpy(np.stack(np.meshgrid(xs, ys)))[None].repeat(3, 1, 1, 1)
    maps[1] += 10
    rows = np.array([[0, 1, 2], [1, 0, 1]])
    at = np.random.default_rng(0).uniform(-0.25, 0.25, (2, 3, 2))
    read = sample(maps, Correspondences(rows, at), size).numpy()
    expected = at.reshape(-1, 2) + 10 * (rows.reshape(-1, 1) == 1)
    np.testing.assert_allclose(read, expected, atol=1e-6)


def literal_loss(
    features: np.ndarray, found: Correspondences, size: tuple[int, int], temperature: float
) -> float:
    """One sum at a time, the features read at the centres of cells."""

    def feature(side: int, point: int) -> np.ndarray:
        height, width = features.shape[2:]
        x, y = found.at[side, point] * max(size)
        column = round((x / size[0] + 0.5) * width - 0.5)
        row = round((y / size[1] + 0.5) * height - 0.5)
        value = features[found.rows[side, point], :, row, column]
        return value / np.linalg.norm(value)

    def near(i: int, j: int) -> bool:
        return any(
            found.rows[a, i] == found.rows[b, j]
            and math.dist(found.at[a, i], found.at[b, j]) < TOO_NEAR
            for a in (0, 1)
            for b in (0, 1)
        )

    count, total = len(found), 0.0
    for side in (0, 1):
        for i in range(count):
            share = 0.0
            for j in range(count):
                if j == i or not near(i, j):
                    score = float(feature(side, i) @ feature(1 - side, j)) / temperature
                    share += math.exp(score)
            own = math.exp(float(feature(side, i) @ feature(1 - side, i)) / temperature)
            total -= math.log(own / share)
    return total / (2 * count)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), temperature=st.floats(0.05, 1.0))
def test_the_loss_equals_its_literal_definition(seed: int, temperature: float) -> None:
    rng = np.random.default_rng(seed)
    size, cells, views, count = (96, 64), (12, 8), 4, 10
    features = rng.normal(size=(views, 6, cells[1], cells[0])).astype(np.float32)
    rows = np.stack([rng.permutation(views)[:2] for _ in range(count)], axis=1)
    places = rng.integers(0, np.array(cells), (2, count, 2))
    at = ((places + 0.5) / np.array(cells) - 0.5) * np.array(size) / max(size)
    found = Correspondences(rows, at)
    loss = correspondence_loss(
        torch.from_numpy(features), found, NetVLAD(6, 2), size, temperature
    ).item()
    assert loss == pytest.approx(literal_loss(features, found, size, temperature), rel=1e-4)


def test_points_that_lie_too_near_in_a_view_are_not_told_apart() -> None:
    rows = np.array([[0, 0, 0], [1, 1, 2]])
    at = np.array([[[0.0, 0.0], [0.3, 0.0], [0.0, 0.05]], [[0.0, 0.0], [0.05, 0.0], [0.3, 0.3]]])
    near = too_near(Correspondences(rows, at))
    assert near.tolist() == [[False, True, True], [True, False, False], [True, False, False]]


def test_noise_and_the_adapting_network_are_part_of_the_loss() -> None:
    torch.manual_seed(0)
    layer = AdaptedNetVLAD(6, 2, hidden=8)
    layer.initialise(np.random.default_rng(0).normal(size=(50, 6)).astype(np.float32))
    features = torch.randn(2, 6, 8, 12, requires_grad=True)
    at = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 12, 2))
    rows = np.repeat([[0], [1]], 12, axis=1)
    found = Correspondences(rows, at)
    quiet = correspondence_loss(features, found, layer, (96, 64), 0.1)
    noisy = correspondence_loss(features, found, layer, (96, 64), 0.1, torch.randn(24, 6))
    assert quiet.item() != noisy.item()
    quiet.backward()
    assert features.grad is not None and features.grad.abs().sum() > 0
    assert layer.adapt[-1].weight.grad.abs().sum() > 0
    assert layer.centres.grad is None, "centres are found among the features, not trained"


def test_correspondences_can_be_learned() -> None:
    """Turned views of random ground: features with a nuisance that adapting has to ignore."""
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    ground = rng.normal(size=(4, 8, 12))
    views = [np.concatenate([ground, np.full((4, 8, 12), 3.0) * turn]) for turn in (-1, 1)]
    maps = torch.from_numpy(np.stack(views).astype(np.float32))
    layer = AdaptedNetVLAD(8, 2, hidden=16)
    layer.initialise(maps.permute(0, 2, 3, 1).reshape(-1, 8).numpy())
    optimizer = torch.optim.Adam(layer.adapt.parameters(), 1e-2)
    losses = []
    for _ in range(60):
        cells = np.stack([rng.integers(0, 12, 20), rng.integers(0, 8, 20)], axis=1)
        at = ((cells + 0.5) / np.array([12, 8]) - 0.5) * np.array([96, 64]) / 96
        found = Correspondences(np.repeat([[0], [1]], 20, axis=1), np.stack([at, at]))
        loss = correspondence_loss(maps, found, layer, (96, 64), 0.1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
