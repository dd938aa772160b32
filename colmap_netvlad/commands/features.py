"""What `colmap-netvlad features` does: photos -> SIFT features in a COLMAP database."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from colmap_netvlad.cache.photos import contents
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.colmap.features import FeatureOptions, FeatureReport, extract_features
from colmap_netvlad.photos.files import find_photos
from colmap_netvlad.photos.shutters import find_rolling_shutters
from colmap_netvlad.project import Project

DEFAULT_OPTIONS = FeatureOptions()

IMPORTED = "imported "
"""Before a photo's name, the cache's key of the file that its features are of."""

REPLACED = (
    "was replaced since its features were extracted: the database keeps the old ones; delete the "
    "image there, or import the photos into a new database"
)


def import_photos(
    images: str | Path, database: str | Path, options: FeatureOptions = DEFAULT_OPTIONS
) -> FeatureReport:
    """Import a folder of photos into a database (made where it is not there), extract SIFT.

    The photo folder is remembered in the project's cache, and of which files the features are:
    photos that were replaced since are listed as `bad`.

    Raises:
        InputError: as `extract_features`.
    """
    folder, file = Path(images), Path(database)
    before = _with_features(file)
    report = extract_features(folder, file, options)
    with Store(Project(file, folder).cache) as store:
        store.remember_images(folder)
        replaced = _replaced(store, folder, before, _with_features(file))
    return replace(report, bad=[*report.bad, *((name, REPLACED) for name in replaced)])


def _with_features(database: Path) -> set[str]:
    """Return the names of the images that have features."""
    if not database.exists():
        return set()
    with open_database(database) as colmap:
        done = colmap.images_with_features()
        return {row.name for row in colmap.images() if row.image_id in done}


def _replaced(store: Store, folder: Path, before: set[str], now: set[str]) -> list[str]:
    """Remember which files the new features are of; return the photos of old ones that differ."""
    files = {IMPORTED + name: folder / name for name in sorted(now)}
    kept = store.photos()
    found, _ = contents(store, files)
    other = {
        key: kept[key]
        for key in files
        if key in kept and key in found and kept[key].content != found[key]
    }
    replaced = {key: photo for key, photo in other.items() if key.removeprefix(IMPORTED) in before}
    store.keep_photos(replaced)  # their features are still of the old files
    return [key.removeprefix(IMPORTED) for key in replaced]


def report_lines(report: FeatureReport, images: Path, database: Path) -> list[str]:
    """Return what `colmap-netvlad features` prints: what was done, and rolling shutters."""
    shutters = find_rolling_shutters(images, find_photos(images))
    return [
        f"Photos: {report.photos:,}, {report.already:,} with features before, "
        f"{report.extracted:,} extracted now ({report.features:,} features), "
        f"{report.cameras:,} camera{'s' if report.cameras != 1 else ''} in {database}.",
        *(shutter.sentence() for shutter in shutters),
    ]
