"""Which photos a model lacks, and why: what the database knows of each."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.colmap.database import Database
from colmap_netvlad.graph.verified import CORRECT_MATCHES

LEAST_POINTS = 30
"""3D points a photo must see to be registered (COLMAP's `abs_pose_min_num_inliers`)."""

ELSEWHERE = "in another model"
NO_FEATURES = "no features"
NOT_MATCHED = "not matched"
NO_VERIFIED_PAIR = "no verified pair"
APART = "joined to missing photos only"
TOO_FEW_POINTS = "too few points"
LEFT_OUT = "left out by the mapper"


@dataclass(frozen=True)
class MissingPhoto:
    """A photo of the database without a pose.

    Attributes:
        reason: one of the reasons above.
        details: a sentence with the numbers.
        pairs: verified pairs it has.
        points: 3D points of the model that its verified matches lead to.
    """

    name: str
    reason: str
    details: str
    pairs: int = 0
    points: int = 0


def missing_photos(
    database: Database,
    registered: Collection[str],
    points_of: Callable[[str], NDArray[np.int64]],
    elsewhere: Collection[str] = (),
) -> list[MissingPhoto]:
    """Return the photos of a database that a model lacks, by name, each with the reason.

    Args:
        registered: images of the model.
        points_of: tells of a registered image which 3D point each keypoint sees, or -1.
        elsewhere: images that other models of the same run have.
    """
    rows = database.images()
    names = {row.image_id: row.name for row in rows}
    features = database.keypoint_counts()
    partners: dict[int, list[tuple[int, int]]] = {row.image_id: [] for row in rows}
    for (a, b), count in database.verified_matches().items():
        if a in names and b in names:
            partners[a].append((b, count))
            partners[b].append((a, count))
    found = []
    for image_id, name in sorted(names.items(), key=lambda item: item[1]):
        if name in registered:
            continue
        tried = partners[image_id]
        verified = [other for other, count in tried if count > CORRECT_MATCHES]
        into_model = [other for other in verified if names[other] in registered]
        points: set[int] = set()
        for other in into_model:
            theirs = database.inlier_matches(image_id, other)[:, 1]
            seen = points_of(names[other])
            points.update(seen[theirs[theirs < len(seen)]].tolist())
        points.discard(-1)
        most = max((count for _, count in tried), default=0)
        reason, details = _reason(
            name in elsewhere, features.get(image_id, 0), len(tried), most, len(verified),
            len(into_model), len(points),
        )  # fmt: skip
        found.append(MissingPhoto(name, reason, details, len(verified), len(points)))
    return found


def _reason(
    elsewhere: bool,
    features: int,
    tried: int,
    most: int,
    verified: int,
    into_model: int,
    points: int,
) -> tuple[str, str]:
    if elsewhere:
        return ELSEWHERE, "It has a pose in another model of the same run."
    if not features:
        return NO_FEATURES, "No features were found in it: very dark, blurred, or without texture."
    if not tried:
        return NOT_MATCHED, f"It has {features:,} features and was matched with no photo."
    if not verified:
        return NO_VERIFIED_PAIR, (
            f"Matched with {tried:,} photos, at most {most:,} verified matches with any "
            f"(more than {CORRECT_MATCHES} are needed). More partners (`k`) or `rounds` may help."
        )
    if not into_model:
        return APART, (
            f"Its {verified:,} verified pairs lead to photos that are missing too. "
            "More partners (`k`) or `rounds` may join them."
        )
    if points < LEAST_POINTS:
        return TOO_FEW_POINTS, (
            f"{into_model:,} verified pairs with registered photos, but they lead to {points:,} "
            f"of the model's points; {LEAST_POINTS} are needed."
        )
    return LEFT_OUT, (
        f"Its matches lead to {points:,} of the model's points, but no pose agreed with enough of "
        "them: a look-alike place, strong blur, or a wrong focal length."
    )
