"""Where photos were taken, in one frame: priors of the database, else EXIF GPS."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.colmap.positions import find_priors
from colmap_netvlad.geo.frames import LocalFrame, frame_of
from colmap_netvlad.photos.accuracy import read_deviations
from colmap_netvlad.photos.positions import PosePrior, place, read_gps
from colmap_netvlad.runtime import progress

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

DEFAULT_DEVIATIONS = (3.0, 3.0, 5.0)
"""Standard deviations of a position for which none is stated, m east, north, up: a drone's GPS
without corrections."""

SAME_DEGREES, SAME_HEIGHT = 1e-6, 0.1
"""Positions of a database and of a photo that are nearer than this, degrees and m, are one."""

HEIGHTS = "as the photos state them; no geoid model is applied"
"""What is said of heights: EXIF means them above sea level, RTK writes them above the ellipsoid,
and a photo does not tell which."""


@dataclass(frozen=True, eq=False)
class Places:
    """Known positions in m.

    Attributes:
        names: of N photos.
        metres: (N, 3) east, north, up in `frame`; NaN where nothing is known, NaN up where the
            height alone is not.
        frame: None where the priors are cartesian: the world is then their own system.
        notes: sentences on what was put aside.
    """

    names: tuple[str, ...]
    metres: Array
    frame: LocalFrame | None
    notes: tuple[str, ...]

    @property
    def known(self) -> int:
        """How many photos have a position."""
        return int(np.isfinite(self.metres[:, :2]).all(axis=1).sum())

    def of(self, names: Sequence[str]) -> Array:
        """Return (M, 3) m of photos by name; NaN for one that is not known."""
        row = {name: i for i, name in enumerate(self.names)}
        found = np.full((len(names), 3), np.nan)
        for i, name in enumerate(names):
            if name in row:
                found[i] = self.metres[row[name]]
        return found


def find_places(
    names: Sequence[str],
    database: Path | None,
    images: Path | None,
    frame: LocalFrame | None = None,
) -> Places:
    """Look up the positions of photos: the database's priors first, then EXIF GPS.

    What cannot be right is put aside and said (see `photos.positions.place`).

    Args:
        names: of the photos, relative to `images`.
        database: COLMAP database, or None where there is none.
        images: photo folder, or None where it is not known.
        frame: the frame of the positions; None: one in their middle.
    """
    positions = place(find_priors(names, database, images), names)
    if positions.geographic is None:
        return Places(tuple(names), positions.metres, None, positions.notes)
    if not positions.known.any():
        nowhere = np.full((len(names), 3), np.nan)
        return Places(tuple(names), nowhere, frame, positions.notes)
    frame = frame or frame_of(positions.geographic)
    return in_frame(names, positions.geographic, frame, positions.notes)


def in_frame(
    names: Sequence[str], geographic: Array, frame: LocalFrame, notes: tuple[str, ...] = ()
) -> Places:
    """Return places of (N, 3) latitude, longitude, height in a frame.

    An unknown height stays unknown; the place is then projected as if it had the others' height.
    """
    metres = np.full((len(names), 3), np.nan)
    known = np.isfinite(geographic[:, :2]).all(axis=1)
    filled = geographic[known].copy()
    low = ~np.isfinite(filled[:, 2])
    filled[low, 2] = np.median(filled[~low, 2]) if (~low).any() else frame.height
    metres[known] = frame.from_wgs84(filled)
    metres[np.flatnonzero(known)[low], 2] = np.nan
    return Places(tuple(names), metres, frame, notes)


def find_deviations(
    names: Sequence[str],
    database: Path | None,
    images: Path | None,
    stated: tuple[float, float] | None = None,
) -> tuple[Array, int]:
    """Return (N, 3) standard deviations of positions, m, and how many photos state their own.

    Args:
        names: of the photos.
        database: COLMAP database, whose priors' covariances come first.
        images: photo folder, for what XMP and EXIF state.
        stated: horizontal and vertical standard deviation that the user gives for all.
    """
    deviations = np.tile(DEFAULT_DEVIATIONS, (len(names), 1))
    if stated is not None:
        return np.tile([stated[0], stated[0], stated[1]], (len(names), 1)), 0
    own = _prior_deviations(database) if database is not None else {}
    if images is not None and images.is_dir():
        priors = find_priors(names, database, None)
        moved = []
        with progress.step("Reading accuracy of GPS", len(names)) as bar:
            for name, prior in zip(names, priors, strict=True):
                photo = images / name
                if name not in own:
                    if prior is not None and _differ(prior, read_gps(photo)):
                        moved.append(name)
                    elif stating := read_deviations(photo):
                        own[name] = stating
                bar.advance()
        if moved:
            logger.warning(
                "%d photos state another position than %s (first: %s), which counts, with the "
                "accuracy of a GPS without corrections; to use what the photos state now, import "
                "them into a new database.", len(moved), database, moved[0],
            )  # fmt: skip
    for i, name in enumerate(names):
        deviations[i] = own.get(name, DEFAULT_DEVIATIONS)
    return deviations, sum(name in own for name in names)


def _differ(prior: PosePrior, photo: PosePrior | None) -> bool:
    """Whether a database's position is another than the photo's own: that one's accuracy is not
    the database's."""
    if photo is None or prior.coordinate_system != photo.coordinate_system:
        return False
    apart = np.abs(np.subtract(prior.position, photo.position))
    return bool(apart[:2].max() > SAME_DEGREES or apart[2] > SAME_HEIGHT)


def _prior_deviations(database: Path) -> dict[str, tuple[float, float, float]]:
    with open_database(database) as opened:
        by_id = opened.position_deviations()
        return {row.name: by_id[row.image_id] for row in opened.images() if row.image_id in by_id}
