"""Roles of the photos of a batch by what their views show.

A view shows a part of its photo, so two views share fewer points than their photos. GS (eq. 4)
is counted anew over the points that both views show. Ours, as views are: eq. 6 judges photos, and
the negatives of eq. 8 are of other scenes only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.training.augment import Size, visible
from colmap_netvlad.training.sampling import Batch, Query
from colmap_netvlad.training.scenes import Observations, Scene, common_points


def by_views(
    batch: Batch,
    scenes: Sequence[Scene],
    homographies: NDArray[np.float64],
    size: Size,
    epsilon: int,
) -> Batch:
    """Return a batch whose positives are judged, and ordered, by what the views show.

    A positive whose view shares no more than `epsilon` points with the anchor's view leaves; one
    whose view shares none at all becomes a negative. A query that has no positive left leaves.

    Args:
        homographies: (N, 3, 3) from photo to view of each sample.
        size: of the views.
        epsilon: as in eq. 6.
    """
    similarity = _similarity(batch, scenes, homographies, size)
    queries = []
    for query in batch.queries:
        if scenes[batch.samples[query.anchor][0]].observations is None:
            queries.append(query)
            continue
        shared = {row: int(similarity[query.anchor, row]) for row in query.positives}
        positives = sorted(
            (row for row in query.positives if shared[row] > epsilon), key=lambda r: -shared[r]
        )
        parted = [row for row in query.positives if shared[row] == 0]
        if positives:
            negatives = (*query.negatives, *parted)
            queries.append(Query(query.anchor, tuple(positives), negatives))
    return Batch(batch.samples, tuple(queries))


@dataclass(frozen=True, eq=False)
class ViewPoints:
    """The 3D points that a view of a batch shows.

    Attributes:
        row: of the view in the batch.
        points: (m,) indices of the points in its scene.
        at: (m, 2) where in the view: origin in the centre, unit the longer side.
    """

    row: int
    points: NDArray[np.int32]
    at: NDArray[np.float64]


def points_in_views(
    batch: Batch, scenes: Sequence[Scene], homographies: NDArray[np.float64], size: Size
) -> Iterator[list[ViewPoints]]:
    """Yield what the views of each scene show, scene by scene; without scenes of unknown points."""
    for scene in sorted({scene for scene, _ in batch.samples}):
        seen = scenes[scene].observations
        if seen is None:
            continue
        views = []
        for row, (other, image) in enumerate(batch.samples):
            if other == scene:
                points, at = seen.of(image)
                inside, moved = visible(homographies[row], at, size)
                views.append(ViewPoints(row, points[inside], moved[inside]))
        yield views


def _similarity(
    batch: Batch, scenes: Sequence[Scene], homographies: NDArray[np.float64], size: Size
) -> NDArray[np.int32]:
    """Return (N, N) the number of 3D points that the views of two samples share."""
    similarity = np.zeros((len(batch.samples),) * 2, np.int32)
    for views in points_in_views(batch, scenes, homographies, size):
        rows = [view.row for view in views]
        first = np.cumsum([0, *(len(view.points) for view in views)])
        points = np.concatenate([view.points for view in views])
        part = Observations(first, points, np.zeros((len(points), 2), np.float32))
        table = common_points(part, int(points.max(initial=0)) + 1).toarray()
        similarity[np.ix_(rows, rows)] = table
    return similarity
