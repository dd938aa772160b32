"""A simulated flight without photos: a matched database with known poses, of any size in seconds.

For tests and benchmarks of mapping at sizes that would take hours to render and match.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from pyproj import CRS
from scipy.spatial import KDTree

from colmap_netvlad.geo.frames import LocalFrame

WIDTH, HEIGHT, FOCAL, RADIAL = 1000, 750, 800.0, -0.02
"""The true camera: SIMPLE_RADIAL, px."""

FLYING_HEIGHT = 100.0
"""Above the mean ground, m."""

FRAME = LocalFrame(53.3811, -1.4701)
"""Where the simulated flight is: truth is m east, north, up of here."""

REACH = 110.0
"""No photo sees farther than this, m east or north; the distortion's polynomial is void there."""

FORWARD, SIDE = 24.0, 45.0
"""Distance of photos in a line and of lines, m: overlaps of about 75 % and 65 %."""


@dataclass(frozen=True)
class SimulationOptions:
    """Options of `simulate_flight`.

    Attributes:
        lines: flight lines, flown back and forth.
        photos: photos in a line.
        features: ground points a photo sees, about.
        detected: share of them that it detects.
        matched: share of the common features of two photos that is matched.
        outliers: share of wrong matches.
        noise: standard deviation of a feature, px.
        partners: nearest photos that each photo is matched with.
        focal_error: relative error of the focal length that the database states.
        gps: standard deviation of the position priors (WGS84), m; None: no priors.
        seed: seed of everything.
    """

    lines: int = 5
    photos: int = 8
    features: int = 250
    detected: float = 0.75
    matched: float = 0.85
    outliers: float = 0.01
    noise: float = 0.6
    partners: int = 20
    focal_error: float = 0.01
    gps: float | None = None
    seed: int = 0


def simulate_flight(
    database: Path, options: SimulationOptions = SimulationOptions()
) -> dict[str, NDArray[np.float64]]:
    """Write a matched database of a nadir flight over hilly ground.

    Returns:
        the true camera centre (x, y, z in m, z up) of every image by name.
    """
    rng = np.random.default_rng(options.seed)
    rotations, centres = _poses(rng, options)
    ground = _ground(rng, centres, options)
    seen = [
        _observe(rng, rotation, centre, ground, options)
        for rotation, centre in zip(rotations, centres, strict=True)
    ]
    names = [f"{i:05d}.jpg" for i in range(len(centres))]
    written = pycolmap.Database.open(database)
    with pycolmap.DatabaseTransaction(written):
        _write(rng, written, names, seen, rotations, centres, options)
        if options.gps is not None:
            write_gps(written, names, centres, options.gps, options.seed)
    written.close()
    return dict(zip(names, centres, strict=True))


def simulate_control(
    path: Path,
    options: SimulationOptions = SimulationOptions(),
    rows: int = 3,
    columns: int = 3,
    noise: float = 0.5,
) -> dict[str, NDArray[np.float64]]:
    """Write a `gcp_list.txt` of ground points of a flight that `simulate_flight` simulates.

    Args:
        path: the list.
        options: those of the flight.
        rows, columns: of the grid of points; they are named GCP1, GCP2, ...
        noise: standard deviation of a mark, px.

    Returns:
        the true place (x, y, z in m) of every point by name.
    """
    rotations, centres = _poses(np.random.default_rng(options.seed), options)
    rng = np.random.default_rng([options.seed, 2])
    low, high = centres[:, :2].min(axis=0) + 5, centres[:, :2].max(axis=0) - 5
    east, north = np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows)
    xy = np.stack(np.meshgrid(east, north), -1).reshape(-1, 2)
    ground = np.column_stack([xy, _hills(xy)])
    crs = CRS.from_epsg(FRAME.epsg)
    surveyed = FRAME.to_crs(ground, crs)
    lines = [f"EPSG:{FRAME.epsg}"]
    for number, (place, known) in enumerate(zip(ground, surveyed, strict=True), 1):
        for i, (rotation, centre) in enumerate(zip(rotations, centres, strict=True)):
            (pixel,) = _project(rotation, centre, place[None])
            near = np.abs(place - centre)[:2].max() < REACH
            if near and (pixel > 0).all() and (pixel < [WIDTH, HEIGHT]).all():
                x, y = pixel + rng.normal(0, noise, 2)
                lines.append(
                    " ".join(f"{value:.4f}" for value in (*known, x, y))
                    + f" {i:05d}.jpg GCP{number}"
                )
    path.write_text("\n".join(lines) + "\n")
    return {f"GCP{number}": place for number, place in enumerate(ground, 1)}


def _poses(
    rng: np.random.Generator, options: SimulationOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N, 3, 3) cam_from_world rotations and (N, 3) centres."""
    rotations, centres = [], []
    down = np.diag([1.0, -1.0, -1.0])
    for line in range(options.lines):
        order = range(options.photos) if line % 2 == 0 else reversed(range(options.photos))
        for photo in order:
            centres.append([line * SIDE, photo * FORWARD, FLYING_HEIGHT])
            roll, pitch, yaw = rng.normal(0, np.radians(2), 3)
            yaw += np.pi * (line % 2)
            rotations.append(_turn(0, pitch) @ _turn(1, roll) @ _turn(2, yaw) @ down)
    jitter = rng.normal(0, 1.5, (len(centres), 3))
    return np.array(rotations), np.array(centres) + jitter


def _turn(axis: int, angle: float) -> NDArray[np.float64]:
    a, b = [i for i in range(3) if i != axis]
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = np.cos(angle)
    matrix[a, b], matrix[b, a] = -np.sin(angle), np.sin(angle)
    return matrix


def _ground(
    rng: np.random.Generator, centres: NDArray[np.float64], options: SimulationOptions
) -> NDArray[np.float64]:
    """Return (P, 3) points on hills with houses, dense enough for the features wanted."""
    footprint = WIDTH * HEIGHT * (FLYING_HEIGHT / FOCAL) ** 2
    low, high = centres[:, :2].min(axis=0) - 80, centres[:, :2].max(axis=0) + 80
    count = int(np.prod(high - low) * options.features / footprint)
    xy = rng.uniform(low, high, (count, 2))
    houses = rng.uniform(0, 10, count) * (rng.random(count) < 0.3)
    return np.column_stack([xy, _hills(xy) + houses])


def _hills(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) heights of the ground, m."""
    return 8 * np.sin(xy[:, 0] / 90) * np.cos(xy[:, 1] / 70)


def _project(
    rotation: NDArray[np.float64], centre: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (N, 2) pixels of points below a camera."""
    local = (points - centre) @ rotation.T
    plane = local[:, :2] / local[:, 2:]
    plane *= 1 + RADIAL * (plane**2).sum(axis=1, keepdims=True)
    return plane * FOCAL + [WIDTH / 2, HEIGHT / 2]


def _observe(
    rng: np.random.Generator,
    rotation: NDArray[np.float64],
    centre: NDArray[np.float64],
    ground: NDArray[np.float64],
    options: SimulationOptions,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the ground points that a photo detects, ascending, and their keypoints."""
    near = np.flatnonzero(np.abs(ground[:, :2] - centre[:2]).max(axis=1) < REACH)
    pixel = _project(rotation, centre, ground[near])
    pixel += rng.normal(0, options.noise, pixel.shape)
    inside = ((pixel > 0) & (pixel < [WIDTH, HEIGHT])).all(axis=1)
    inside &= rng.random(len(near)) < options.detected
    return near[inside], pixel[inside].astype(np.float32)


def _write(
    rng: np.random.Generator,
    database: pycolmap.Database,
    names: list[str],
    seen: list[tuple[NDArray[np.int64], NDArray[np.float32]]],
    rotations: NDArray[np.float64],
    centres: NDArray[np.float64],
    options: SimulationOptions,
) -> None:
    camera = pycolmap.Camera.create_from_model_id(
        0,
        pycolmap.CameraModelId.SIMPLE_RADIAL,
        FOCAL * (1 + options.focal_error),
        WIDTH,
        HEIGHT,
    )
    camera.has_prior_focal_length = True
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    rig.rig_id = database.write_rig(rig)
    ids = []
    for name, (_, keypoints) in zip(names, seen, strict=True):
        image = pycolmap.Image(name, camera_id=camera.camera_id)
        image.image_id = database.write_image(image)
        frame = pycolmap.Frame()
        frame.rig_id = rig.rig_id
        frame.add_data_id(image.data_id)
        database.write_frame(frame)
        database.write_keypoints(image.image_id, keypoints)
        ids.append(image.image_id)
    _, nearest = KDTree(centres).query(centres, min(options.partners + 1, len(centres)))
    pairs = {tuple(sorted((i, j))) for i, row in enumerate(nearest.tolist()) for j in row if i != j}
    for i, j in sorted(pairs):
        _, first, second = np.intersect1d(
            seen[i][0], seen[j][0], assume_unique=True, return_indices=True
        )
        matches = np.stack([first, second], axis=1)
        matches = matches[rng.random(len(matches)) < options.matched]
        wrong = np.flatnonzero(rng.random(len(matches)) < options.outliers)
        matches[wrong, 1] = np.roll(matches[wrong, 1], 1)
        if len(matches) < 15:
            continue
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = matches.astype(np.uint32)
        turn = rotations[j] @ rotations[i].T
        shift = rotations[j] @ (centres[i] - centres[j])
        geometry.E = pycolmap.essential_matrix_from_pose(
            pycolmap.Rigid3d(pycolmap.Rotation3d(turn), shift)
        )
        database.write_matches(ids[i], ids[j], matches.astype(np.uint32))
        database.write_two_view_geometry(ids[i], ids[j], geometry)


def write_gps(
    database: pycolmap.Database,
    names: list[str],
    centres: NDArray[np.float64],
    deviation: float,
    seed: int,
) -> None:
    """Write positions with noise as COLMAP does of EXIF GPS: WGS84, no covariance."""
    noise = np.random.default_rng([seed, 1]).normal(0, deviation, centres.shape)
    images = {image.name: image for image in database.read_all_images()}
    for name, place in zip(names, FRAME.to_wgs84(centres + noise), strict=True):
        prior = pycolmap.PosePrior()
        prior.position = place
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.WGS84
        prior.corr_data_id = images[name].data_id
        database.write_pose_prior(prior)
