"""Tracks of verified matches: what sees the same point, without a reconstruction.

Where a scene is matched already but there is no time to reconstruct it, the tracks that structure
from motion would start from stand for 3D points. They lack its filter: a wrong match that passed
two-view verification stays in.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.training.scenes import Observations


def tracks(database: Path) -> tuple[Observations, int]:
    """Return what each image of a matched database observes, and the number of tracks.

    Keypoints linked by verified matches (of correct pairs, > 15 matches) are one track. A track
    that has two keypoints of one image contradicts itself and is left out.

    Raises:
        InputError: the database cannot be read.
    """
    with open_database(database) as opened:
        rows = opened.images()
        index = {row.image_id: number for number, row in enumerate(rows)}
        keypoints = [opened.keypoints(row.image_id) for row in rows]
        first = np.cumsum([0, *map(len, keypoints)])
        links = [np.zeros((0, 2), np.int64)]
        for (a, b), count in opened.verified_matches().items():
            if count > CORRECT_MATCHES:
                offset = first[[index[a], index[b]]]
                links.append(opened.inlier_matches(a, b).astype(np.int64) + offset)
    owner = np.repeat(np.arange(len(rows)), np.diff(first))
    track = _tracks_of(np.concatenate(links), owner)
    number = np.unique(track[track >= 0])
    kept = np.flatnonzero(track >= 0)
    sizes = np.array([(row.width, row.height) for row in rows], np.float64).reshape(-1, 2)
    position = np.concatenate([np.zeros((0, 2)), *keypoints])[kept]
    at = (position - sizes[owner[kept]] / 2) / sizes[owner[kept]].max(axis=1, keepdims=True)
    starts = np.searchsorted(owner[kept], np.arange(len(rows) + 1))
    points = np.searchsorted(number, track[kept]).astype(np.int32)
    return Observations(starts, points, at.astype(np.float32)), len(number)


def _tracks_of(links: NDArray[np.int64], owner: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the track of each keypoint, -1 where it has none or one that contradicts itself."""
    count = len(owner)
    graph = sparse.coo_array((np.ones(len(links), np.int8), links.T), shape=(count, count))
    track = connected_components(graph.tocsr(), directed=False)[1].astype(np.int64)
    order = np.lexsort((owner, track))
    twice = (np.diff(track[order]) == 0) & (np.diff(owner[order]) == 0)
    lengths = np.bincount(track, minlength=1)
    bad = np.zeros(len(lengths), bool)
    bad[track[order][1:][twice]] = True
    bad |= lengths < 2
    return np.where(bad[track], -1, track)
