"""Matches of oriented features: each says by itself how one photo lies in the other.

A SIFT feature has a place, a scale and an orientation, so that a single match already says how
one photo is turned, scaled and shifted in the other. Each match is asked how many others lie
where it predicts and are turned and scaled alike. Wrong matches predict each something else; of
right ones, few among many wrong are enough. There is no single model: a facade and the street
before it may each have their own.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Protocol

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


@dataclass(frozen=True, eq=False)
class Motions:
    """What matches say of how one photo lies in the other, each by itself.

    Attributes:
        scaling: natural logarithm.
        cos, sin: of the turn.
        start, end: the places matched, x + iy, pixels.
    """

    scaling: NDArray[np.float32]
    cos: NDArray[np.float32]
    sin: NDArray[np.float32]
    start: NDArray[np.complex64]
    end: NDArray[np.complex64]

    @classmethod
    def of(cls, one: Oriented, other: Oriented, matches: Matches) -> Motions:
        """Return (M,) the motions of matches."""
        i, j = matches.T
        turn = other.angle[j] - one.angle[i]
        return cls(
            other.log_scale[j] - one.log_scale[i],
            np.cos(turn),
            np.sin(turn),
            _complex(one.at[i]),
            _complex(other.at[j]),
        )

    def __getitem__(self, index: Any) -> Motions:
        return Motions(*(getattr(self, field.name)[index] for field in fields(self)))

    def alike(self, other: Motions) -> NDArray[np.bool_]:
        """Return whether both turn and scale alike; shapes are broadcast."""
        near: NDArray[np.bool_] = np.abs(self.scaling - other.scaling) < SCALING
        return near & (self.cos * other.cos + self.sin * other.sin > np.cos(TURN))

    def predict(self, other: Motions) -> NDArray[np.bool_]:
        """Return whether the others end where these predict; shapes are broadcast."""
        similarity = np.exp(self.scaling) * (self.cos + np.complex64(1j) * self.sin)
        moved = other.end - self.end
        off = np.abs(similarity * (other.start - self.start) - moved)
        near: NDArray[np.bool_] = np.less(off, SHIFT + STRETCH * np.abs(moved))
        return near


def agreements(one: Oriented, other: Oriented, matches: Matches) -> NDArray[np.bool_]:
    """Return (M, M) whether two matches each lie where the other predicts; of itself, True."""
    motions = Motions.of(one, other, matches)
    agree = motions[:, None].alike(motions[None])
    rows, columns = np.nonzero(agree)
    agree[rows, columns] = motions[rows].predict(motions[columns])
    return agree & agree.T


def predicted(
    one: Oriented,
    other: Oriented,
    matches: Matches,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """Return whether the matches `columns` lie where the matches `rows` predict."""
    motions = Motions.of(one, other, matches)
    return motions[rows].predict(motions[columns])


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
