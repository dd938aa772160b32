"""Photos -> SIFT features in a COLMAP database, for users who come with a folder of photos.

Each photo is checked before COLMAP sees it: COLMAP itself takes truncated photos for whole ones
and drops others with no more than a line in its log. Photos of one camera are extracted
together, in chunks: COLMAP writes every photo as it is done, so a killed run goes on with the
next one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import write_rows
from colmap_netvlad.colmap.database import ImageRow, open_database
from colmap_netvlad.colmap.parts import PartsOfImport
from colmap_netvlad.photos.bands import lens_band
from colmap_netvlad.photos.files import (
    PHOTO_SUFFIXES,
    BadPhoto,
    PhotoHeader,
    find_photos,
    read_header,
)
from colmap_netvlad.photos.focal import plane_focal
from colmap_netvlad.photos.folders import photo_folders
from colmap_netvlad.photos.masks import check_masks, without_mask
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.jobs import Load, Source
from colmap_netvlad.runtime.machine import usable_memory, usable_processors
from colmap_netvlad.runtime.sequences import listed

CHUNK_PHOTOS = 8
"""Photos of one chunk for each thread; the bar moves once a chunk."""

SHARE_PHOTOS = 4
"""Photos of the smallest share for another machine: each call of COLMAP's makes SIFT's scale space
anew, which takes an eighth of a photo's time."""

SAME_FOCAL = 0.001
"""Focal lengths whose ratio is nearer to one than this are the same: EXIF has five digits."""

SIFT_LONG_SIDE = 3200
"""COLMAP's limit for SIFT where no max image size is given, px."""

SIFT_LEVELS = 15
"""Float pictures SIFT holds at once at its doubled first octave, all octaves counted (about)."""


@dataclass(frozen=True)
class FeatureOptions:
    """How photos are imported.

    Attributes:
        camera: which photos share a camera, one of `CAMERA_MODES`.
        camera_model: COLMAP's name of the model of new cameras.
        max_image_size: longer side at which SIFT runs, px; None: COLMAP's own limit.
        max_features: most features kept of a photo.
        masks: folder of masks in COLMAP's way: `<name>.png` for each photo, features are
            dropped where the mask is black.
        threads: photos extracted at once; None: as many as processors and memory allow.
    """

    camera: str = "auto"
    camera_model: str = "SIMPLE_RADIAL"
    max_image_size: int | None = None
    max_features: int = 8192
    masks: Path | None = None
    threads: int | None = None


@dataclass(frozen=True)
class FeatureReport:
    """What `extract_features` did.

    Attributes:
        photos: photos found in the folder.
        already: those that had features before.
        extracted: those that got features now.
        features: features of the photos extracted now.
        cameras: cameras in the database at the end.
        bad: (name, reason) of the photos left out.
    """

    photos: int
    already: int
    extracted: int
    features: int
    cameras: int
    bad: list[tuple[str, str]] = field(default_factory=list)


CameraKey = tuple[object, ...]


def _same_lens(name: str, header: PhotoHeader) -> CameraKey:
    origin = header.lens or str(PurePosixPath(name).parent)
    return origin, header.serial, lens_band(name, header.band), header.width, header.height


CAMERA_MODES: dict[str, Callable[[str, PhotoHeader], CameraKey]] = {
    "auto": _same_lens,
    "single": lambda name, header: (),
    "per-folder": lambda name, header: (str(PurePosixPath(name).parent),),
    "per-image": lambda name, header: (name,),
}
"""Camera mode -> what photos of one camera have in common.

`auto`: EXIF make, model and focal length, serial number, band, and size: two drones of one model
are two cameras, and so are two lenses of a multispectral one; without these tags folder and size.
COLMAP's own automatic mode gives every photo without EXIF a camera of its own, which makes hundreds
of focal lengths of one drone's camera, each badly determined.
"""


def extract_features(
    images: Path, database: Path, options: FeatureOptions = FeatureOptions()
) -> FeatureReport:
    """Import the photos of a folder into a COLMAP database and extract SIFT with pycolmap.

    The database is made where it is not there; photos that have features in it are passed over,
    so a stopped run goes on and new photos are added. A database of COLMAP 3.x is brought to
    the schema of COLMAP 4 by pycolmap.

    Raises:
        InputError: no photos, unusable options, photos of different sizes for one camera, a
            database of other features, or one that cannot be written.
    """
    names = _check_input(images, options)
    engine.check_writable(database)
    rows, with_features, others = _imported(database)
    check_folder(images, names, [row.name for row in rows])
    names, unnamed = _with_names(names)
    todo = [name for name in names if name not in with_features]
    if todo and others:
        raise InputError(
            f"{database} has other local features than SIFT (of {listed(others)}), and photos are "
            "matched by features of one kind; import them into a new database."
        )
    headers, bad = _read_headers(images, todo)
    if options.masks is not None:
        bad += _without_mask(headers, options.masks)
    groups = _group(images, headers, rows, options)
    with progress.step("Extracting features", sum(len(group.names) for group in groups)) as bar:
        for group in groups:
            _extract_group(images, database, group, options, bar)
    return _report(database, names, todo, bad, unnamed)


@dataclass(frozen=True)
class _Group:
    """New photos of one camera; `camera_id` is None until the database has that camera."""

    mode: pycolmap.CameraMode
    camera_id: int | None
    names: list[str]


def _check_input(images: Path, options: FeatureOptions) -> list[str]:
    if not images.is_dir():
        raise InputError(f"The photo folder {images} does not exist; mend `images`.")
    if options.camera not in CAMERA_MODES:
        raise InputError(f"`camera` is {options.camera}; choose {', '.join(CAMERA_MODES)}.")
    if options.camera_model not in pycolmap.CameraModelId.__members__:
        raise InputError(f"COLMAP has no camera model {options.camera_model}; mend `camera_model`.")
    check_masks(options.masks)
    for name in ("max_image_size", "max_features", "threads"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise InputError(f"`{name}` is {value}; it must be at least 1.")
    names = find_photos(images)
    if not names:
        raise InputError(
            f"There are no photos in {images} ({' '.join(sorted(PHOTO_SUFFIXES))}); mend `images`."
        )
    return names


def check_folder(images: Path, there: Collection[str], known: Sequence[str]) -> None:
    """Make sure that a database's photos are relative to this folder.

    Args:
        there: photos in the folder.
        known: the database's.

    Raises:
        InputError: none of them is there: others would be imported beside them, or they twice.
    """
    if known and set(known).isdisjoint(there):
        raise InputError(
            f"{images} holds none of the database's photos (first: {known[0]}), and image names "
            "are relative to one folder: copy the new photos beside the old ones and name that "
            "folder."
        )


def _with_names(names: Sequence[str]) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the names that a database can hold; (name, reason) of the others."""
    held, others = [], []
    for name in names:
        shown = name.encode("utf-8", "replace").decode()
        if shown == name:
            held.append(name)
        else:
            others.append((shown, "has a name that is not UTF-8; rename it"))
    return held, others


def _imported(database: Path) -> tuple[list[ImageRow], set[str], list[str]]:
    """Images of the database, and the names of those with keypoints and descriptors, and of those
    with other descriptors than SIFT."""
    if not database.exists():
        return [], set(), []
    with open_database(database) as colmap:
        rows = colmap.images()
        done, others = colmap.images_with_features(), colmap.not_sift()
    return (
        rows,
        {row.name for row in rows if row.image_id in done},
        [row.name for row in rows if row.image_id in others],
    )


def _read_headers(
    images: Path, names: Sequence[str]
) -> tuple[dict[str, PhotoHeader], list[tuple[str, str]]]:
    def read(name: str) -> PhotoHeader | BadPhoto:
        try:
            return read_header(images / name)
        except BadPhoto as fault:
            return fault

    headers: dict[str, PhotoHeader] = {}
    bad: list[tuple[str, str]] = []
    pool = ThreadPoolExecutor(usable_processors())
    try:
        with progress.step("Checking photos", len(names)) as bar:
            for name, header in zip(names, pool.map(read, names), strict=True):
                if isinstance(header, BadPhoto):
                    bad.append((name, str(header)))
                else:
                    headers[name] = header
                bar.advance()
    finally:
        pool.shutdown(cancel_futures=True)
    return headers, bad


def _without_mask(headers: dict[str, PhotoHeader], masks: Path) -> list[tuple[str, str]]:
    """Take the photos out that have no mask; COLMAP would pass over them without a word."""
    missing = without_mask(masks, headers)
    for name in missing:
        del headers[name]
    return list(missing.items())


def _group(
    images: Path,
    headers: dict[str, PhotoHeader],
    rows: Sequence[ImageRow],
    options: FeatureOptions,
) -> list[_Group]:
    """Sort the new photos by camera; photos of a camera the database has join it."""
    known = {row.name for row in rows}
    imported = [name for name in headers if name in known]
    new = {name: header for name, header in headers.items() if name not in known}
    # Images without features have their camera already.
    groups = [_Group(pycolmap.CameraMode.AUTO, None, imported)] if imported else []
    if options.camera == "per-image":
        return [*groups, _Group(pycolmap.CameraMode.PER_IMAGE, None, list(new))] if new else groups
    by_key: dict[CameraKey, list[str]] = defaultdict(list)
    for name, header in new.items():
        by_key[CAMERA_MODES[options.camera](name, header)].append(name)
    cameras = _known_cameras(images, rows, options.camera) if new else {}
    for key, names in by_key.items():
        row = cameras.get(key)
        sizes = {(headers[name].width, headers[name].height): name for name in reversed(names)}
        if row is not None:
            sizes.setdefault((row.width, row.height), row.name)
        if len(sizes) > 1:
            (first, a), (second, b) = list(sizes.items())[:2]
            raise InputError(
                f"Photos of one camera must have one size, but {a} has {first[0]} x {first[1]} "
                f"pixels and {b} {second[0]} x {second[1]}; use `camera` auto."
            )
        camera_id = row.camera_id if row is not None else None
        groups.append(_Group(pycolmap.CameraMode.SINGLE, camera_id, names))
    return groups


def _known_cameras(images: Path, rows: Sequence[ImageRow], mode: str) -> dict[CameraKey, ImageRow]:
    """The database's cameras by what their photos have in common; the one most used wins."""
    taken: dict[int, list[ImageRow]] = defaultdict(list)
    for row in rows:
        taken[row.camera_id].append(row)
    cameras: dict[CameraKey, ImageRow] = {}
    for of_camera in sorted(taken.values(), key=len, reverse=True):
        # The first may be gone by now.
        found = ((row, _header(images, row)) for row in of_camera)
        row, header = next((one for one in found if one[1]), (of_camera[0], None))
        header = header or PhotoHeader(row.width, row.height, None)
        if (header.width, header.height) == (row.width, row.height):
            cameras.setdefault(CAMERA_MODES[mode](row.name, header), row)
    return cameras


def _header(images: Path, row: ImageRow) -> PhotoHeader | None:
    try:
        return read_header(images / row.name)
    except BadPhoto:
        return None


def _extract_group(
    images: Path, database: Path, group: _Group, options: FeatureOptions, bar: progress.Step
) -> None:
    engine.make_or_migrate(database)
    if group.mode == pycolmap.CameraMode.SINGLE and group.camera_id is None:
        group = replace(group, camera_id=_new_camera(images, database, group, options))
    parts = PartsOfImport(database, group.names)
    extracted = workers.stream(
        partial(_extract, group, options),
        group.names,
        engine.initialiser(),
        Source(database, parts.part, parts.rows, write_rows),
        Load(options.threads or 1, _scale_space(options)),
        photo_folders(images, options.masks),
        first=SHARE_PHOTOS,
    )
    with closing(extracted) as counts:
        for count in counts:
            bar.advance(count)


def _extract(
    group: _Group,
    options: FeatureOptions,
    database: Path,
    images: Path,
    masks: Path | None,
    names: Sequence[str],
) -> Iterator[int]:
    """Import photos of a group and extract their features, in chunks; yield how many each had."""
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = _threads(options)
    extraction.sift.max_num_features = options.max_features
    if options.max_image_size is not None:
        extraction.max_image_size = options.max_image_size
    size = CHUNK_PHOTOS * extraction.num_threads
    for start in range(0, len(names), size):
        chunk = names[start : start + size]
        _import(images, database, group, options, chunk)
        engine.call(
            pycolmap.extract_features,
            database.parent,
            database,
            images,
            image_names=chunk,
            camera_mode=pycolmap.CameraMode.AUTO,
            reader_options=reader,
            extraction_options=extraction,
        )
        yield len(chunk)


def _import(
    images: Path, database: Path, group: _Group, options: FeatureOptions, names: Sequence[str]
) -> None:
    """Import the photos of a chunk that the database does not have yet.

    Apart from the extraction, whose threads would number the photos in the order they finish:
    ids follow the names, and two runs make the same database.
    """
    if group.mode == pycolmap.CameraMode.AUTO:
        return
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = options.camera_model
    if group.camera_id is not None:
        reader.existing_camera_id = group.camera_id
    with engine.faults_said():
        pycolmap.import_images(database, images, group.mode, list(names), reader)
    if group.camera_id is None:
        _mend_focal_lengths(images, database, names)


def _mend_focal_lengths(images: Path, database: Path, names: Sequence[str]) -> None:
    """Scale the focal lengths of new cameras whose photos were made smaller.

    Where EXIF has no focal length on 35 mm film, COLMAP goes by the resolution of the focal plane,
    and that stays what it was when the photo was taken.
    """
    with engine.opened(database) as colmap:
        for name in names:
            focal = plane_focal(images / name)
            image = colmap.read_image_with_name(name) if focal else None
            if focal is None or image is None:
                continue
            camera = colmap.read_camera(image.camera_id)
            if abs(camera.mean_focal_length() / focal.taken - 1) < SAME_FOCAL:
                for index in camera.focal_length_idxs():
                    camera.params[index] *= focal.stored / focal.taken
                colmap.update_camera(camera)


def _new_camera(images: Path, database: Path, group: _Group, options: FeatureOptions) -> int | None:
    """Import the first photo of a new camera, and return the camera's id."""
    for name in group.names:
        _import(images, database, group, options, [name])
        with open_database(database) as colmap:
            camera = next((row.camera_id for row in colmap.images() if row.name == name), None)
        if camera is not None:
            return camera
    return None


def _threads(options: FeatureOptions) -> int:
    """As many threads as processors, unless SIFT's scale space would fill half the memory."""
    if options.threads is not None:
        return options.threads
    return max(1, min(usable_processors(), int(usable_memory() / 2 / _scale_space(options))))


def _scale_space(options: FeatureOptions) -> float:
    """Bytes that SIFT takes for a photo."""
    side = options.max_image_size or SIFT_LONG_SIDE
    return SIFT_LEVELS * 4 * (2 * side) * (2 * side) * 3 / 4


def _report(
    database: Path,
    names: Sequence[str],
    todo: Sequence[str],
    bad: list[tuple[str, str]],
    unnamed: list[tuple[str, str]],
) -> FeatureReport:
    with open_database(database) as colmap:
        ids = {row.name: row.image_id for row in colmap.images()}
        cameras = len({row.camera_id for row in colmap.images()})
        done = colmap.images_with_features()
        counts = colmap.keypoint_counts()
    known_bad = {name for name, _ in bad}
    failed = [n for n in todo if n not in known_bad and ids.get(n) not in done]
    empty = [n for n in todo if ids.get(n) in done and not counts.get(ids[n])]
    bad = [
        *bad,
        *((name, "was refused by COLMAP (run with -v to see why)") for name in failed),
        *((name, "has no features (blurred, or without texture)") for name in empty),
    ]
    extracted = [name for name in todo if counts.get(ids.get(name, -1))]
    return FeatureReport(
        photos=len(names) + len(unnamed),
        already=len(names) - len(todo),
        extracted=len(extracted),
        features=sum(counts[ids[name]] for name in extracted),
        cameras=cameras,
        bad=sorted([*bad, *unnamed]),
    )
