"""Render a drone flight over a made-up landscape: photos with EXIF, and the true poses."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.demo.country import SHEET_SIDE, sheet_of
from colmap_netvlad.demo.exif import Exif, add_exif
from colmap_netvlad.demo.landscape import Extent, Ground, Landscape
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path, write_atomically
from colmap_netvlad.runtime.progress import step

Heights = NDArray[np.float32] | np.float32

FOCAL_35MM = 28
"""Focal length of the rendered camera on 35 mm film, mm."""

FILM_DIAGONAL = 43.266615305567875
"""Diagonal of 35 mm film, mm: COLMAP's prior is `FOCAL_35MM / FILM_DIAGONAL * diagonal` px."""

ORIGIN = (53.3811, -1.4701, 120.0)
"""Latitude and longitude (degrees) and altitude (m) of the flight's origin."""

BLOCK_OFFSET = np.array([1000.0, 0.0, 0.0])
"""From one block to the next on the map, m; each is rendered about its own origin."""

TRUTH_FILE = "truth.json"

SEEN_FILE = "seen.npy"
"""(N, P, 3) float32: the places on the surface that the middles of `SEEN_GRID` parts of each photo
show, m east, north and up of the origin."""

SEEN_GRID = (12, 9)
"""Parts of a photo across and down."""

MOST_PHOTOS = 9999
"""Names have four digits."""


@dataclass(frozen=True)
class FlightOptions:
    """A lawn-mower flight.

    Attributes:
        rows: flight lines.
        columns: photos on a line.
        cross_rows: lines of a second flight across the first, cameras turned by 90 degrees.
        width, height: photo size, px.
        altitude: of the flight above the ground, m.
        overlap: share of a photo that its neighbour sees too, forward and sideways, 0..0.95.
        ground: kind of landscape.
        blocks: separate flights, each over a landscape of its own with nothing in common.
        seed: of landscape and jitter.
        photos: the flight ends after so many on each block; 0: at the end of its last line.
    """

    rows: int = 5
    columns: int = 8
    cross_rows: int = 0
    width: int = 640
    height: int = 480
    altitude: float = 80.0
    overlap: float = 0.7
    ground: Ground = "village"
    blocks: int = 1
    seed: int = 0
    photos: int = 0

    @classmethod
    def large(
        cls, photos: int, width: int = 640, height: int = 480, seed: int = 0
    ) -> FlightOptions:
        """Return a flight of exactly `photos` photos over a square of country.

        Raises:
            InputError: fewer than 4 photos, or more than their names can count.
        """
        if not 4 <= photos <= MOST_PHOTOS:
            raise InputError(f"`photos` is {photos}; a flight has 4 to {MOST_PHOTOS:,} of them.")
        rows = max(2, round(math.sqrt(photos * height / width)))
        columns = math.ceil(photos / rows)
        return cls(
            rows, columns, width=width, height=height, ground="country", seed=seed, photos=photos
        )


@dataclass(frozen=True, eq=False)
class RenderedFlight:
    """Rendered photos and what is true about them.

    Attributes:
        images: folder of the photos; `truth.json` lies beside it.
        names: N file names in the order of the flight.
        centres: (N, 3) float64, camera centres, m east, north and up of the origin.
        rotations: (N, 3, 3) float64, camera from world, in COLMAP's frame (x right, y down,
            z forward).
        blocks: (N,) int, which separate flight a photo belongs to.
        width, height: photo size, px.
        focal: px; the principal point is the photo's centre and there is no distortion.
    """

    images: Path
    names: tuple[str, ...]
    centres: NDArray[np.float64]
    rotations: NDArray[np.float64]
    blocks: NDArray[np.int64]
    width: int
    height: int
    focal: float

    @property
    def extent(self) -> float:
        """Diagonal of the box around the camera centres, m."""
        return float(np.linalg.norm(np.ptp(self.centres, axis=0)))


def render_flight(folder: Path, options: FlightOptions = FlightOptions()) -> RenderedFlight:
    """Render a flight into `folder/images` and its true poses into `folder/truth.json`.

    The same options give the same photos. Takes about 0.2 s a photo of 640 x 480 on two cores.

    Raises:
        InputError: the folder cannot be written.
    """
    focal = FOCAL_35MM / FILM_DIAGONAL * math.hypot(options.width, options.height)
    images = folder / "images"
    try:
        images.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise InputError(f"Cannot write {images}: {fault.strerror}.") from fault
    plans = [_plan(options, focal, block) for block in range(options.blocks)]
    size = len(plans[0][0])
    names = tuple(f"DJI_{i + 1:04d}.JPG" for i in range(size * options.blocks))
    flight = RenderedFlight(
        images=images,
        names=names,
        centres=np.concatenate([c + b * BLOCK_OFFSET for b, (c, _) in enumerate(plans)]),
        rotations=np.concatenate([rotations for _, rotations in plans]),
        blocks=np.repeat(np.arange(options.blocks), size),
        width=options.width,
        height=options.height,
        focal=focal,
    )
    # First, so that a rendering which was stopped is known by its options.
    write_atomically(folder / TRUTH_FILE, json.dumps(_truth(flight, options), indent=1) + "\n")
    seen = np.zeros((len(names), SEEN_GRID[0] * SEEN_GRID[1], 3), np.float32)
    frame = options.width, options.height
    with step("Rendering the flight", len(names)) as bar, ThreadPoolExecutor(2) as pool:
        for block, plan in enumerate(plans):
            seed = _block_seed(options, block)
            for landscape, photos in _landscapes(options, focal, plan[0], seed):

                def photo(
                    i: int,
                    block: int = block,
                    plan: tuple[NDArray[np.float64], NDArray[np.float64]] = plan,
                    landscape: Landscape = landscape,
                    seed: int = seed,
                ) -> None:
                    view = landscape, plan[0][i], plan[1][i], focal, frame
                    developed = _develop(render_photo(*view), np.random.default_rng([seed, 2, i]))
                    number, shift = block * size + i, block * BLOCK_OFFSET
                    exif = _exif(plan[0][i] + shift, i)
                    write_atomically(images / names[number], add_exif(_jpeg(developed), exif))
                    seen[number] = places_seen(*view) + shift
                    bar.advance()

                list(pool.map(photo, photos.tolist()))
                del photo, landscape  # before the next one is painted
    with atomic_path(folder / SEEN_FILE) as draft, draft.open("wb") as file:
        np.save(file, seen)
    return flight


def flight_exists(folder: Path, options: FlightOptions) -> bool:
    """Whether `render_flight` was begun in a folder with the same options."""
    truth = folder / TRUTH_FILE
    if not truth.is_file():
        return False
    # What did not exist when the flight was rendered was as it is by default.
    begun = vars(FlightOptions()) | json.loads(truth.read_text()).get("options", {})
    return begun == vars(options)


def read_flight(folder: Path) -> RenderedFlight:
    """Read the truth beside photos rendered earlier."""
    truth = json.loads((folder / TRUTH_FILE).read_text(encoding="utf-8"))
    photos = truth["photos"]
    return RenderedFlight(
        folder / "images",
        tuple(photo["name"] for photo in photos),
        np.array([photo["centre"] for photo in photos]),
        np.array([photo["rotation"] for photo in photos]),
        np.array([photo["block"] for photo in photos]),
        truth["width"],
        truth["height"],
        truth["focal"],
    )


def render_photo(
    landscape: Landscape,
    centre: NDArray[np.float64],
    rotation: NDArray[np.float64],
    focal: float,
    size: tuple[int, int],
) -> NDArray[np.float32]:
    """Return (H, W, 3) RGB in 0..1 of what a pinhole camera sees that looks down.

    Houses and trees hide what lies behind them, as in a real photo.
    """
    lean_e, lean_n = _lean(rotation, focal, size, size)
    under = _strike(landscape, centre, lean_e, lean_n)
    columns, rows = landscape.grid(*_place(centre, lean_e, lean_n, under))
    colour = _look_up(landscape.colour, columns, rows)
    nearest = (landscape.house, landscape.wall_along, landscape.wall_light)
    house, along, light = (_look_up(grid, columns, rows, cv2.INTER_NEAREST) for grid in nearest)
    number = house.astype(np.int32)
    foot = _look_up(landscape.ground, columns, rows)
    wall = (number > 0) & (under < landscape.eaves[number] - 0.05) & (under > foot + 0.15)
    if wall.any():
        plaster = landscape.walls[number[wall]]
        pane = (np.abs(along[wall] % 2.6 - 1.3) < 0.5) & (
            np.abs((under - foot)[wall] % 2.9 - 1.6) < 0.65
        )
        colour[wall] = np.where(pane[:, None], np.array((0.2, 0.22, 0.26), np.float32), plaster)
        colour[wall] *= light[wall][:, None]
    return colour


def places_seen(
    landscape: Landscape,
    centre: NDArray[np.float64],
    rotation: NDArray[np.float64],
    focal: float,
    size: tuple[int, int],
) -> NDArray[np.float32]:
    """Return (P, 3) the places that the middles of `SEEN_GRID` parts of a photo show, m."""
    lean_e, lean_n = _lean(rotation, focal, size, SEEN_GRID)
    up = _strike(landscape, centre, lean_e, lean_n)
    return np.stack([*_place(centre, lean_e, lean_n, up), up], -1).reshape(-1, 3)


def _lean(
    rotation: NDArray[np.float64], focal: float, size: tuple[int, int], parts: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return how far east and north the rays through the middles of a photo's parts (across,
    down; its pixels, where there are as many) go for each metre up."""
    # COLMAP's convention: the centre of the first pixel is (0.5, 0.5).
    across, down = (
        (np.arange(count) + 0.5) * (side / count) - side / 2
        for side, count in zip(size, parts, strict=True)
    )
    u, v = np.meshgrid(across, down)
    rays = np.stack([u / focal, v / focal, np.ones_like(u)], -1) @ rotation
    return (
        (rays[..., 0] / rays[..., 2]).astype(np.float32),
        (rays[..., 1] / rays[..., 2]).astype(np.float32),
    )


def _place(
    centre: NDArray[np.float64],
    lean_e: NDArray[np.float32],
    lean_n: NDArray[np.float32],
    up: Heights,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return east and north of where rays are at a height."""
    below = up - np.float32(centre[2])
    return np.float32(centre[0]) + below * lean_e, np.float32(centre[1]) + below * lean_n


def _strike(
    landscape: Landscape,
    centre: NDArray[np.float64],
    lean_e: NDArray[np.float32],
    lean_n: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the height at which each ray strikes the surface.

    Each ray is followed down level by level until it is under the surface, then the place is
    halved in.
    """

    def surface(up: Heights) -> NDArray[np.float32]:
        return _look_up(landscape.height, *landscape.grid(*_place(centre, lean_e, lean_n, up)))

    top, bottom = landscape.top, landscape.bottom
    levels = max(2, math.ceil((top - bottom) / 0.5))
    drop = np.float32((top - bottom) / levels)
    free = np.ones(lean_e.shape, bool)
    depth = np.zeros(lean_e.shape, np.float32)
    for level in range(1, levels + 1):
        up = np.float32(top - level * drop)
        free &= surface(up) < up
        depth += free
    above = np.float32(top) - depth * drop
    under = above - drop
    for _ in range(6):
        middle = (above + under) * np.float32(0.5)
        hit = surface(middle) >= middle
        under = np.where(hit, middle, under)
        above = np.where(hit, above, middle)
    return under


def _look_up(
    grid: NDArray[np.float32],
    columns: NDArray[np.float32],
    rows: NDArray[np.float32],
    interpolation: int = cv2.INTER_LINEAR,
) -> NDArray[np.float32]:
    return cv2.remap(grid, columns, rows, interpolation, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def _block_seed(options: FlightOptions, block: int) -> int:
    return options.seed * 1000 + block


def _landscapes(
    options: FlightOptions, focal: float, centres: NDArray[np.float64], seed: int
) -> Iterator[tuple[Landscape, NDArray[np.intp]]]:
    """Yield the ground under a flight, whole or sheet by sheet, and which photos show it."""
    cell = 0.8 * options.altitude / focal
    if options.ground != "country":
        extent = _extent(centres, options, focal)
        yield Landscape(extent, cell, options.ground, seed), np.arange(len(centres))
        return
    reach = _reach(options, focal)
    sheets = np.floor(centres[:, :2] / SHEET_SIDE).astype(int)
    for sheet in np.unique(sheets, axis=0):
        photos = np.flatnonzero((sheets == sheet).all(axis=1))
        column, row = sheet.tolist()
        yield sheet_of(column, row, reach, cell, seed), photos


def _reach(options: FlightOptions, focal: float) -> float:
    """Return how far from below it a photo can see, with a margin for tilt and relief, m."""
    return 0.65 * math.hypot(options.width, options.height) / focal * options.altitude


def _extent(centres: NDArray[np.float64], options: FlightOptions, focal: float) -> Extent:
    """Return the ground that photos from `centres` can see."""
    reach = _reach(options, focal)
    west, south = (centres[:, :2].min(axis=0) - reach).tolist()
    east, north = (centres[:, :2].max(axis=0) + reach).tolist()
    return Extent(west, south, east, north)


def _plan(
    options: FlightOptions, focal: float, block: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return camera centres and rotations of the flight lines, as a drone flies them.

    The drone turns at the end of each line, so that every second line is seen upside down.
    """
    rng = np.random.default_rng([_block_seed(options, block), 1])
    across = (1 - options.overlap) * options.width / focal * options.altitude
    forward = (1 - options.overlap) * options.height / focal * options.altitude
    centres, rotations = [], []

    def shoot(east: float, north: float, up: float, heading: float) -> None:
        drift = rng.normal(0, 0.03 * options.altitude * (1 - options.overlap), 2)
        centres.append((east + drift[0], north + drift[1], up + rng.normal(0, 0.015 * up)))
        yaw, pitch, roll = np.array([heading, 0, 0]) + rng.normal(0, np.radians([2.5, 1.5, 1.5]))
        rotations.append(_rotation(yaw, pitch, roll))

    east = (np.arange(options.rows) - (options.rows - 1) / 2) * across
    north = (np.arange(options.columns) - (options.columns - 1) / 2) * forward
    for i, e in enumerate(east):
        for n in north[:: 1 if i % 2 == 0 else -1]:
            shoot(e, n, options.altitude, 0.0 if i % 2 == 0 else math.pi)
    if options.cross_rows:
        lines = np.linspace(north[0], north[-1], options.cross_rows + 2)[1:-1]
        places = np.linspace(east[0] - across / 2, east[-1] + across / 2, options.rows + 1)
        for i, n in enumerate(lines):
            for e in places[:: 1 if i % 2 == 0 else -1]:
                heading = math.pi / 2 if i % 2 == 0 else -math.pi / 2
                shoot(e, n, 1.12 * options.altitude, heading)
    most = options.photos or None
    return np.array(centres)[:most], np.array(rotations)[:most]


def _rotation(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Camera from world: looking straight down with the photo's top towards `yaw` (clockwise
    from north), then tilted by `pitch` and `roll`; radians."""
    right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
    down = np.array([-math.sin(yaw), -math.cos(yaw), 0.0])
    nadir = np.stack([right, down, [0.0, 0.0, -1.0]])
    tilt, _ = cv2.Rodrigues(np.array([pitch, roll, 0.0]))
    return tilt @ nadir


def _develop(pixels: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """What a camera adds: exposure, darker corners, sensor noise, 8 bits."""
    height, width = pixels.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    corner = (1 - 0.09 * (x**2 + y**2)).astype(np.float32)[..., None]
    exposure = np.float32(rng.normal(1, 0.03))
    noise = rng.standard_normal(pixels.shape, np.float32) * np.float32(0.008)
    smooth = cv2.GaussianBlur(pixels, (0, 0), 0.45)
    return (np.clip(smooth * corner * exposure + noise, 0, 1) * 255).round().astype(np.uint8)


def _jpeg(pixels: NDArray[np.uint8]) -> bytes:
    bgr = np.ascontiguousarray(pixels[..., ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 94])[1].tobytes()


def _exif(centre: NDArray[np.float64], number: int) -> Exif:
    latitude, longitude, altitude = to_wgs84(centre)
    seconds = 4 * number
    time = f"{10 + seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    return Exif(
        "DJI", "FC-rendered", FOCAL_35MM, latitude, longitude, altitude, f"2024:06:12 {time}"
    )


def to_wgs84(position: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return (latitude, longitude, altitude) of m east, north, up of the origin.

    The ellipsoid's radii of curvature at the origin; good to about a centimetre in a kilometre.
    """
    latitude, longitude, altitude = ORIGIN
    squared = 6.69437999014e-3
    bend = 1 - squared * math.sin(math.radians(latitude)) ** 2
    meridian = 6378137.0 * (1 - squared) / bend**1.5
    normal = 6378137.0 / math.sqrt(bend)
    east, north, up = position.tolist()
    return (
        latitude + math.degrees(north / meridian),
        longitude + math.degrees(east / (normal * math.cos(math.radians(latitude)))),
        altitude + up,
    )


def _truth(flight: RenderedFlight, options: FlightOptions) -> dict[str, object]:
    return {
        "options": vars(options),
        "width": flight.width,
        "height": flight.height,
        "focal": flight.focal,
        "photos": [
            {"name": n, "centre": c.tolist(), "rotation": r.tolist(), "block": int(b)}
            for n, c, r, b in zip(
                flight.names, flight.centres, flight.rotations, flight.blocks, strict=True
            )
        ],
    }
