"""What `colmap-netvlad features` does: photos -> SIFT features in a COLMAP database."""

from __future__ import annotations

from pathlib import Path

from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.features import FeatureOptions, FeatureReport, extract_features
from colmap_netvlad.photos.files import find_photos
from colmap_netvlad.photos.shutters import find_rolling_shutters
from colmap_netvlad.project import Project

DEFAULT_OPTIONS = FeatureOptions()


def import_photos(
    images: str | Path, database: str | Path, options: FeatureOptions = DEFAULT_OPTIONS
) -> FeatureReport:
    """Import a folder of photos into a database (made where it is not there), extract SIFT.

    The photo folder is remembered in the project's cache.

    Raises:
        InputError: as `extract_features`.
    """
    folder, file = Path(images), Path(database)
    report = extract_features(folder, file, options)
    with Store(Project(file, folder).cache) as store:
        store.remember_images(folder)
    return report


def report_lines(report: FeatureReport, images: Path, database: Path) -> list[str]:
    """Return what `colmap-netvlad features` prints: what was done, and rolling shutters."""
    shutters = find_rolling_shutters(images, find_photos(images))
    return [
        f"Photos: {report.photos:,}, {report.already:,} with features before, "
        f"{report.extracted:,} extracted now ({report.features:,} features), "
        f"{report.cameras:,} camera{'s' if report.cameras != 1 else ''} in {database}.",
        *(shutter.sentence() for shutter in shutters),
    ]
