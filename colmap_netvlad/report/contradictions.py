"""Verified pairs that the finished model contradicts: its points are at two places."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.colmap.database import Database
from colmap_netvlad.graph.lookalikes import Lookalike
from colmap_netvlad.graph.pair import as_pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.report.ground import Frame
from colmap_netvlad.report.modeldata import ModelData

SAME_POINT = 0.2
"""A pair is contradicted only where at most this share of its matches sees one point."""

AWAY = 0.1
"""Points of a match farther apart than this share of the camera's distance are two places."""


def with_model(
    found: Sequence[Lookalike],
    database: Database,
    data: ModelData,
    frame: Frame,
    points_of: Callable[[str], NDArray[np.int64]],
) -> list[Lookalike]:
    """Add the pairs whose matches the model has at two places, the strongest case first.

    Args:
        found: what the pairs themselves and GPS say.
        points_of: tells of a registered image which 3D point each keypoint sees, or -1.
    """
    known = {one.pair for one in found}
    index = {name: i for i, name in enumerate(data.names)}
    names = {row.image_id: row.name for row in database.images()}
    more = []
    for (a, b), count in sorted(database.verified_matches().items()):
        one, two = names.get(a, ""), names.get(b, "")
        pair = as_pair(one, two)
        if count <= CORRECT_MATCHES or one not in index or two not in index or pair in known:
            continue
        matches = database.inlier_matches(a, b)
        first, second = points_of(one)[matches[:, 0]], points_of(two)[matches[:, 1]]
        both = (first >= 0) & (second >= 0)
        if both.sum() <= CORRECT_MATCHES or (first == second)[both].mean() > SAME_POINT:
            continue
        apart = both & (first != second)
        ends = np.searchsorted(data.point_ids, [first[apart], second[apart]])
        distance = np.linalg.norm(data.points[ends[0]] - data.points[ends[1]], axis=1)
        far = float(np.median(distance))
        limit = AWAY * float(data.depths[index[one]])
        if far > limit:
            unit = "m" if frame.metric else "units of the model"
            reason = (
                f"The model has what its matches join at two places, {far * frame.scale:,.1f} "
                f"{unit} apart."
            )
            more.append(Lookalike(pair, count, reason, False, far / limit))
    return sorted([*found, *more], key=lambda one: (not one.contradicted, -one.strength, one.pair))
