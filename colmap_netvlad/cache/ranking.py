"""The result of every retrieval method: for each image an ordered list of partners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

NO_PARTNER = -1
"""Fills a row of `Ranking.partners` after its last partner."""


@dataclass(frozen=True, eq=False)
class Ranking:
    """For every image an ordered list of partners with scores.

    Attributes:
        names: N image names, relative to the photo folder, in the database's order.
        partners: (N, K) int32, indices into `names`, best first; never the image itself,
            no partner twice; `NO_PARTNER` after the last one.
        scores: (N, K) float32, higher is more similar, comparable within a row; -inf where
            there is no partner.
        method: the method's name in the table of methods.
        seconds_describe: T_fe of the paper's eq. 20: describing the images, s.
        seconds_search: T_nns of eq. 20: searching the neighbours, s.
        notes: sentences for the report (which vocabulary tree, what came from the cache).
        left_out: (image name, reason) of images that could not be described; their rows are
            empty.
        compared: whether its candidates were compared place by place (`retrieval.rerank`).
        every_pair: whether it stands for all pairs, which no k cuts.
        unseen: (image name, reason) of photos that the deep model could not describe; they are
            ranked by what else is known of them, and compared with nobody.
    """

    names: tuple[str, ...]
    partners: NDArray[np.int32]
    scores: NDArray[np.float32]
    method: str
    seconds_describe: float = 0.0
    seconds_search: float = 0.0
    notes: tuple[str, ...] = field(default=())
    left_out: tuple[tuple[str, str], ...] = field(default=())
    compared: bool = False
    every_pair: bool = False
    unseen: tuple[tuple[str, str], ...] = field(default=())

    def __post_init__(self) -> None:
        shape = (len(self.names), self.partners.shape[1])
        if self.partners.shape != shape or self.scores.shape != shape:
            raise ValueError(
                f"partners {self.partners.shape} and scores {self.scores.shape} "
                f"do not fit {len(self.names)} images"
            )

    @property
    def not_described(self) -> frozenset[str]:
        """Names of the images that have no cells of now: those left out, and those unseen."""
        return frozenset(name for name, _ in (*self.left_out, *self.unseen))

    def left_out_lines(self) -> list[str]:
        """Return one line for each photo that could not be used, or not seen."""
        return [
            *(f"Left out: {name} {reason}" for name, reason in self.left_out),
            *(f"Ranked without the photo: {name} {reason}" for name, reason in self.unseen),
        ]

    def with_unseen(self, bad: Mapping[str, str]) -> Ranking:
        """Return the ranking with the photos that could not be described (name -> reason): those
        that are not left out are `unseen`."""
        out = {name for name, _ in self.left_out}
        unseen = tuple((name, reason) for name, reason in bad.items() if name not in out)
        return replace(self, unseen=unseen)

    @property
    def depth(self) -> int:
        """K, the number of partners kept for an image."""
        return int(self.partners.shape[1])

    def top(self, k: int) -> Ranking:
        """Return the ranking cut to the first `k` partners of each image, unless it is of all
        pairs."""
        if self.every_pair:
            return self
        return replace(self, partners=self.partners[:, :k], scores=self.scores[:, :k])
