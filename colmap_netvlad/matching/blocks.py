"""Guided matching of many pairs: processes take blocks of them, this one writes what they find.

A process keeps the features of the photos it met last; blocks follow each other through tiles of
photos (`run`), so that a photo is read few times. One thread each: the products are small.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import LOCK_SECONDS
from colmap_netvlad.colmap.database import Database, open_database
from colmap_netvlad.colmap.parts import part_of_pairs
from colmap_netvlad.colmap.results import PairResult, camera_of, write_results
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.matching.features import SiftFeatures, prepare
from colmap_netvlad.matching.guided import Stage, match
from colmap_netvlad.matching.options import MatchOptions, Work
from colmap_netvlad.matching.verify import verify
from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.jobs import Source
from colmap_netvlad.runtime.products import one_thread
from colmap_netvlad.runtime.sequences import blocks

logger = logging.getLogger(__name__)

BLOCK = 128
"""Pairs that a process takes at a time, some seconds: with fewer it reads photos oftener."""

WORTH_A_PROCESS = 256
"""Fewer pairs than this take less time than a process takes to start."""

KEPT_FEATURES = 2**20
"""Features of the photos that a process keeps, 160 bytes each: 128 photos of 8,192."""

WRITE_PAIRS = 512
WRITE_SECONDS = 5.0
"""Results are written when there are so many, or so long after the last."""


@dataclass(frozen=True, eq=False)
class Photo:
    """What matching needs of a photo."""

    features: SiftFeatures
    camera: pycolmap.Camera


class Photos:
    """The photos that a process met last, at most `KEPT_FEATURES` of their features."""

    def __init__(self) -> None:
        self._kept: OrderedDict[int, Photo] = OrderedDict()

    def get(self, database: Database, image_id: int) -> Photo:
        """Return a photo, read from the database unless it is kept."""
        if image_id not in self._kept:
            features = prepare(
                database.keypoint_shapes(image_id), database.sift_descriptors(image_id)
            )
            self._kept[image_id] = Photo(features, camera_of(database, image_id))
            while len(self._kept) > 2 and self._features() > KEPT_FEATURES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(image_id)
        return self._kept[image_id]

    def _features(self) -> int:
        return sum(len(photo.features) for photo in self._kept.values())


@dataclass
class BlockReport:
    """What came of a block.

    Attributes:
        results: of all its pairs.
        given_up: how many of them were not searched.
        not_finite: images that have keypoints which are not finite.
        seconds: time at work, s.
    """

    results: list[PairResult] = field(default_factory=list)
    given_up: int = 0
    not_finite: set[int] = field(default_factory=set)
    seconds: float = 0.0


def match_guided(
    database: Path, pairs: Sequence[IdPair], options: MatchOptions, advance: Callable[[int], None]
) -> Work:
    """Match and verify pairs with the matcher `guided`, as `matchers.Match`."""
    given_up, busy, not_finite = 0, 0.0, set[int]()
    waiting: list[PairResult] = []
    written = time.monotonic()
    try:
        with closing(_reports(database, pairs, options)) as reports:
            for report in reports:
                given_up += report.given_up
                busy += report.seconds
                not_finite |= report.not_finite
                waiting += report.results
                advance(len(report.results))
                if len(waiting) >= WRITE_PAIRS or time.monotonic() - written > WRITE_SECONDS:
                    ready, waiting = waiting, []
                    write_results(database, ready)
                    written = time.monotonic()
    finally:
        write_results(database, waiting)
    if not_finite:
        with open_database(database) as colmap:
            names = [row.name for row in colmap.images() if row.image_id in not_finite]
        logger.warning(
            "%d image%s keypoints that are not finite, which are passed over (first: %s).",
            len(names),
            "s have" if len(names) > 1 else " has",
            names[0],
        )
    return Work(given_up, busy / _most(options))


def _reports(
    database: Path, pairs: Sequence[IdPair], options: MatchOptions
) -> Generator[BlockReport, None, None]:
    count = max(1, min(_most(options), len(pairs) // WORTH_A_PROCESS))
    if count == 1:
        photos, tasks = Photos(), (pairs[part] for part in blocks(len(pairs), BLOCK))
        return (match_block(photos, database, options, task) for task in tasks)
    begin = partial(_begin, engine.initialiser())
    source = Source(database, part_of_pairs)
    return workers.results(partial(_match_block, options), pairs, count, begin, source, first=BLOCK)


def _most(options: MatchOptions) -> int:
    return options.processes or workers.capacity().processors


_photos: Photos
"""Of a process that works for another."""


def _begin(initialise: Callable[[], None]) -> None:
    global _photos
    initialise()
    _photos = Photos()


def _match_block(options: MatchOptions, database: Path, pairs: Sequence[IdPair]) -> BlockReport:
    return match_block(_photos, database, options, pairs)


def match_block(
    photos: Photos, database: Path, options: MatchOptions, pairs: Sequence[IdPair]
) -> BlockReport:
    """Match and verify the pairs of a block; after Ctrl-C, no more of them."""
    report, start = BlockReport(), time.monotonic()
    with one_thread(), open_database(database, LOCK_SECONDS) as colmap:
        for pair in pairs:
            if workers.unwanted():
                break
            both = photos.get(colmap, pair[0]), photos.get(colmap, pair[1])
            matched = match(both[0].features, both[1].features, options.thorough)
            report.given_up += matched.stage is Stage.GIVEN_UP
            report.results.append(_verified(pair, both, matched.matches, options.seed))
            report.not_finite.update(
                image_id
                for image_id, photo in zip(pair, both, strict=True)
                if np.isnan(photo.features.at).any()
            )
    report.seconds = time.monotonic() - start
    return report


def _verified(
    pair: IdPair, both: tuple[Photo, Photo], matches: np.ndarray, seed: int
) -> PairResult:
    one, other = both
    places = one.features.at, other.features.at
    geometry = verify((one.camera, other.camera), places, matches, seed)
    return PairResult(pair, matches, geometry)
