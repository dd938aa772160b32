"""Models into the world: what `georegister` does, and `reconstruct` after mapping."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from colmap_netvlad.geo.align import ERROR_LADDER, Alignment, NotAligned, align, as_it_lies
from colmap_netvlad.geo.frames import frame_of
from colmap_netvlad.geo.gcp import (
    ControlList,
    adjust_to_control,
    align_to_control,
    measure_control,
    read_control,
)
from colmap_netvlad.geo.georeference import Georeference, read_place, transformed
from colmap_netvlad.geo.places import Places, find_places
from colmap_netvlad.graph.verified import with_matches
from colmap_netvlad.mapping.merge import Refused, read_sub_model, shared_points, similarity
from colmap_netvlad.mapping.output import free_output, model_folder, named, numbered
from colmap_netvlad.mapping.summary import of_database, put_aside
from colmap_netvlad.project import DATABASE_NAMES
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import temporary_prefix


@dataclass(frozen=True)
class ControlFile:
    """A list of ground points to be read.

    Attributes:
        path: the list, in OpenDroneMap's format.
        check: names of check points.
    """

    path: Path
    check: tuple[str, ...] = ()

    def read(self, photos: Sequence[str]) -> ControlList:
        """Read it for a project's photos (see `geo.gcp.read_control`)."""
        return read_control(self.path, photos, self.check)


@dataclass(frozen=True)
class WorldOptions:
    """How models that have just been mapped are brought into the world.

    Attributes:
        georegister: auto (where positions are known), off, require.
        use_gps: adjust with the positions as priors.
        gps_std: standard deviation of positions, m horizontal and vertical, for all photos; None:
            what each photo states, else `geo.places.DEFAULT_DEVIATIONS`.
        gcp: ground points, which place the models and are held in a last adjustment.
    """

    georegister: Literal["auto", "off", "require"] = "auto"
    use_gps: bool = False
    gps_std: tuple[float, float] | None = None
    gcp: ControlFile | None = None


MODEL_FILES = ("images.bin", "images.txt")
"""Either says that a folder is a COLMAP model."""


@dataclass(frozen=True)
class Placed:
    """What became of one model.

    Attributes:
        name: of its folder.
        georeference: where it is now; None where it could not be placed.
        fault: why not, a sentence.
    """

    name: str
    georeference: Georeference | None
    fault: str = ""

    def lines(self) -> list[str]:
        """Return the sentences for a user."""
        if self.georeference is None:
            return [f"Not georegistered: {self.fault}"]
        return self.georeference.lines()


@dataclass(frozen=True)
class GeoregisterReport:
    """What `georegister` did.

    Attributes:
        output: folder of the models.
        models: what became of each.
        notes: what was put aside among the positions.
    """

    output: Path
    models: list[Placed]
    notes: tuple[str, ...]


def georegister(
    sparse: Path,
    output: Path | None = None,
    database: Path | None = None,
    images: Path | None = None,
    gcp: ControlFile | None = None,
    seed: int = 0,
) -> GeoregisterReport:
    """Bring models into the world and write them, with `georeference.json`, to a new folder.

    Args:
        sparse: a COLMAP model, or a folder of models 0, 1, ...; left as it is.
        output: where they go, laid out as they were; default: `<sparse>-georegistered`.
        database: for position priors; None: EXIF alone.
        images: photo folder, for EXIF GPS.
        gcp: ground points, which place the model instead of its positions.
        seed: of RANSAC.

    Raises:
        InputError: no model, no positions, or not one model could be placed.
    """
    sparse = named(sparse)
    folders = find_models(sparse)
    models = [read_model(folder) for folder in folders]
    names = sorted({name for model in models for name in _poses(model)[0]})
    control = None if gcp is None else gcp.read(names)
    places = places_for(find_places(names, database, images), control)
    if not places.known and control is None:
        asked = " and ".join(str(path) for path in (database, images) if path is not None)
        raise InputError(
            f"No position is known of any of the {len(names)} photos "
            + (
                f"(looked in {asked})"
                if asked
                else "(name the photos' folder as `images`, or a `database`)"
            )
            + ", so the model cannot be georegistered."
            + "".join(f" {note}" for note in places.notes)
        )
    output = output or free_output(sparse.with_name(f"{sparse.name}-georegistered"))
    placed = []
    with model_folder(output) as temporary:
        for folder, model in zip(folders, models, strict=True):
            target = temporary if folder == sparse else temporary / folder.name
            target.mkdir(exist_ok=True)
            placed.append(place_model(folder.name, model, places, target, control, seed=seed))
        if not any(one.georeference for one in placed):
            raise InputError(f"No model of {sparse} could be georegistered: {placed[0].fault}")
        for one in placed:
            if one.georeference is None:
                (temporary / one.name).rmdir()
    return GeoregisterReport(output, placed, places.notes)


def report_lines(report: GeoregisterReport) -> list[str]:
    """Return what `colmap-netvlad georegister` prints."""
    lines = [f"{placed.name}: {line}" for placed in report.models for line in placed.lines()]
    return [*lines, *report.notes, f"Written to {report.output}."]


def georegister_in_place(
    folder: Path,
    places: Places,
    control: ControlList | None = None,
    *,
    adjusted: bool = False,
    gps_std: tuple[float, float] | None = None,
    seed: int = 0,
) -> list[Placed]:
    """Bring the models that a mapper has just written into the world, where they are.

    Args:
        folder: of models 0, 1, ...
        places: known positions.
        control: ground points, which place the models instead.
        adjusted: the mapper had these positions as priors, so the models are in their frame.
        gps_std: what it was told of all of them, m horizontal and vertical, if it was.
        seed: of RANSAC.
    """
    placed = []
    for path in find_models(folder):
        draft = Path(tempfile.mkdtemp(prefix=temporary_prefix(path), dir=folder))
        try:
            one = place_model(
                path.name,
                read_model(path),
                places,
                draft,
                control,
                adjusted=adjusted,
                gps_std=gps_std,
                seed=seed,
            )
            if one.georeference is not None:
                for file in sorted(draft.iterdir()):
                    file.replace(path / file.name)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        placed.append(one)
    return placed


def keep_place(
    before: Path, after: Path, database: Path, images: Path | None, *, adjusted: bool
) -> Placed:
    """Bring a model that was made by enlarging another to where that one is, in place.

    The frame is the old one, and its origin too. Without positions in the adjustment, the points
    that both have stay where they were: more photos may change the focal length, and with it the
    photos' height over them.

    Args:
        before: folder of the model that was enlarged; it is in the world.
        after: folder of the larger one, over images of the same database.
        database: for position priors.
        images: photo folder, for EXIF GPS.
        adjusted: the larger one was adjusted with positions in the old frame, and so is in it.
    """
    place = read_place(before)
    assert place is not None
    model = read_model(after)
    moved = pycolmap.Sim3d()
    if not adjusted:
        old, new = (
            read_sub_model(name, read_model(Path(name))) for name in (str(before), str(after))
        )
        try:
            moved = similarity(old, new, shared_points(old, new))
        except Refused as refusal:
            return Placed(
                after.name, None, f"it does not lie as the model it grew from: {refusal}."
            )
    model.transform(moved)
    names, centres, _ = _poses(model)
    places = find_places(names, database, images, place.frame)
    stayed = "by their positions, in the same frame" if adjusted else "and the old ground stayed"
    notes = [f"Photos were added, {stayed}."]
    if place.control:
        notes.append(
            "Ground points placed it before; `colmap-netvlad georegister` with `gcp` measures them "
            "again."
        )
    lying = as_it_lies(names, centres, places.of(names))
    alignment = replace(lying, world_from_model=moved, notes=tuple(notes))
    georeference = Georeference(place.frame, alignment, adjusted, place.gps_std)
    with tempfile.TemporaryDirectory(prefix=temporary_prefix(after), dir=after.parent) as temporary:
        model.write(temporary)
        georeference.write(Path(temporary))
        for file in sorted(Path(temporary).iterdir()):
            file.replace(after / file.name)
    return Placed(after.name, georeference)


def place_model(
    name: str,
    model: pycolmap.Reconstruction,
    places: Places,
    target: Path,
    control: ControlList | None = None,
    *,
    adjusted: bool = False,
    gps_std: tuple[float, float] | None = None,
    seed: int = 0,
) -> Placed:
    """Align one model and write it to `target`; a model that cannot be placed is not written."""
    names, centres, rotations = _poses(model)
    known = places.of(names)
    if control is not None and places.frame is not None:
        return _place_by_control(name, model, places, target, control)
    try:
        alignment = align(names, centres, rotations, known, seed)
    except NotAligned as fault:
        return Placed(name, None, fault.message)
    if adjusted:
        lying = as_it_lies(names, centres, known)
        # Adjusted with the positions it needs no moving, unless they leave its turn open.
        if _lies_well(lying) and not alignment.notes:
            alignment = lying
    transformed(model, alignment).write(target)
    georeference = Georeference(places.frame, alignment, adjusted, gps_std)
    georeference.write(target)
    return Placed(name, georeference)


def database_beside(sparse: Path, given: Path | None) -> tuple[Path | None, list[str]]:
    """Return the database as given, else one that lies beside the models; and what to say of it.

    Another flight's photos may have the same names: a database whose photos have not as many
    keypoints as the model's is put aside.

    Raises:
        InputError: no model, or it or the database that was found cannot be read.
    """
    near = (folder / name for folder in _holders(sparse) for name in DATABASE_NAMES)
    found = None if given else next((path for path in near if path.is_file()), None)
    if found is None:
        return given, []
    if not of_database(read_model(find_models(sparse)[0]), found):
        return None, [put_aside(found)]
    found = with_matches(found)
    return found, [f"Database, found beside the model: {found}."]


def images_beside(sparse: Path, given: Path | None) -> tuple[Path | None, list[str]]:
    """Return the photo folder as given, else `images` beside the models; and what to say of it."""
    near = (folder / "images" for folder in _holders(sparse))
    found = None if given else next((path for path in near if path.is_dir()), None)
    return (given, []) if found is None else (found, [f"Photos, found beside the model: {found}."])


def _holders(sparse: Path) -> list[Path]:
    """Return the folders that hold a model, or a folder of models, the nearest first.

    Of a model among others the folder of these counts, and the one that holds that. None farther
    up does: it may be that of several flights.
    """
    sparse = sparse.resolve()
    among = _is_model(sparse) and any(_is_model(path) for path in numbered(sparse.parent))
    return list(sparse.parents[: 2 if among else 1])


def _place_by_control(
    name: str,
    model: pycolmap.Reconstruction,
    places: Places,
    target: Path,
    control: ControlList,
) -> Placed:
    """Align one model to its control points, adjust it with them, and write it to `target`."""
    frame = places.frame
    assert frame is not None
    try:
        similarity = align_to_control(model, control, frame)
    except NotAligned as fault:
        return Placed(name, None, " ".join([fault.message, *control.notes]))
    model = pycolmap.Reconstruction(model)
    model.transform(similarity)
    adjust_to_control(model, control, frame)
    names, centres, _ = _poses(model)
    alignment = replace(as_it_lies(names, centres, places.of(names)), world_from_model=similarity)
    model.write(target)
    georeference = Georeference(frame, alignment, control=measure_control(model, control, frame))
    georeference.write(target)
    return Placed(name, georeference)


def places_for(places: Places, control: ControlList | None) -> Places:
    """Return places in a frame on the globe where ground points need one.

    Raises:
        InputError: the positions are cartesian, so that ground points have no place among them.
    """
    if control is None or places.frame is not None:
        return places
    if places.known:
        raise InputError(
            "The database's position priors are cartesian, and ground points are on the globe; "
            "the two do not go together."
        )
    return replace(places, frame=frame_of(control.geographic()))


def find_models(sparse: Path) -> list[Path]:
    """Return the folders of the models in a folder: itself, or 0, 1, ... in it.

    Raises:
        InputError: there is none.
    """
    if _is_model(sparse):
        return [sparse]
    if sparse.is_dir():
        found = [path for path in numbered(sparse) if _is_model(path)]
        if found:
            return found
    raise InputError(
        f"{sparse} holds no COLMAP model (cameras, images, points3D); name one as `sparse`."
    )


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model.

    Raises:
        InputError: it is damaged.
    """
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as fault:
        raise InputError(f"The model in {folder} is damaged and cannot be read.") from fault


def _is_model(folder: Path) -> bool:
    return any((folder / name).is_file() for name in MODEL_FILES)


def _lies_well(alignment: Alignment) -> bool:
    sizes = np.linalg.norm(np.nan_to_num(alignment.residuals), axis=1)
    return len(sizes) > 0 and float(np.median(sizes)) <= ERROR_LADDER[-1]


def _poses(model: pycolmap.Reconstruction) -> tuple[Sequence[str], np.ndarray, np.ndarray]:
    """Return names, (N, 3) centres and (N, 3, 3) cam_from_world of the registered images."""
    images = sorted(
        (model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name
    )
    poses = [image.cam_from_world().matrix() for image in images]
    rotations = np.array([pose[:, :3] for pose in poses]).reshape(-1, 3, 3)
    centres = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses]).reshape(-1, 3)
    return [image.name for image in images], centres, rotations
