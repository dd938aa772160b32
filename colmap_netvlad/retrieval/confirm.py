"""The largest SIFT features of two photos, asked whether they agree.

Cells tell a piece of ground from another by what it is; where all of it is alike (palms, canopy,
water) few of them agree on the right transform. There the features that matching goes by help: the
largest are few, each says by itself how one photo lies in the other (`graph.oriented`), and those
that match by chance do not agree.

Each is looked for among those of its own word alone: a match falls on one word in both photos, or
is lost, and all products together are an eighth of those of all features with all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_netvlad.flight import Flight
from colmap_netvlad.graph.oriented import (
    Matches,
    Motions,
    angles,
    largest_first,
    scales,
    usable,
)
from colmap_netvlad.runtime.products import operand, products

if TYPE_CHECKING:
    import torch

LARGEST = 2000
"""Features of a photo, those of the largest scales, which photos of other heights show too."""

LARGE = 800
"""Of these, the larger ones: a match of two of them counts twice as much as another. Small features
tell weak overlaps, and they are the ones that a car has like every other car of its make."""

LARGEST_FEATURES = f"{LARGEST:,} largest SIFT features, {LARGE} of them twice"
"""What the store numbers them under: counts of other features have other numbers."""

WORDS_FILE = "sift_words.npy"
"""(W, 128) int8, mean directions of SIFT descriptors (`scripts/make_sift_words.py`)."""

RATIO = 0.9
MAX_ANGLE = 0.7
"""A match must be so much more alike than the most alike of other places of its own photos (share
of the angle between descriptors), and alike at all (rad). Asking each feature's own photo, once,
serves as well as the ratio to the second nearest of each other photo."""

SAME_PLACE = 3.0
"""Features of one photo nearer than this (pixels) are one place seen in two ways."""

MOST_ASKED = 32
"""Matches asked where others lie, the most alike: with more of them chance has more chances."""

HALVED = np.rint(np.arange(256) / 2).clip(0, 127).astype(np.int8)
"""Each value of a descriptor halved, so that its bytes are signed ones."""

UNIT = 256.0
"""Length of halved descriptors: COLMAP's have 512."""


@dataclass(frozen=True, eq=False)
class Largest:
    """The N largest features of a photo, word after word.

    Attributes:
        at: (N, 2) x, y, pixels.
        log_scale: (N,) natural logarithm of the scale.
        angle: (N,) orientation, rad.
        large: (N,) whether it is one of the `LARGE` largest.
        words: where each word's features are, of W words.
        codes: (n, 128) halved descriptors of each word.
        least: (N,) the product of halved descriptors that a match must exceed.
    """

    at: NDArray[np.float32]
    log_scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    large: NDArray[np.bool_]
    words: tuple[slice, ...]
    codes: tuple[torch.Tensor, ...]
    least: NDArray[np.int32]

    @property
    def nbytes(self) -> int:
        """Memory they take."""
        arrays = (self.at, self.log_scale, self.angle, self.large, self.least)
        return sum(a.nbytes for a in arrays) + sum(codes.nbytes for codes in self.codes)

    @classmethod
    def of(cls, keypoints: NDArray[np.float32], descriptors: NDArray[np.uint8]) -> Largest:
        """Choose from features as COLMAP's database keeps them."""
        scale = scales(keypoints)
        order = largest_first(scale, usable(keypoints, scale))[:LARGEST]
        large = np.arange(len(order)) < LARGE
        halved = HALVED[descriptors[order]]
        by_word, words = _by_word(halved)
        order, large, halved = order[by_word], large[by_word], halved[by_word]
        at, codes = keypoints[order, :2], tuple(operand(halved[word]) for word in words)
        return cls(
            at,
            np.log(scale[order]).astype(np.float32),
            angles(keypoints[order]).astype(np.float32),
            large,
            words,
            codes,
            _least(at, words, codes),
        )


def agreeing_features(one: Largest, others: Sequence[Largest]) -> list[int]:
    """Return how many matches of a photo with each of several agree with one of the most alike,
    itself included: the one that most of these agree with.

    Matches of large features count one, others a half. Several at once, as a pair is little work
    beside what it takes to ask for it.
    """
    several = _Several.of(others)
    matches, pair = _matches(one, several)
    if not len(pair):
        return [0] * len(others)
    motions = Motions.of(several, one, matches)
    # The most alike of each pair, one row a pair, asked whether they agree with each other.
    count = np.bincount(pair, minlength=len(others))
    first = np.cumsum(count) - count
    places = np.arange(MOST_ASKED)
    asked = np.minimum(first[:, None] + places, len(pair) - 1)
    there = places < count[:, None]
    rows, columns = motions[asked[:, :, None]], motions[asked[:, None]]
    agree = there[:, :, None] & there[:, None]
    agree &= rows.alike(columns) & rows.predict(columns) & columns.predict(rows)
    best = motions[(first + agree.sum(axis=2).argmax(axis=1))[pair]]
    agree_with_best = motions.alike(best) & motions.predict(best) & best.predict(motions)
    i, j = matches.T
    halves = agree_with_best * (1 + (several.large[i] & one.large[j]))
    counted: list[int] = ((np.bincount(pair, halves, len(others)).astype(int) + 1) // 2).tolist()
    return counted


@dataclass(frozen=True, eq=False)
class _Several:
    """The features of several photos, photo after photo: attributes as of `Largest`.

    Attributes:
        starts: (n,) where each photo's features begin.
    """

    photos: Sequence[Largest]
    starts: NDArray[np.intp]
    at: NDArray[np.float32]
    log_scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    large: NDArray[np.bool_]
    least: NDArray[np.int32]

    @classmethod
    def of(cls, photos: Sequence[Largest]) -> _Several:
        names = ("at", "log_scale", "angle", "large", "least")
        joined = {name: np.concatenate([getattr(p, name) for p in photos]) for name in names}
        sizes = np.array([len(p.at) for p in photos])
        return cls(photos, np.cumsum(sizes) - sizes, **joined)

    def in_word(self, number: int) -> tuple[NDArray[np.intp], list[torch.Tensor]]:
        """Return (M,) where the features of a word are, and their codes photo by photo."""
        words = [photo.words[number] for photo in self.photos]
        where = [
            np.arange(start + word.start, start + word.stop)
            for start, word in zip(self.starts, words, strict=True)
        ]
        return np.concatenate(where), [photo.codes[number] for photo in self.photos]


class LargestFeatures:
    """The largest features of a flight's photos, read from its database when asked for.

    Attributes:
        fingerprints: name -> fingerprint of the features of images that have some.
    """

    def __init__(self, flight: Flight) -> None:
        self._database = flight.database
        self._ids = {i.name: i.image_id for i in flight.images if i.image_id in flight.features}
        self.fingerprints = {name: flight.features[number] for name, number in self._ids.items()}

    def read(self, name: str) -> Largest:
        """Return an image's; none where keypoints and descriptors do not belong together.

        Raises:
            InputError: they are damaged.
        """
        image_id = self._ids[name]
        keypoints = self._database.keypoint_shapes(image_id)
        descriptors = self._database.sift_descriptors(image_id)
        count = len(keypoints) if len(keypoints) == len(descriptors) else 0
        return Largest.of(keypoints[:count], descriptors[:count])


def largest_features(flight: Flight) -> LargestFeatures | None:
    """Return the largest SIFT features of a flight's photos, or None where it has none."""
    return LargestFeatures(flight) if flight.database.has_sift() else None


def _by_word(halved: NDArray[np.int8]) -> tuple[NDArray[np.intp], tuple[slice, ...]]:
    """Return (N,) the order of descriptors by their words; where each word's are then."""
    words = _sift_words()
    word = products(operand(halved), operand(words)).argmax(axis=1)
    ends = np.cumsum(np.bincount(word, minlength=len(words))).tolist()
    slices = tuple(slice(*ends_of) for ends_of in zip([0, *ends], ends, strict=False))
    return np.argsort(word, kind="stable"), slices


@cache
def _sift_words() -> NDArray[np.int8]:
    """Return (W, 128) bytes, all of about one length."""
    with files(__package__).joinpath(WORDS_FILE).open("rb") as file:
        words: NDArray[np.int8] = np.load(file)
    return words


def _matches(one: Largest, several: _Several) -> tuple[Matches, NDArray[np.intp]]:
    """Return (M, 2) matches from the features of several photos to those of one, photo by photo,
    the most alike first; (M,) which photo it is."""
    best, most = _most_alike(one, several)
    found = np.flatnonzero(most > several.least)
    found = found[most[found] > one.least[best[found]]]
    pair = np.searchsorted(several.starts, found, side="right") - 1
    order = np.lexsort((-most[found], pair))
    found, pair = found[order], pair[order]
    # Each feature of the one photo once a pair.
    once = pair * len(one.at) + best[found]
    keep = np.sort(np.unique(once, return_index=True)[1])
    return np.stack([found[keep], best[found[keep]]], axis=1), pair[keep]


def _most_alike(one: Largest, several: _Several) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Return (N,) which feature of the one photo is the most alike of the same word; (N,) their
    product, 0 where there is none."""
    import torch

    best = np.zeros(len(several.at), np.intp)
    most = np.zeros(len(several.at), np.int32)
    for number, word in enumerate(one.words):
        where, codes = several.in_word(number)
        if word.start < word.stop and len(where):
            alike = products(torch.cat(codes), one.codes[number])
            nearest = alike.argmax(axis=1)
            best[where] = word.start + nearest
            most[where] = alike[np.arange(len(nearest)), nearest]
    return best, most


def _least(
    at: NDArray[np.float32], words: Sequence[slice], codes: Sequence[torch.Tensor]
) -> NDArray[np.int32]:
    """Return the product that a match of each feature must exceed."""
    most = np.zeros(len(at), np.float32)
    same_place = cKDTree(at).query_pairs(SAME_PLACE, output_type="ndarray")
    for word, codes_of_word in zip(words, codes, strict=True):
        if word.start < word.stop:
            alike = products(codes_of_word, codes_of_word)
            np.fill_diagonal(alike, 0)
            inside = ((same_place >= word.start) & (same_place < word.stop)).all(axis=1)
            i, j = same_place[inside].T - word.start
            alike[i, j] = alike[j, i] = 0
            most[word] = alike.max(axis=1)
    nearest = np.arccos(np.minimum(most / UNIT**2, 1))
    return np.ceil(UNIT**2 * np.cos(np.minimum(RATIO * nearest, MAX_ANGLE))).astype(np.int32)
