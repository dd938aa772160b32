"""Matches of oriented features: each says by itself how one photo lies in the other.

A SIFT feature has a place, a scale and an orientation, so that a single match already says how
one photo is turned, scaled and shifted in the other. Each match is asked how many others lie
where it predicts and are turned and scaled alike. Wrong matches predict each something else; of
right ones, few among many wrong are enough. There is no single model: a facade and the street
before it may each have their own.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

TURN = 0.5
SCALING = 0.45
"""How far matches that agree may differ in turn (rad) and in logarithm of scaling."""

SHIFT = 60.0
STRETCH = 0.25
"""How far from its predicted place a match may lie: pixels, and share of its distance from the
match that predicts (turn and scale of a feature are inexact, and ground is not flat). Half as
wide keeps more false pairs with the same true ones."""

Matches = NDArray[np.intp]
"""(M, 2) features of two photos."""


class Oriented(Protocol):
    """Features of one photo.

    Attributes:
        at: (N, 2) x, y, pixels.
        log_scale: (N,) natural logarithm of the scale.
        angle: (N,) orientation, rad.
    """

    @property
    def at(self) -> NDArray[np.float32]: ...
    @property
    def log_scale(self) -> NDArray[np.float32]: ...
    @property
    def angle(self) -> NDArray[np.float32]: ...


def agreements(one: Oriented, other: Oriented, matches: Matches) -> NDArray[np.bool_]:
    """Return (M, M) whether two matches each lie where the other predicts; of itself, True."""
    alike = _alike(one, other, matches, matches)
    rows, columns = np.nonzero(alike)
    alike[rows, columns] = predicted(one, other, matches, rows, columns)
    return alike & alike.T


def agreeing_with(
    one: Oriented, other: Oriented, matches: Matches, place: int
) -> NDArray[np.bool_]:
    """Return (M,) that row of `agreements`."""
    agree = _alike(one, other, matches[place : place + 1], matches)[0]
    others = np.flatnonzero(agree)
    this = np.full_like(others, place)
    ends = np.concatenate([this, others]), np.concatenate([others, this])
    agree[others] = predicted(one, other, matches, *ends).reshape(2, -1).all(axis=0)
    return agree


def _alike(one: Oriented, other: Oriented, matches: Matches, others: Matches) -> NDArray[np.bool_]:
    """Return (M, N) whether matches are turned and scaled alike."""
    turn, scaling = _turn_and_scaling(one, other, matches)
    turn_of_others, scaling_of_others = _turn_and_scaling(one, other, others)
    alike = np.outer(np.cos(turn), np.cos(turn_of_others))
    alike += np.outer(np.sin(turn), np.sin(turn_of_others))
    near: NDArray[np.bool_] = np.abs(scaling[:, None] - scaling_of_others) < SCALING
    return near & (alike > np.cos(TURN))


def predicted(
    one: Oriented,
    other: Oriented,
    matches: Matches,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """Return whether the matches `columns` lie where the matches `rows` predict."""
    i, j = matches.T
    turn, scaling = _turn_and_scaling(one, other, matches)
    similarity = np.exp(scaling + 1j * turn).astype(np.complex64)
    from_place, to_place = _complex(one.at[i]), _complex(other.at[j])
    moved = to_place[columns] - to_place[rows]
    off = np.abs(similarity[rows] * (from_place[columns] - from_place[rows]) - moved)
    near: NDArray[np.bool_] = np.less(off, SHIFT + STRETCH * np.abs(moved))
    return near


def _turn_and_scaling(
    one: Oriented, other: Oriented, matches: Matches
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    i, j = matches.T
    return other.angle[j] - one.angle[i], other.log_scale[j] - one.log_scale[i]


def _complex(at: NDArray[np.float32]) -> NDArray[np.complex64]:
    return at[:, 0] + np.complex64(1j) * at[:, 1]


def scales(keypoints: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (N,) scale of keypoints as COLMAP's database keeps them; 1 where they have none."""
    shape = keypoints[:, 2:].astype(np.float64)
    if shape.shape[1] == 2:
        return shape[:, 0]
    if shape.shape[1] == 4:
        a11, a12, a21, a22 = shape.T
        return np.sqrt(np.abs(a11 * a22 - a12 * a21))
    return np.ones(len(shape))


def usable(keypoints: NDArray[np.float32], scale: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (N,) which of such keypoints are whole: all of it finite, and the scale positive."""
    whole: NDArray[np.bool_] = np.isfinite(keypoints).all(axis=1) & (scale > 0)
    return whole


def largest_first(scale: NDArray[np.float64], whole: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return which keypoints are whole, those of the largest scales first, equal ones in order."""
    order = np.flatnonzero(whole)
    return order[np.argsort(-scale[order], kind="stable")]


def angles(keypoints: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (N,) orientation of such keypoints, rad; 0 where they have none."""
    shape = keypoints[:, 2:].astype(np.float64)
    if shape.shape[1] == 2:
        return shape[:, 1]
    if shape.shape[1] == 4:
        return np.arctan2(shape[:, 2], shape[:, 0])
    return np.zeros(len(shape))
