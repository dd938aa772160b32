"""Ground control: surveyed points marked in photos, triangulated, aligned to, adjusted with.

Control points place the model; check points only tell how well it lies.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from pyproj import CRS
from scipy.optimize import least_squares

from colmap_netvlad.geo.align import MIN_PLACES, NotAligned
from colmap_netvlad.geo.frames import LocalFrame, height_unit, lacking_grids, read_crs
from colmap_netvlad.runtime.errors import InputError

Array = NDArray[np.float64]

COLUMNS = 6
"""x, y, z, px, py, photo; a name may follow."""

WRONG_PIXELS = 10.0
"""A mark farther than this from where the point's other marks put it is named, px."""

MARK_PIXELS = 1.0
"""From this error on a mark counts less in its point's triangulation, px."""

MIN_SPREAD = 1e-3
"""Control points on one line do not place a model: second over first singular value."""


@dataclass(frozen=True)
class Mark:
    """A ground point seen in a photo: pixels from the upper left corner of the photo."""

    photo: str
    x: float
    y: float


@dataclass(frozen=True)
class GroundPoint:
    """A surveyed point.

    Attributes:
        name: as listed, or its number in the list.
        place: x (east or longitude), y (north or latitude), height in the list's system and its
            units (`geo.frames.height_unit`).
        marks: where it is seen, in the order of the list.
        check: it has no say in the model's place.
    """

    name: str
    place: tuple[float, float, float]
    marks: tuple[Mark, ...]
    check: bool = False


@dataclass(frozen=True)
class ControlList:
    """A list of ground points: their system, the points, and what was put aside.

    Attributes:
        crs: system of the places.
        points: in the order of the list.
        notes: sentences.
    """

    crs: CRS
    points: tuple[GroundPoint, ...]
    notes: tuple[str, ...] = ()

    def geographic(self) -> Array:
        """Return (N, 3) latitude, longitude (degrees), height (m) of the points."""
        places = np.array([point.place for point in self.points]).reshape(-1, 3)
        anywhere = LocalFrame(0.0, 0.0)
        return anywhere.to_wgs84(anywhere.from_crs(places, self.crs))


@dataclass(frozen=True, eq=False)
class ControlReport:
    """How ground points lie in the model.

    Attributes:
        names: of the N points that could be triangulated.
        check: (N,) bool, points without a say.
        residuals: (N, 3) model minus survey, m east, north, up.
        pixels: (N,) root mean square distance of a point's marks from its place in the model, px.
        notes: sentences.
    """

    names: tuple[str, ...]
    check: NDArray[np.bool_]
    residuals: Array
    pixels: Array
    notes: tuple[str, ...]

    def rms(self, *, check: bool) -> tuple[float, float]:
        """Return the root mean square of control or check points, m horizontal and vertical."""
        chosen = self.residuals[self.check == check]
        if not len(chosen):
            return float("nan"), float("nan")
        horizontal = float(np.sqrt((chosen[:, :2] ** 2).sum(axis=1).mean()))
        return horizontal, float(np.sqrt((chosen[:, 2] ** 2).mean()))

    def lines(self) -> list[str]:
        """Return the sentences for a user."""
        lines = []
        for check, what in ((False, "control"), (True, "check")):
            count = int((self.check == check).sum())
            if count:
                horizontal, vertical = self.rms(check=check)
                lines.append(
                    f"{count} {what} point{'s' * (count > 1)}: {horizontal:.3f} m horizontally, "
                    f"{vertical:.3f} m vertically (root mean square)."
                )
        return lines + list(self.notes)


def read_control(path: Path, photos: Collection[str], check: Collection[str] = ()) -> ControlList:
    """Read OpenDroneMap's `gcp_list.txt`.

    The first line names the coordinate system; every other one is a mark: x y z px py photo and,
    if there is one, the point's name. Marks of one name, or of equal x y z, are one point. Photos
    are named as in the project, or by the file name alone where that is unique. Heights are in the
    system's unit (`geo.frames.height_unit`), which is said where it is not m.

    Args:
        path: the list.
        photos: image names of the project.
        check: names of the points that are check points.

    Raises:
        InputError: no such file, no known system, a line that is none, no photo of the project.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as fault:
        raise InputError(f"The list of ground points {path} cannot be read ({fault}).") from fault
    numbered = [
        (number, line.strip())
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.startswith("#")
    ]
    if not numbered:
        raise InputError(f"{path} is empty; its first line names the coordinate system.")
    try:
        crs = read_crs(numbered[0][1])
    except InputError as fault:
        raise InputError(f"{path}, line {numbered[0][0]}: {fault.message}") from fault
    known = _by_name(photos)
    found: dict[object, tuple[str, tuple[float, float, float], list[Mark]]] = {}
    strangers: list[str] = []
    for number, line in numbered[1:]:
        place, pixel, rest = _numbers(path, number, line)
        photo, name = _photo_and_name(rest, known)
        if photo is None:
            strangers.append(rest.split()[0])
            continue
        key: object = name or place
        listed = found.setdefault(key, (name or f"point {len(found) + 1}", place, []))
        if listed[1] != place:
            raise InputError(
                f"{path}, line {number}: the point {name} is at another place than before."
            )
        listed[2].append(Mark(photo, *pixel))
    if not found:
        raise InputError(f"{path} marks no point in any photo of the project.")
    unknown = sorted(set(check) - {name for name, _, _ in found.values()})
    if unknown:
        raise InputError(f"{path} lists no point {', '.join(unknown)}, named as check point.")
    notes = []
    unit, metres = height_unit(crs)
    if len(crs.axis_info) == 2 and metres != 1:
        notes.append(
            f"Heights in {path.name} are read in the unit of {numbered[0][1]}, {unit}; where they "
            "are in m, name a system with such heights (EPSG:2263+5703 for example)."
        )
    if strangers:
        notes.append(
            f"{len(strangers)} mark{'s' * (len(strangers) > 1)} of {path.name} "
            f"{'are' if len(strangers) > 1 else 'is'} in photos that the project does not have "
            f"(first: {strangers[0]})."
        )
    points = tuple(
        GroundPoint(name, place, tuple(marks), name in check)
        for name, place, marks in found.values()
    )
    notes += lacking_grids(crs, ControlList(crs, points).geographic())
    return ControlList(crs, points, tuple(notes))


def align_to_control(
    model: pycolmap.Reconstruction, control: ControlList, frame: LocalFrame
) -> pycolmap.Sim3d:
    """Return the similarity from the model to the frame that its control points ask for.

    Raises:
        NotAligned: fewer than three control points that are seen in two photos, or all on a line.
    """
    surveyed = _surveyed(control, frame)
    found = {}
    for i, point in enumerate(control.points):
        if not point.check:
            place = triangulate(model, point)
            if place is not None:
                found[i] = place
    source = np.array(list(found.values())).reshape(-1, 3)
    target = surveyed[list(found)].reshape(-1, 3)
    if len(found) < MIN_PLACES:
        raise NotAligned(
            f"Only {len(found)} control points are marked in two photos of the model, and a model "
            f"needs {MIN_PLACES} to be placed."
        )
    spread = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    similarity = pycolmap.estimate_sim3d(source, target)
    if spread[1] < MIN_SPREAD * spread[0] or similarity is None:
        raise NotAligned("The control points lie on one line, which leaves the turn about it open.")
    return similarity


def adjust_to_control(
    model: pycolmap.Reconstruction, control: ControlList, frame: LocalFrame
) -> None:
    """Adjust a model in the frame with its control points held where they were surveyed, in place.

    Marks count as much as the model's own observations. The model keeps its points and tracks.
    """
    copy = pycolmap.Reconstruction(model)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in copy.reg_image_ids():
        config.add_image(image_id)
    images = _registered(copy)
    lent: set[tuple[int, int]] = set()
    for point, place in zip(control.points, _surveyed(control, frame), strict=True):
        marks = [mark for mark in point.marks if mark.photo in images]
        if point.check or len({mark.photo for mark in marks}) < 2:
            continue
        track = pycolmap.Track()
        for mark in marks:
            image = images[mark.photo]
            keypoint = _lend_keypoint(copy, image, lent)
            image.points2D[keypoint].xy = np.array([mark.x, mark.y])
            track.add_element(image.image_id, keypoint)
        config.add_constant_point(copy.add_point3D(place, track, np.zeros(3, np.uint8)))
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    pycolmap.create_default_bundle_adjuster(options, config, copy).solve()
    for camera_id in model.cameras:
        model.camera(camera_id).params = copy.camera(camera_id).params.tolist()
    for rig_id in model.rigs:
        for sensor, pose in copy.rig(rig_id).non_ref_sensors.items():
            if pose is not None:
                model.rig(rig_id).set_sensor_from_rig(sensor, pose)
    for frame_id in model.reg_frame_ids():
        model.frame(frame_id).rig_from_world = copy.frame(frame_id).rig_from_world
    for point_id in model.point3D_ids():
        model.point3D(point_id).xyz = copy.point3D(point_id).xyz
    model.update_point_3d_errors()


def measure_control(
    model: pycolmap.Reconstruction, control: ControlList, frame: LocalFrame
) -> ControlReport:
    """Return how far each ground point's place in the model is from where it was surveyed."""
    names, check, residuals, pixels, notes = [], [], [], [], list(control.notes)
    for point, place in zip(control.points, _surveyed(control, frame), strict=True):
        found = triangulate(model, point)
        if found is None:
            count = len({mark.photo for mark in point.marks} & _registered(model).keys())
            notes.append(
                f"Ground point {point.name} is marked in {count or 'no'} registered "
                f"photo{'s' * (count != 1)} and needs two; it is not used."
            )
            continue
        errors = _errors(model, point, found)
        worst = max(errors, key=lambda photo: errors[photo])
        if errors[worst] > WRONG_PIXELS:
            notes.append(
                f"The mark of ground point {point.name} in {worst} is {errors[worst]:.0f} px from "
                "where its other marks put it; look at it again."
            )
        names.append(point.name)
        check.append(point.check)
        residuals.append(found - place)
        pixels.append(float(np.sqrt(np.mean(np.square(list(errors.values()))))))
    return ControlReport(
        tuple(names),
        np.array(check, bool),
        np.array(residuals).reshape(-1, 3),
        np.array(pixels),
        tuple(notes),
    )


def triangulate(model: pycolmap.Reconstruction, point: GroundPoint) -> Array | None:
    """Return (3,) where a ground point is in the model; None unless two photos see it."""
    images = _registered(model)
    marks = [mark for mark in point.marks if mark.photo in images]
    if len({mark.photo for mark in marks}) < 2:
        return None
    normal, aim = np.zeros((3, 3)), np.zeros(3)
    for mark in marks:
        image = images[mark.photo]
        camera = model.camera(image.camera_id)
        seen = camera.cam_from_img(np.array([mark.x, mark.y]))
        if seen is None:  # the lens's distortion has no answer there: far outside the photo
            return None
        ray = image.cam_from_world().rotation.matrix().T @ np.append(seen, 1.0)
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        aim += across @ image.projection_center()

    def errors(place: Array) -> Array:
        return np.concatenate([_error(model, images[mark.photo], mark, place) for mark in marks])

    start = np.linalg.solve(normal, aim)
    best: Array = least_squares(errors, start, loss="soft_l1", f_scale=MARK_PIXELS).x
    return best


def _errors(model: pycolmap.Reconstruction, point: GroundPoint, place: Array) -> dict[str, float]:
    images = _registered(model)
    return {
        mark.photo: float(np.linalg.norm(_error(model, images[mark.photo], mark, place)))
        for mark in point.marks
        if mark.photo in images
    }


def _error(
    model: pycolmap.Reconstruction, image: pycolmap.Image, mark: Mark, place: Array
) -> Array:
    camera = model.camera(image.camera_id)
    seen = camera.img_from_cam(image.cam_from_world() * place, check_cheirality=False)
    assert seen is not None
    return seen - np.array([mark.x, mark.y])


def _lend_keypoint(
    model: pycolmap.Reconstruction, image: pycolmap.Image, lent: set[tuple[int, int]]
) -> int:
    """Return a keypoint of the image that no 3D point has, for a mark to take its place.

    pycolmap cannot add keypoints to an image that has some.
    """
    number = next(
        (
            i
            for i, point in enumerate(image.points2D)
            if not point.has_point3D() and (image.image_id, i) not in lent
        ),
        None,
    )
    if number is None:
        number = next(i for i in range(len(image.points2D)) if (image.image_id, i) not in lent)
        model.delete_observation(image.image_id, number)
    lent.add((image.image_id, number))
    return number


def _registered(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image for image in images}


def _surveyed(control: ControlList, frame: LocalFrame) -> Array:
    places = np.array([point.place for point in control.points]).reshape(-1, 3)
    return frame.from_crs(places, control.crs)


def _by_name(photos: Collection[str]) -> dict[str, str]:
    """Return photos by their whole name, and by the file name alone where that is unique."""
    short: dict[str, list[str]] = {}
    for photo in photos:
        short.setdefault(Path(photo).name, []).append(photo)
    unique = {name: found[0] for name, found in short.items() if len(found) == 1}
    return unique | {photo: photo for photo in photos}


def _numbers(
    path: Path, number: int, line: str
) -> tuple[tuple[float, float, float], tuple[float, float], str]:
    columns = line.split(None, COLUMNS - 1)
    try:
        x, y, z, px, py = (float(column) for column in columns[: COLUMNS - 1])
        rest = columns[COLUMNS - 1]
    except (ValueError, IndexError) as fault:
        raise InputError(
            f"{path}, line {number} is no mark: x y z px py photo are wanted, with a point for "
            "decimals."
        ) from fault
    if not np.isfinite([x, y, z, px, py]).all():
        raise InputError(f"{path}, line {number} has a number that is not finite.")
    return (x, y, z), (px, py), rest


def _photo_and_name(rest: str, known: dict[str, str]) -> tuple[str | None, str]:
    """Split a photo's name, which may hold spaces, from the point's name after it."""
    parts: Sequence[str] = rest.split("\t") if "\t" in rest else rest.split(" ")
    joint = "\t" if "\t" in rest else " "
    for cut in range(len(parts), 0, -1):
        photo = joint.join(parts[:cut]).strip()
        if photo in known:
            return known[photo], " ".join(joint.join(parts[cut:]).split()[:1])
    return None, ""
