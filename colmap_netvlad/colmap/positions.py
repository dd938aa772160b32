"""Positions of photos by name: a database's priors first, then GPS in the photos' EXIF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.photos.files import leaves_folder
from colmap_netvlad.photos.positions import PosePrior, read_gps
from colmap_netvlad.runtime import progress


def find_priors(
    names: Sequence[str], database: Path | None, images: Path | None
) -> list[PosePrior | None]:
    """Return what is known of each photo's position, in the order of the names.

    Args:
        names: of the photos, relative to `images`; one that leads out of it is not opened.
        database: COLMAP database, or None where there is none.
        images: photo folder, or None where it is not known.

    Raises:
        InputError: the database cannot be read.
    """
    priors: dict[str, PosePrior] = {}
    if database is not None:
        with open_database(database) as opened:
            by_id = opened.pose_priors()
            priors = {
                row.name: by_id[row.image_id] for row in opened.images() if row.image_id in by_id
            }
    found = [priors.get(name) for name in names]
    missing = [i for i, prior in enumerate(found) if prior is None and not leaves_folder(names[i])]
    if missing and images is not None and images.is_dir():
        with progress.step("Reading GPS of photos", len(missing)) as bar:
            for i in missing:
                found[i] = read_gps(images / names[i])
                bar.advance()
    return found
