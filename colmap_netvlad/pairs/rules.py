"""Who may and who must be whose partner: rig frames, cameras, sequences.

A ranking knows only similarity. These rules take a deep ranking and return one of depth k, or
add pairs to a list, for input of which the user knows more.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path, PurePosixPath

import numpy as np

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.pairs.union import ImagePair
from colmap_netvlad.runtime.errors import InputError


@dataclass(frozen=True)
class PartnerRules:
    """What the user knows beside what the photos look like.

    Attributes:
        other_cameras: least share of an image's partners that other cameras took, 0..1.
        sequential: neighbours in the order of the names that become pairs as well.
        own_pairs: a pairs list of the user's own, joined in.
        across: partners in other flights that each image has besides (see `pairs.sessions`).
    """

    other_cameras: float = 0.0
    sequential: int = 0
    own_pairs: Path | None = None
    across: int = 0

    def check(self) -> None:
        """Raise InputError where a value cannot be meant."""
        if not 0 <= self.other_cameras <= 1:
            raise InputError(f"`other_cameras` is {self.other_cameras}; it is a share, 0 to 1.")
        if self.across < 0:
            raise InputError(f"`across` is {self.across}; it must be at least 0.")
        if self.sequential < 0:
            raise InputError(f"`sequential` is {self.sequential}; it must be at least 0.")


def without_same_frame(ranking: Ranking, frames: Sequence[int | None]) -> Ranking:
    """Return the ranking without partners of an image's own rig frame.

    Photos of one frame are taken at one moment: the rig's calibration relates them, not matches.

    Args:
        frames: the rig frame of each image, None where it has none.
    """
    frame = np.array([-1 if f is None else f for f in frames])
    same = (frame[ranking.partners] == frame[:, None]) & (frame[:, None] >= 0)
    return _drop(ranking, same & (ranking.partners != NO_PARTNER))


def with_camera_quota(ranking: Ranking, cameras: Sequence[int], k: int, share: float) -> Ranking:
    """Return the best `k` partners with at least `share` of them from other cameras.

    Mixed flights fall apart where each camera's photos only know each other. The quota replaces
    an image's last partners of its own camera by its best ones of other cameras, as far as the
    ranking lists any.

    Args:
        cameras: the camera of each image.
        share: 0..1.
    """
    if not share:
        return ranking.top(k)
    camera = np.asarray(cameras)
    wanted = ceil(share * k)
    partners = np.full((len(ranking.names), min(k, ranking.depth)), NO_PARTNER, np.int32)
    scores = np.full(partners.shape, -np.inf, np.float32)
    for i, row in enumerate(ranking.partners):
        listed = np.flatnonzero(row != NO_PARTNER)
        foreign = listed[camera[row[listed]] != camera[i]][:wanted]
        rest = listed[~np.isin(listed, foreign)][: k - len(foreign)]
        kept = np.sort(np.concatenate([foreign, rest]))
        partners[i, : len(kept)] = row[kept]
        scores[i, : len(kept)] = ranking.scores[i, kept]
    return replace(ranking, partners=partners, scores=scores)


def sequential_pairs(names: Iterable[str], neighbours: int) -> list[tuple[str, str]]:
    """Return each image paired with the `neighbours` that follow it in its folder.

    Numbers in names are compared as numbers (`IMG_9` before `IMG_10`): the order of a video's
    frames and of a flight line.
    """
    folders: dict[PurePosixPath, list[str]] = {}
    for name in names:
        folders.setdefault(PurePosixPath(name).parent, []).append(name)
    pairs: list[tuple[str, str]] = []
    for members in folders.values():
        ordered = sorted(members, key=_natural)
        for i, name in enumerate(ordered):
            pairs.extend((name, later) for later in ordered[i + 1 : i + 1 + neighbours])
    return pairs


def join_pairs(
    pairs: Sequence[ImagePair],
    extra: Iterable[tuple[str, str]],
    names: Sequence[str],
) -> list[ImagePair]:
    """Return the pairs with `extra` ones joined in, each once, in the order of `names`.

    An extra pair that the ranking does not hold has score 0 and rank 0: it was asked for.
    """
    place: Mapping[str, int] = {name: i for i, name in enumerate(names)}
    joined = {frozenset((pair.name1, pair.name2)): pair for pair in pairs}
    for a, b in extra:
        key = frozenset((a, b))
        if len(key) == 2 and key not in joined:
            first, second = sorted((a, b), key=place.__getitem__)
            joined[key] = ImagePair(first, second, 0.0, 0)
    return in_order(joined.values(), names)


def in_order(pairs: Iterable[ImagePair], names: Sequence[str]) -> list[ImagePair]:
    """Return pairs in the order of their images' names in a list."""
    place = {name: i for i, name in enumerate(names)}
    return sorted(pairs, key=lambda pair: (place[pair.name1], place[pair.name2]))


def _natural(name: str) -> list[tuple[int, int, str]]:
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.split(r"(\d+)", name)
        if part
    ]


def _drop(ranking: Ranking, unwanted: np.ndarray) -> Ranking:
    """Return the ranking without some partners, the rest moved up."""
    order = np.argsort(unwanted, axis=1, kind="stable")
    partners = np.where(unwanted, NO_PARTNER, ranking.partners)
    scores = np.where(unwanted, -np.inf, ranking.scores)
    return replace(
        ranking,
        partners=np.take_along_axis(partners, order, 1).astype(np.int32),
        scores=np.take_along_axis(scores, order, 1).astype(np.float32),
    )
