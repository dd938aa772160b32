"""Pairs -> matches and two-view geometries in the database: what is asked, what is left to do."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.matching.matchers import usable_matcher
from colmap_netvlad.matching.options import MatchOptions, MatchReport, Work
from colmap_netvlad.matching.stale import check_same_features
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError

logger = logging.getLogger(__name__)

TILE = 16
"""Pairs between the same two groups of this many images are matched together: a matcher reads or
indexes an image once for all of them, which with COLMAP's takes longer than to match a pair."""


def match_pairs(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    options: MatchOptions = MatchOptions(),
) -> MatchReport:
    """Match image pairs and verify them geometrically, writing into `database`.

    pycolmap brings a database of COLMAP 3.x to the schema of COLMAP 4. A script that calls this
    needs Python's `if __name__ == "__main__":`, as the processes import it again.

    Raises:
        InputError: an unknown image name, no features at all, damaged ones or others than SIFT,
            matches of features that are no longer there, an unknown matcher, or a database that
            cannot be written; a process that failed: what was matched by then stays.
    """
    engine.check_writable(database)
    with open_database(database) as colmap:
        ids = {row.name: row.image_id for row in colmap.images()}
        keypoints, descriptors = colmap.keypoint_counts(), colmap.descriptor_counts()
        done = colmap.matched_pairs()
        if options.thorough:
            done -= colmap.pairs_without_matches()  # those given up before among them
        not_sift = colmap.not_sift()
        matcher, note = usable_matcher(options, colmap.has_sift())
        check_same_features(
            colmap, {_sorted_ids(ids[a], ids[b]) for a, b in pairs if {a, b} <= ids.keys()} & done
        )
    unknown = sorted({name for pair in pairs for name in pair} - set(ids))
    if unknown:
        raise InputError(f"{database} has no image {unknown[0]}; make the pairs list again.")
    if pairs and not keypoints:
        raise InputError(
            f"No image in {database} has features; extract them with `colmap-netvlad features`."
        )
    requested = sorted({_sorted_ids(ids[a], ids[b]) for a, b in pairs if a != b})
    todo = [pair for pair in requested if pair not in done]
    work, start = Work(), time.monotonic()
    if todo:
        names = {image_id: name for name, image_id in ids.items()}
        _check_features(database, names, todo, keypoints, descriptors, not_sift)
        if note:
            logger.warning(note)
        engine.make_or_migrate(database)  # brings an old schema up to date
        with progress.step("Matching pairs", len(todo)) as bar:
            work = matcher.match(database, in_tiles(todo), options, bar.advance)
    seconds = time.monotonic() - start
    with open_database(database) as colmap:
        verified = colmap.verified_matches()
    return MatchReport(
        requested=len(requested),
        already=len(requested) - len(todo),
        matched=len(todo),
        verified=sum(verified.get(pair, 0) > 0 for pair in requested),
        seconds=seconds,
        given_up=work.given_up,
        matcher=matcher.name,
        even_seconds=work.even_seconds,
    )


def _check_features(
    database: Path,
    names: Mapping[int, str],
    todo: Sequence[IdPair],
    keypoints: Mapping[int, int],
    descriptors: Mapping[int, int],
    not_sift: Collection[int],
) -> None:
    """Refuse damaged features and those of other kinds than SIFT, and say where there are none."""
    wanted = sorted({image_id for pair in todo for image_id in pair})
    others = [names[image_id] for image_id in wanted if image_id in not_sift]
    if others:
        raise InputError(
            f"{len(others)} of the photos to match (first: {others[0]}) have other local features "
            f"than SIFT in {database}, which no matcher here takes: match them where they were "
            "extracted, or import the photos into a new database with `colmap-netvlad features`."
        )
    for image_id in wanted:
        there = keypoints.get(image_id, 0), descriptors.get(image_id, 0)
        if descriptors and there[0] != there[1]:
            raise InputError(
                f"{names[image_id]} has {there[0]:,} keypoints but {there[1]:,} descriptors in "
                f"{database}: its features are damaged; extract them again."
            )
    bare = {image_id for image_id in wanted if image_id not in keypoints}
    if bare:
        lost = sum(not bare.isdisjoint(pair) for pair in todo)
        logger.warning(
            "%d image%s no features (first: %s); %d pair%s with them cannot be verified.",
            len(bare),
            "s have" if len(bare) > 1 else " has",
            names[min(bare)],
            lost,
            "s" if lost > 1 else "",
        )


def _sorted_ids(id1: int, id2: int) -> IdPair:
    return (id1, id2) if id1 < id2 else (id2, id1)


def in_tiles(pairs: Sequence[IdPair]) -> list[IdPair]:
    """Return the pairs in an order in which neighbours in the list share images."""
    ids = np.unique(pairs)
    ends = np.searchsorted(ids, pairs)
    graph = sparse.coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(len(ids), len(ids)))
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    place = np.empty(len(ids), np.int64)
    place[order] = np.arange(len(ids))
    tiles = np.sort(place[ends], axis=1) // TILE
    return [pairs[i] for i in np.lexsort((ends[:, 1], ends[:, 0], tiles[:, 1], tiles[:, 0]))]
