"""A model is brought to its GPS: robustly, with residuals, and with what is assumed said."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from colmap_netvlad.geo.align import Alignment, NotAligned, align, moved

RNG = np.random.default_rng(3)
WORLD_FROM_MODEL = pycolmap.Sim3d(
    12.5, pycolmap.Rotation3d(np.array([0.3, -2.0, 0.7])), np.array([500.0, -200.0, 80.0])
)
DOWN = np.diag([1.0, -1.0, -1.0])


def flight(lines: int = 4, photos: int = 10, sway: float = 2.0) -> np.ndarray:
    """Return (N, 3) camera centres of a nadir flight, m."""
    places = [
        (40.0 * line, 25.0 * photo, 100.0) for line in range(lines) for photo in range(photos)
    ]
    return np.array(places) + np.random.default_rng(1).normal(0, sway, (len(places), 3))


def model_of(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and cam_from_world rotations of the flight as a model in its own frame."""
    inverse = WORLD_FROM_MODEL.inverse()
    turn = WORLD_FROM_MODEL.rotation.matrix()
    return moved(inverse, places), np.repeat((DOWN @ turn)[None], len(places), axis=0)


def solve(true: np.ndarray, known: np.ndarray) -> Alignment:
    names = [f"{i}.jpg" for i in range(len(true))]
    return align(names, *model_of(true), known)


def error(true: np.ndarray, found: Alignment) -> float:
    """Largest error of a camera centre in the world, m."""
    centres, _ = model_of(true)
    return float(np.linalg.norm(moved(found.world_from_model, centres) - true, axis=1).max())


@pytest.mark.parametrize(("noise", "most"), [(0.0, 1e-6), (0.02, 0.02), (2.0, 2.0)])
def test_a_model_lies_where_its_gps_says(noise: float, most: float) -> None:
    true = flight()
    found = solve(true, true + np.random.default_rng(2).normal(0, noise, true.shape))
    assert error(true, found) <= most
    assert not found.outliers.any()
    assert found.horizontal == pytest.approx(noise * np.sqrt(2), rel=0.3, abs=1e-6)
    assert found.vertical == pytest.approx(noise, rel=0.3, abs=1e-6)


@pytest.mark.parametrize("jump", [(40_000.0, 0, 0), (0, 0, 300.0), (1.0, 0, 0), (0, 0, -1.0)])
def test_wild_positions_have_no_say_and_are_named(jump: tuple[float, float, float]) -> None:
    true = flight()
    known = true + np.random.default_rng(2).normal(0, 0.02, true.shape)
    known[[5, 17]] += jump
    found = solve(true, known)
    assert error(true, found) < 0.02
    assert [found.names[i] for i in np.flatnonzero(found.outliers)] == ["5.jpg", "17.jpg"]
    assert found.horizontal < 0.05


def test_a_photo_without_position_or_height_disables_nothing() -> None:
    true = flight()
    known = true.copy()
    known[3] = np.nan
    known[4, 2] = np.nan
    found = solve(true, known)
    assert error(true, found) < 1e-6
    assert "3.jpg" not in found.names and "4.jpg" in found.names
    assert not found.outliers.any()


def test_without_heights_the_flight_is_taken_to_be_level_and_that_is_said() -> None:
    true = flight(sway=0.0)
    known = true.copy()
    known[:, 2] = np.nan
    found = solve(true, known)
    assert "level" in found.notes[0]
    centres, _ = model_of(true)
    assert moved(found.world_from_model, centres) == pytest.approx(true - [0, 0, 100], abs=1e-3)
    assert np.isnan(found.vertical)


@pytest.mark.parametrize("sway", [0.0, 1e-5, 1.0])
def test_on_one_line_the_photos_are_level(sway: float) -> None:
    true = flight(lines=1, photos=30, sway=sway)
    known = true + np.random.default_rng(2).normal(0, 1.0, true.shape)
    found = solve(true, known)
    assert "one line" in found.notes[0]
    _, rotations = model_of(true)
    seen = rotations[0] @ found.world_from_model.rotation.matrix().T
    assert seen[0, 2] == pytest.approx(0, abs=0.02)  # x level
    assert seen[2, 2] < -0.98  # looking down
    assert error(true, found) < 2.0


def test_two_flights_at_one_height_are_no_line() -> None:
    assert solve(flight(lines=2), flight(lines=2)).notes == ()


def test_a_compact_flight_is_no_line_however_poor_its_gps() -> None:
    noise, squares = 2.0, []
    true = np.array([(16.0 * line, 13.0 * photo, 45.0) for line in range(3) for photo in range(4)])
    centres, rotations = model_of(true)
    names = [f"{i}.jpg" for i in range(len(true))]
    for seed in range(20):
        random = np.random.default_rng(seed)
        sway = Rotation.from_euler("xy", random.normal(0, 2, (len(true), 2)), degrees=True)
        known = true + random.normal(0, noise, true.shape)
        found = align(names, centres, sway.as_matrix() @ rotations, known)
        assert found.notes == ()
        squares.append((moved(found.world_from_model, centres) - true) ** 2)
    # Of seven parameters a shift and two tilts are in height: 3 of 12, the other four on two axes.
    expected = noise * np.sqrt([2 / 12, 2 / 12, 3 / 12])
    assert np.sqrt(np.mean(squares, axis=(0, 1))) == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (np.array([[0.0, 0, 0], [1, 1, 1]]), "Only 2 photos"),
        (np.array([[0.0, 0, 0]]), "Only 1 photo of the model has"),
        (np.full((40, 3), 7.0), "at one position"),
        (np.random.default_rng(5).uniform(-3000, 3000, (40, 3)), "do not fit the model"),
    ],
)
def test_what_cannot_be_placed_is_said(known: np.ndarray, said: str) -> None:
    with pytest.raises(NotAligned, match=said):
        solve(flight()[: len(known)], known)
