"""What a matcher of our own reads of a photo's camera, and writes of image pairs.

COLMAP itself writes the rows, into a database beside, from which they are copied in one short
transaction: they are what its own matcher would have written, in every version of the schema.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_matches
from colmap_netvlad.colmap.database import Database, pair_id
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import scratch_folder

MIN_MATCHES = 15
"""Fewer matches than this COLMAP's matcher writes as none."""


@dataclass(frozen=True, eq=False)
class PairResult:
    """What came of a pair.

    Attributes:
        pair: image ids, lower first.
        matches: (M, 2) keypoints of both that match.
        geometry: what verification made of them.
    """

    pair: tuple[int, int]
    matches: NDArray[np.uint32]
    geometry: pycolmap.TwoViewGeometry


def camera_of(database: Database, image_id: int) -> pycolmap.Camera:
    """Return the camera of an image as COLMAP reads it."""
    row = database.connection.execute(
        "SELECT c.camera_id, c.model, c.width, c.height, c.params, c.prior_focal_length"
        " FROM images i JOIN cameras c USING (camera_id) WHERE i.image_id = ?",
        (image_id,),
    ).fetchone()
    if row is None:
        raise InputError(
            f"Image {image_id} of {database.path} has no camera; import the photos again."
        )
    camera_id, model, width, height, params, prior = row
    camera = pycolmap.Camera(
        model=pycolmap.CameraModelId(model),
        width=width,
        height=height,
        params=np.frombuffer(params or b"", np.float64),
    )
    camera.camera_id = camera_id
    camera.has_prior_focal_length = bool(prior)
    return camera


def write_results(target: Path, results: Sequence[PairResult]) -> None:
    """Write matches and two-view geometries of some pairs, all of them or none.

    Raises:
        InputError: the disk is full, or another process holds the database too long.
    """
    if not results:
        return
    engine.check_space(target.parent)
    try:
        with scratch_folder() as folder:
            beside = Path(folder, "results.db")
            _write(beside, results)
            copy_matches(beside, target, [pair_id(*result.pair) for result in results])
    except sqlite3.OperationalError as fault:
        raise InputError(
            f"Cannot write matches into {target}: {fault}. What is matched stays there; run the "
            "command again to go on."
        ) from fault


def _write(path: Path, results: Sequence[PairResult]) -> None:
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for result in results:
            few = len(result.matches) < MIN_MATCHES
            matches = np.zeros((0, 2), np.uint32) if few else result.matches
            database.write_matches(*result.pair, matches)
            database.write_two_view_geometry(*result.pair, result.geometry)
