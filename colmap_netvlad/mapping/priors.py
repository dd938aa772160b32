"""Position priors in the adjustment: a database of its own carries them to COLMAP's mappers.

COLMAP's mapper takes priors from the database alone. The user's is left as it is: what mapping
needs is copied, with the priors in a metric frame and their covariances.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.colmap.copies import copy_images
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.runtime.files import temporary_prefix

LOSS_SCALE = 2.795483482915107
"""Standard deviations from which a prior loses weight: the square root of 7.815, the 95 % quantile
of chi-squared with three degrees of freedom."""

UNKNOWN_HEIGHT = 1e3
"""Standard deviation of a height that is not known, m: it has no say."""


@dataclass(frozen=True, eq=False)
class PositionPriors:
    """Where camera centres are, and how well that is known.

    Attributes:
        names: of N images.
        metres: (N, 3) in a metric frame with z up; NaN where nothing is known, NaN z where the
            height alone is not.
        deviations: (N, 3) standard deviations, m.
    """

    names: tuple[str, ...]
    metres: NDArray[np.float64]
    deviations: NDArray[np.float64]

    def fingerprint(self) -> str:
        """Return what tells these priors from others."""
        digest = hashlib.sha256("\n".join(self.names).encode())
        digest.update(self.metres.tobytes())
        digest.update(self.deviations.tobytes())
        return digest.hexdigest()


@contextmanager
def with_priors(database: Path, priors: PositionPriors | None, folder: Path) -> Iterator[Path]:
    """Yield a temporary database in `folder` with what mapping needs, and the priors.

    Without priors it is the database itself.

    Raises:
        InputError: the database cannot be read, or the folder not be written.
    """
    if priors is None:
        yield database
        return
    with tempfile.TemporaryDirectory(
        prefix=temporary_prefix(folder / "priors"), dir=folder
    ) as temporary:
        copy = Path(temporary, "priors.db")
        copy_images(database, copy, image_names(database))
        write_priors(copy, priors)
        yield copy


def write_priors(database: Path, priors: PositionPriors) -> None:
    """Write priors into a database of ours, instead of any it has."""
    opened = pycolmap.Database.open(database)
    try:
        with pycolmap.DatabaseTransaction(opened):
            opened.clear_pose_priors()
            images = {image.name: image for image in opened.read_all_images()}
            for name, place, deviation in zip(
                priors.names, priors.metres, priors.deviations, strict=True
            ):
                if name in images and np.isfinite(place[:2]).all():
                    opened.write_pose_prior(_prior(images[name], place, deviation))
    finally:
        opened.close()


def _prior(
    image: pycolmap.Image, place: NDArray[np.float64], deviation: NDArray[np.float64]
) -> pycolmap.PosePrior:
    low = np.isnan(place)
    prior = pycolmap.PosePrior()
    prior.position = np.where(low, 0.0, place)
    prior.position_covariance = np.diag(np.where(low, UNKNOWN_HEIGHT, deviation) ** 2)
    prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    prior.corr_data_id = image.data_id
    return prior
