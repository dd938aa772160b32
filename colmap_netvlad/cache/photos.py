"""What is in photo files, read again only where a file's size or time has changed."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from colmap_netvlad.cache.store import SeenPhoto, Store
from colmap_netvlad.photos.files import BadPhoto, file_stamp, photo_fingerprint
from colmap_netvlad.photos.positions import CoordinateSystem, PosePrior, read_gps
from colmap_netvlad.runtime.progress import step

Value = TypeVar("Value")


def contents(store: Store, files: Mapping[str, Path]) -> tuple[dict[str, str], dict[str, str]]:
    """Return (key -> content fingerprint) and (key -> reason) of files that have none.

    Args:
        files: key -> path; the keys are names of photos, or other names that say what they are.
    """
    seen, bad = _look(store, files, lambda photo: photo.content is not None, _with_content)
    return {key: photo.content for key, photo in seen.items() if photo.content is not None}, bad


def gps_positions(store: Store, files: Mapping[str, Path]) -> dict[str, PosePrior]:
    """Return the EXIF GPS of photos that have any; see `photos.positions.read_gps`."""
    seen, _ = _look(store, files, lambda photo: photo.gps is not None, _with_gps)
    found = {key: _prior(photo.gps) for key, photo in seen.items() if photo.gps}
    return {key: prior for key, prior in found.items() if prior is not None}


def _prior(text: str) -> PosePrior | None:
    try:
        latitude, longitude, height = map(float, json.loads(text))
    except (TypeError, ValueError):  # a damaged cache
        return None
    return PosePrior((latitude, longitude, height), CoordinateSystem.WGS84)


def _look(
    store: Store,
    files: Mapping[str, Path],
    known: Callable[[SeenPhoto], bool],
    read: Callable[[Path, SeenPhoto], SeenPhoto],
) -> tuple[dict[str, SeenPhoto], dict[str, str]]:
    """Return what is known of each file, read now where it is not, and what is wrong with some."""
    kept = store.photos()
    stamps, bad = _each(files, lambda key: file_stamp(files[key]))
    seen = {
        key: kept[key] if key in kept and kept[key].stamp == stamp else SeenPhoto(stamp)
        for key, stamp in stamps.items()
    }
    missing = [key for key, photo in seen.items() if not known(photo)]
    with step("Looking at photos", len(missing)) as bar:

        def look(key: str) -> SeenPhoto:
            photo = read(files[key], seen[key])
            bar.advance()
            return photo

        found, faults = _each(missing, look)
    store.keep_photos(found)
    return {key: photo for key, photo in (seen | found).items() if key not in faults}, bad | faults


def _each(
    keys: Iterable[str], function: Callable[[str], Value]
) -> tuple[dict[str, Value], dict[str, str]]:
    """Return the function's value by key, and the reason where it said that a photo is bad."""

    def one(key: str) -> tuple[str, Value | None, str]:
        try:
            return key, function(key), ""
        except BadPhoto as fault:
            return key, None, str(fault)

    with ThreadPoolExecutor() as pool:
        results = list(pool.map(one, keys))
    values = {key: value for key, value, reason in results if value is not None and not reason}
    return values, {key: reason for key, _, reason in results if reason}


def _with_content(path: Path, photo: SeenPhoto) -> SeenPhoto:
    return replace(photo, content=photo_fingerprint(path))


def _with_gps(path: Path, photo: SeenPhoto) -> SeenPhoto:
    prior = read_gps(path)
    return replace(photo, gps="" if prior is None else json.dumps(prior.position))
