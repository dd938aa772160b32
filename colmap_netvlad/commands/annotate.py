"""From folders of photos to annotated scenes, by structure from motion (section 2.2)."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.colmap.database import ImageRow, open_database
from colmap_netvlad.photos.files import (
    PHOTO_SUFFIXES,
    BadPhoto,
    find_photos,
    photo_fingerprint,
    read_header,
)
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training.scenes import (
    ANNOTATION,
    Observations,
    Scene,
    check_disjoint,
    common_points,
    load_annotation,
    save_annotation,
    symmetric,
)
from colmap_netvlad.training.tracks import tracks

logger = logging.getLogger(__name__)

if TYPE_CHECKING:
    import pycolmap

NO_MAPPER = "none"

MIN_REGISTERED = 3
"""A scene with fewer registered images did not reconstruct."""


@dataclass(frozen=True)
class SceneFolder:
    """A scene before annotation: its name, its photo folder, its own folder."""

    name: str
    images: Path
    folder: Path


@dataclass(frozen=True)
class AnnotateOptions:
    """How scenes are annotated.

    Attributes:
        method: retrieval method that chooses the pairs to match; the paper's is "bow".
        retrieval: k and what else the method takes.
        output: where annotations and working files go, one folder a scene; default: beside
            each scene's photos.
        databases: folder of matched COLMAP databases, `<scene>.db`; a scene found there is
            neither extracted nor matched again (its database is copied, never opened itself).
        mapper: name of the mapping method, or `NO_MAPPER`: tracks of verified matches stand for
            3D points. That is fast and lacks poses and the filter of a reconstruction.
    """

    method: str = "bow"
    retrieval: RetrievalOptions = RetrievalOptions()
    output: Path | None = None
    databases: Path | None = None
    mapper: str = "incremental"


@dataclass
class AnnotateReport:
    """The annotated scenes, in order, and sentences on those left out."""

    scenes: list[Scene] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def find_scenes(datasets: Sequence[Path]) -> list[SceneFolder]:
    """List the scenes of datasets.

    A dataset is a folder of scenes (`<dataset>/<scene>/images`, or photos right in
    `<dataset>/<scene>`), or one scene.

    Raises:
        InputError: a folder does not exist or holds no photos, or two scenes share a name.
    """
    found: list[SceneFolder] = []
    for dataset in datasets:
        if not dataset.is_dir():
            raise InputError(f"The dataset folder {dataset} does not exist.")
        here = _scene_in(dataset)
        below = [_scene_in(folder) for folder in sorted(dataset.iterdir()) if folder.is_dir()]
        scenes = [here] if here else [scene for scene in below if scene]
        if not scenes:
            raise InputError(
                f"{dataset} holds no scenes: no folder in it has photos "
                f"(<scene>/images/*.jpg, or photos right in <scene>)."
            )
        found += scenes
    names = [scene.name for scene in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"Two scenes are named {twice[0]}; rename one of their folders.")
    return found


def annotate(datasets: Sequence[Path], options: AnnotateOptions) -> AnnotateReport:
    """Annotate all scenes of datasets that are not annotated yet.

    A scene that does not reconstruct, or whose photos are in an earlier scene as well, is
    reported and skipped. A killed run goes on with the scene it was at, with the pairs already
    matched.

    Raises:
        InputError: no scenes, or a fault that concerns them all (an unknown method, say, or no
            folder of databases).
    """
    from colmap_netvlad.mapping import MAPPERS
    from colmap_netvlad.retrieval.methods import find_method

    report = AnnotateReport()
    find_method(options.method)
    if options.mapper not in (*MAPPERS, NO_MAPPER):
        known = ", ".join((*MAPPERS, NO_MAPPER))
        raise InputError(f"No mapper is called {options.mapper!r}: there are {known}.")
    if options.databases is not None and not options.databases.is_dir():
        raise InputError(f"The folder of matched databases {options.databases} does not exist.")
    for folder in find_scenes(datasets):
        logger.info("Scene %s", folder.name)
        try:
            scene = annotate_scene(folder, options)
            check_disjoint([*report.scenes, scene])
            report.scenes.append(scene)
        except InputError as fault:
            report.left_out.append(f"Scene {folder.name} is left out: {fault.message}")
    return report


def annotate_scene(folder: SceneFolder, options: AnnotateOptions) -> Scene:
    """Return a scene's annotation, making and saving it where it is not there yet.

    Raises:
        InputError: the scene does not reconstruct, an annotation of another version is there,
            or the annotation cannot be written.
    """
    target = (options.output / folder.name) if options.output else folder.folder
    path = target / ANNOTATION
    photos = find_photos(folder.images)
    if path.exists():
        scene = load_annotation(path)
        if scene.images.resolve() != folder.images.resolve():
            raise InputError(
                f"{path} is the annotation of other photos ({scene.images}); give another `output`."
            )
        if _is_current(scene, photos):
            return scene
    work = target if options.output else target / "annotation"
    work.mkdir(parents=True, exist_ok=True)
    database = work / "database.db"
    method = _matched_database(folder, database, options)
    if options.mapper == NO_MAPPER:
        seen, points = tracks(database)
        observed = np.diff(seen.first) > 0
        model_of = np.where(observed, 0, -1).astype(np.int32)
        poses = np.full((len(observed), 7), np.nan)
    else:
        shutil.rmtree(work / "sparse", ignore_errors=True)  # ours, of a run that was killed
        models = _map(database, folder.images, work / "sparse", options)
        seen, points, model_of, poses = _of_models(models, database)
    scene = _scene(folder, database, method, seen, points, model_of, poses)
    save_annotation(scene, path)
    return scene


def table_lines(scenes: Sequence[Scene]) -> list[str]:
    """Return the table of scenes, like the paper's table 1."""
    if not scenes:
        return []
    width = max(len("scene"), *(len(scene.name) for scene in scenes))
    head = f"{'scene':{width}}  images  registered   points    pairs  overlap  matched by"
    lines = [head]
    for scene in scenes:
        lines.append(
            f"{scene.name:{width}}  {len(scene):6,}  {scene.registered:10,}  {scene.points:7,}  "
            f"{scene.pairs:7,}  {scene.overlap:7.1f}  {scene.method}"
        )
    if len(scenes) > 1:
        images, registered = (
            sum(count) for count in zip(*((len(s), s.registered) for s in scenes), strict=True)
        )
        points, pairs = sum(s.points for s in scenes), sum(s.pairs for s in scenes)
        lines.append(
            f"{'all':{width}}  {images:6,}  {registered:10,}  {points:7,}  {pairs:7,}  "
            f"{2 * pairs / max(registered, 1):7.1f}"
        )
    return lines


def _is_current(scene: Scene, photos: Sequence[str]) -> bool:
    """Whether an annotation has all photos of its folder but broken ones."""
    new = set(photos) - set(scene.names)
    return set(scene.names) <= set(photos) and not any(_is_whole(scene.images / n) for n in new)


def _is_whole(path: Path) -> bool:
    try:
        read_header(path)
    except BadPhoto:
        return False
    return True


def _scene(
    folder: SceneFolder,
    database: Path,
    method: str,
    seen: Observations,
    points: int,
    model_of: NDArray[np.int32],
    poses: NDArray[np.float64],
) -> Scene:
    """Build the annotation of a scene.

    Raises:
        InputError: fewer than `MIN_REGISTERED` images are registered.
    """
    with open_database(database) as opened:
        rows = opened.images()
        verified = opened.verified_matches()
    registered = int((model_of >= 0).sum())
    if registered < MIN_REGISTERED:
        raise InputError(
            f"it does not reconstruct ({registered} of {len(rows)} photos registered); "
            "its photos overlap too little, or are of different places."
        )
    index = {row.image_id: number for number, row in enumerate(rows)}
    complete = len(verified) == len(rows) * (len(rows) - 1) // 2
    matches = [(index[a], index[b], n) for (a, b), n in verified.items() if n]
    return Scene(
        name=folder.name,
        images=folder.images,
        names=tuple(row.name for row in rows),
        common_points=common_points(seen, points),
        matches=symmetric(matches, len(rows)),
        sizes=_sizes(rows),
        model=model_of,
        poses=poses,
        points=points,
        method="exhaustive" if complete else method,
        fingerprints=tuple(_fingerprint(folder.images / row.name) for row in rows),
        observations=seen,
    )


def _sizes(rows: Sequence[ImageRow]) -> NDArray[np.int32]:
    return np.array([(row.width, row.height) for row in rows], np.int32).reshape(-1, 2)


def _of_models(
    models: Sequence[pycolmap.Reconstruction], database: Path
) -> tuple[Observations, int, NDArray[np.int32], NDArray[np.float64]]:
    """Return observations, number of points, models and poses of a scene's images.

    An image that is in several models counts in the one with most of its points; images of
    different models have no common points.
    """
    with open_database(database) as opened:
        rows = opened.images()
    names = [row.name for row in rows]
    model_of = _models_of(models, names)
    seen, points = _observations(models, model_of, names, _sizes(rows))
    return seen, points, model_of, _poses(models, model_of, names)


def _fingerprint(path: Path) -> str:
    try:
        return photo_fingerprint(path)
    except BadPhoto as fault:
        raise InputError(f"the photo {path} of its database {fault}.") from fault


def _scene_in(folder: Path) -> SceneFolder | None:
    for images in (folder / "images", folder):
        if images.is_dir() and any(_is_photo(path) for path in images.iterdir()):
            return SceneFolder(folder.resolve().name, images, folder)
    return None


def _is_photo(path: Path) -> bool:
    return path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")


def _matched_database(folder: SceneFolder, database: Path, options: AnnotateOptions) -> str:
    """Make the scene's matched database where it is not there; return how pairs were chosen."""
    given = options.databases / f"{folder.name}.db" if options.databases else None
    if given is not None and given.is_file():
        copy_database(given, database, matches=True)
        return "given"
    from colmap_netvlad.colmap.features import extract_features
    from colmap_netvlad.matching.options import MatchOptions
    from colmap_netvlad.matching.run import match_pairs
    from colmap_netvlad.pairs.union import union_of_top
    from colmap_netvlad.project import Project
    from colmap_netvlad.retrieval.rank import rank_project

    extract_features(folder.images, database)
    ranking = rank_project(Project(database, folder.images), options.method, options.retrieval)
    pairs = union_of_top(ranking, options.retrieval.k)
    # What is learnt from is COLMAP's, whatever matches by default.
    colmap = MatchOptions(matcher="colmap")
    match_pairs(database, [(pair.name1, pair.name2) for pair in pairs], colmap)
    return ranking.method


def _map(
    database: Path, images: Path, output: Path, options: AnnotateOptions
) -> list[pycolmap.Reconstruction]:
    from colmap_netvlad.mapping import MAPPERS
    from colmap_netvlad.mapping.options import MappingOptions

    return MAPPERS[options.mapper](
        database, images, output, MappingOptions(seed=options.retrieval.seed)
    )


def _images_of(model: pycolmap.Reconstruction, row_of: dict[str, int]) -> dict[int, int]:
    """Return the rows of a model's registered images by image id."""
    return {
        image_id: row_of[image.name]
        for image_id, image in model.images.items()
        if image.has_pose and image.name in row_of
    }


def _models_of(
    models: Sequence[pycolmap.Reconstruction], names: Sequence[str]
) -> NDArray[np.int32]:
    """Return (N,) the model of each image: the one with most of its points, or -1."""
    row_of = {name: row for row, name in enumerate(names)}
    model_of = np.full(len(names), -1, np.int32)
    most = np.zeros(len(names), int)
    for number, model in enumerate(models):
        for image_id, row in _images_of(model, row_of).items():
            count = model.images[image_id].num_points3D
            if count > most[row]:
                model_of[row], most[row] = number, count
    return model_of


def _observations(
    models: Sequence[pycolmap.Reconstruction],
    model_of: NDArray[np.int32],
    names: Sequence[str],
    sizes: NDArray[np.int32],
) -> tuple[Observations, int]:
    """Return what each image observes of its own model's points, and the number of points."""
    row_of = {name: row for row, name in enumerate(names)}
    points: list[NDArray[np.int64]] = [np.zeros(0, np.int64)] * len(names)
    at: list[NDArray[np.float64]] = [np.zeros((0, 2))] * len(names)
    total = 0
    for number, model in enumerate(models):
        ids = np.sort(np.fromiter(model.points3D.keys(), np.uint64, model.num_points3D()))
        for image_id, row in _images_of(model, row_of).items():
            if model_of[row] != number:
                continue
            found = [
                (p.point3D_id, *p.xy) for p in model.images[image_id].get_observation_points2D()
            ]
            table = np.array(found, np.float64).reshape(-1, 3)
            number_of = total + np.searchsorted(ids, table[:, 0].astype(np.uint64))
            # A point may be observed twice in one photo; it counts once.
            points[row], kept = np.unique(number_of, return_index=True)
            at[row] = (table[kept, 1:] - sizes[row] / 2) / sizes[row].max()
        total += len(ids)
    first = np.cumsum([0, *map(len, points)])
    every = np.concatenate(points).astype(np.int32)
    return Observations(first, every, np.concatenate(at).astype(np.float32)), total


def _poses(
    models: Sequence[pycolmap.Reconstruction], model_of: NDArray[np.int32], names: Sequence[str]
) -> NDArray[np.float64]:
    """Return (N, 7) qw qx qy qz tx ty tz, NaN where not registered."""
    row_of = {name: row for row, name in enumerate(names)}
    poses = np.full((len(names), 7), np.nan)
    for number, model in enumerate(models):
        for image_id, row in _images_of(model, row_of).items():
            if model_of[row] == number:
                pose = model.images[image_id].cam_from_world()
                x, y, z, w = pose.rotation.quat
                poses[row] = [w, x, y, z, *pose.translation]
    return poses
