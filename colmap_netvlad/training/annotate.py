"""From folders of photos to annotated scenes, by structure from motion (section 2.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.database import copy_database, open_database
from colmap_netvlad.errors import InputError
from colmap_netvlad.images import PHOTO_SUFFIXES, find_photos, photo_fingerprint
from colmap_netvlad.training.scenes import (
    ANNOTATION,
    Scene,
    check_disjoint,
    load_annotation,
    save_annotation,
    symmetric,
)

if TYPE_CHECKING:
    import pycolmap

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
        k: partners retrieved for each image.
        output: where annotations and working files go, one folder a scene; default: beside
            each scene's photos.
        databases: folder of matched COLMAP databases, `<scene>.db`; a scene found there is
            neither extracted nor matched again (its database is copied, never opened itself).
        mapper: name of the mapping method.
        seed: of retrieval and mapping.
    """

    method: str = "bow"
    k: int = 30
    output: Path | None = None
    databases: Path | None = None
    mapper: str = "incremental"
    seed: int = 0


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


def annotate(
    datasets: Sequence[Path],
    options: AnnotateOptions,
    announce: Callable[[str], None] = lambda name: None,
) -> AnnotateReport:
    """Annotate all scenes of datasets that are not annotated yet.

    A scene that does not reconstruct, or whose photos are in an earlier scene as well, is
    reported and skipped. A killed run goes on with the scene it was at, with the pairs already
    matched.

    Args:
        announce: called with the name of each scene before it is worked on.

    Raises:
        InputError: no scenes, or a fault that concerns them all (an unknown method, say).
    """
    report = AnnotateReport()
    for folder in find_scenes(datasets):
        try:
            announce(folder.name)
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
        if set(scene.names) == set(photos):
            return scene
    work = target if options.output else target / "annotation"
    work.mkdir(parents=True, exist_ok=True)
    database = work / "database.db"
    method = _matched_database(folder, database, options)
    models = _map(database, folder.images, work / "sparse", options)
    scene = scene_of(folder, database, models, method)
    save_annotation(scene, path)
    return scene


def scene_of(
    folder: SceneFolder, database: Path, models: Sequence[pycolmap.Reconstruction], method: str
) -> Scene:
    """Build the annotation of a scene from its matched database and reconstructed models.

    An image that is in several models counts in the one with most of its points; images of
    different models have no common points.

    Raises:
        InputError: fewer than `MIN_REGISTERED` images are registered.
    """
    with open_database(database) as opened:
        rows = opened.images()
        verified = opened.verified_matches()
    index = {row.image_id: number for number, row in enumerate(rows)}
    names = tuple(row.name for row in rows)
    observed = [_observations(model, names) for model in models]
    counts = np.stack(
        [np.zeros(len(names)), *(np.asarray(o.sum(axis=1)).ravel() for o in observed)]
    )
    model_of = np.where(counts.any(0), counts[1:].argmax(0) if models else -1, -1)
    registered = int((model_of >= 0).sum())
    if registered < MIN_REGISTERED:
        raise InputError(
            f"it does not reconstruct ({registered} of {len(names)} photos registered); "
            "its photos overlap too little, or are of different places."
        )
    poses = np.full((len(names), 7), np.nan)
    common = sparse.csr_array((len(names), len(names)), dtype=np.int32)
    for number, (model, seen) in enumerate(zip(models, observed, strict=True)):
        own = model_of == number
        _fill_poses(poses, model, names, own)
        inside = sparse.diags_array(own.astype(np.int32)) @ seen
        common = common + inside @ inside.T
    common = sparse.csr_array(common - sparse.diags_array(common.diagonal()))
    common.eliminate_zeros()
    complete = len(verified) == len(names) * (len(names) - 1) // 2
    return Scene(
        name=folder.name,
        images=folder.images,
        names=names,
        common_points=common.astype(np.int32),
        matches=symmetric([(index[a], index[b], n) for (a, b), n in verified.items()], len(names)),
        model=model_of.astype(np.int32),
        poses=poses,
        points=sum(model.num_points3D() for model in models),
        method="exhaustive" if complete else method,
        fingerprints=tuple(photo_fingerprint(folder.images / name) for name in names),
    )


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
    from colmap_netvlad.features import extract_features
    from colmap_netvlad.matching import match_pairs
    from colmap_netvlad.pairs import check_k, union_of_top
    from colmap_netvlad.project import Project
    from colmap_netvlad.retrieval.methods import RetrievalOptions, rank

    extract_features(folder.images, database)
    with open_database(database) as opened:
        k = check_k(options.k, len(opened.images()))
    project = Project(database, folder.images)
    ranking = rank(project, options.method, RetrievalOptions(k=k, seed=options.seed))
    match_pairs(database, [(pair.name1, pair.name2) for pair in union_of_top(ranking, k)])
    return options.method


def _map(
    database: Path, images: Path, output: Path, options: AnnotateOptions
) -> list[pycolmap.Reconstruction]:
    from colmap_netvlad.mapping import MAPPERS
    from colmap_netvlad.mapping.incremental import MappingOptions

    return MAPPERS[options.mapper](database, images, output, MappingOptions(seed=options.seed))


def _observations(model: pycolmap.Reconstruction, names: Sequence[str]) -> sparse.csr_array:
    """Return (N, P) sparse, 1 where an image observes a 3D point of the model."""
    row_of = {name: row for row, name in enumerate(names)}
    row_of_id = {
        image_id: row_of[image.name]
        for image_id, image in model.images.items()
        if image.has_pose and image.name in row_of
    }
    rows: list[int] = []
    columns: list[int] = []
    for column, point in enumerate(model.points3D.values()):
        images = {element.image_id for element in point.track.elements} & row_of_id.keys()
        rows += [row_of_id[image] for image in images]
        columns += [column] * len(images)
    shape = (len(names), max(model.num_points3D(), 1))
    ones = np.ones(len(rows), np.int32)
    return sparse.coo_array((ones, (rows, columns)), shape=shape).tocsr()


def _fill_poses(
    poses: NDArray[np.float64],
    model: pycolmap.Reconstruction,
    names: Sequence[str],
    own: NDArray[np.bool_],
) -> None:
    row_of = {name: row for row, name in enumerate(names)}
    for image in model.images.values():
        row = row_of.get(image.name)
        if row is None or not own[row] or not image.has_pose:
            continue
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat
        poses[row] = [w, x, y, z, *pose.translation]
