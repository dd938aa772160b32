"""A made-up landscape: a height field and the colours that lie on it.

Everything is painted on a north-up grid of square cells: fields and roads first, then houses and
trees, which raise the height field as well, and sunlight with cast shadows last. One seed gives
one landscape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Ground = Literal["village", "plantation", "bare", "copies", "country"]
"""village: fields, roads, houses, trees. plantation: equal palms in rows, the repetitive texture
that confuses retrieval. bare: sand with few marks, the weak texture that starves SIFT. copies: the
same estate, houses and orchard rows alike to the last tile, again and again on flat fields: look-
alike places that verify as one. country: all kinds of ground in blocks between roads, as large as
the flight asks (`demo.country`)."""

ESTATE, ESTATE_STEP = 64.0, 110.0
"""Side of an estate of "copies", and the distance from one to its copy, m."""

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]

SUN = np.array([-0.55, 0.45, 0.7]) / np.linalg.norm([-0.55, 0.45, 0.7])
"""Unit vector towards the sun (east, north, up)."""

SKYLIGHT, SUNLIGHT = (0.42, 0.44, 0.48), (0.70, 0.67, 0.61)
"""RGB of what comes from the sky everywhere, and from the sun."""

CROPS = (
    (0.33, 0.43, 0.20), (0.44, 0.50, 0.25), (0.62, 0.56, 0.34), (0.49, 0.39, 0.28),
    (0.25, 0.36, 0.17), (0.71, 0.64, 0.42), (0.40, 0.33, 0.25), (0.53, 0.55, 0.30),
)  # fmt: skip
ROOFS = (
    (0.60, 0.31, 0.22), (0.52, 0.27, 0.20), (0.66, 0.42, 0.30), (0.40, 0.38, 0.38),
    (0.55, 0.53, 0.51), (0.36, 0.28, 0.25), (0.70, 0.68, 0.64),
)  # fmt: skip
CARS = ((0.85, 0.85, 0.86), (0.12, 0.13, 0.15), (0.6, 0.1, 0.1), (0.2, 0.3, 0.55), (0.6, 0.6, 0.6))


@dataclass(frozen=True)
class Extent:
    """A rectangle on the ground, m east and north of the flight's origin."""

    west: float
    south: float
    east: float
    north: float


class Landscape:
    """The grids that the renderer looks up.

    Attributes:
        extent: the ground the grids cover.
        cell: width of a grid cell, m.
        height: (H, W) float32, surface with houses and trees, m above the origin.
        ground: (H, W) float32, the bare ground below them, m.
        colour: (H, W, 3) float32 RGB in 0..1, lit by the sun.
        house: (H, W) float32, number of the house from 1, else 0; reaches two cells beyond its
            walls, so that a ray which hits a wall finds it.
        wall_along: (H, W) float32, position along the wall, m.
        wall_light: (H, W) float32, light on the wall, 0..1.
        eaves: (houses + 1,) float32, height where the wall ends and the roof begins, m.
        walls: (houses + 1, 3) float32, wall colours.
        bottom, top: least and greatest of `height`, m.
    """

    def __init__(self, extent: Extent, cell: float, ground: Ground, seed: int) -> None:
        self.extent, self.cell = extent, cell
        self._rng = np.random.default_rng([seed, 20])
        self.shape = (
            round((extent.north - extent.south) / cell),
            round((extent.east - extent.west) / cell),
        )
        self._side = self.cell * max(self.shape)
        rows, columns = (np.arange(side, dtype=np.float32) for side in self.shape)
        east = np.float32(extent.west) + (columns + np.float32(0.5)) * np.float32(cell)
        north = np.float32(extent.north) - (rows + np.float32(0.5)) * np.float32(cell)
        # Views of one row and one column: positions take no memory.
        self._east: FloatImage = np.broadcast_to(east, self.shape)
        self._north: FloatImage = np.broadcast_to(north[:, None], self.shape)
        self.ground = 14 * self._noise(90, 3) + 0.25 * self._noise(4, 2)
        self.height = self.ground.copy()
        self.house = np.zeros(self.shape, np.float32)
        self.wall_along = np.zeros(self.shape, np.float32)
        self.wall_light = np.ones(self.shape, np.float32)
        self._eaves: list[float] = [0.0]
        self._walls: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0)]
        self._angle = self._rng.uniform(-0.6, 0.6)
        self._mottle = self._noise(2.0, 3)
        self._paint(ground)
        self._grain(0.015 if ground == "bare" else 0.07)
        self._light()
        self.eaves = np.array(self._eaves, np.float32)
        self.walls = np.array(self._walls, np.float32)
        self.bottom, self.top = float(self.height.min()), float(self.height.max())

    def grid(self, east: FloatImage, north: FloatImage) -> tuple[FloatImage, FloatImage]:
        """Return grid columns and rows (cell centres at whole numbers) of ground positions."""
        scale = np.float32(1 / self.cell)
        columns = (east - np.float32(self.extent.west)) * scale - np.float32(0.5)
        rows = (np.float32(self.extent.north) - north) * scale - np.float32(0.5)
        return columns, rows

    # Landscapes

    def _paint(self, ground: Ground) -> None:
        {
            "village": self._village,
            "plantation": self._plantation,
            "bare": self._bare,
            "copies": self._copies,
        }[ground]()

    def _village(self) -> None:
        self._fields()
        self._patches()
        roads = self._roads()
        self._houses(roads)
        self._woods()

    def _plantation(self) -> None:
        soil = np.array((0.46, 0.40, 0.29), np.float32)
        grass = np.array((0.36, 0.42, 0.22), np.float32)
        mix = np.clip(self._noise(9, 4) * 1.6 + 0.5, 0, 1)[..., None]
        self.colour = (1 - mix) * soil + mix * grass
        along, across = self._turned(self._angle)
        path = np.abs((across + 1.5 * np.sin(along / 40)) % 54.0 - 27) < 1.4
        self.colour[path] = (0.62, 0.53, 0.40)
        spacing, rows = 7.8, 7.8 * 0.866
        half = 0.75 * self._side
        cosine, sine = np.cos(self._angle), np.sin(self._angle)
        for i, a in enumerate(np.arange(-half, half, rows)):
            for b in np.arange(-half, half, spacing) + spacing / 2 * (i % 2):
                e = b * cosine - a * sine + self._rng.normal(0, 0.25)
                n = b * sine + a * cosine + self._rng.normal(0, 0.25)
                if self._rng.random() > 0.03:
                    self._palm(e, n, self._rng.normal(3.7, 0.3), self._rng.normal(4.6, 0.5))

    def _bare(self) -> None:
        sand = np.array(((0.78, 0.70, 0.56), (0.70, 0.68, 0.64), (0.66, 0.52, 0.40)), np.float32)
        shade = 1 + 0.10 * self._noise(25, 4) + 0.03 * self._noise(2, 3)
        self.colour = sand[self._rng.integers(len(sand))] * shade[..., None]
        for e, n in self._scatter(0.0015):
            self._tree(e, n, self._rng.uniform(0.4, 1.2), self._rng.uniform(0.3, 0.9))

    def _copies(self) -> None:
        self.ground[:] = 0
        self.height[:] = 0
        self._fields()
        self._patches()
        self._estate()
        half = self._cells(ESTATE / 2)
        row, column = self._cell_of(0.0, 0.0)
        source = slice(row - half, row + half), slice(column - half, column + half)
        grids = (self.colour, self.height, self.house, self.wall_along, self.wall_light)
        estate = [grid[source].copy() for grid in grids]
        step = self._cells(ESTATE_STEP)
        for r in range(row % step, self.shape[0], step):
            for c in range(column % step, self.shape[1], step):
                if half <= r < self.shape[0] - half and half <= c < self.shape[1] - half:
                    target = slice(r - half, r + half), slice(c - half, c + half)
                    for grid, painted in zip(grids, estate, strict=True):
                        grid[target] = painted

    def _estate(self) -> None:
        """Houses in two rows, a lane between them, and an orchard, around the origin."""
        lane = np.column_stack([np.arange(-30.0, 31.0, 2.0), np.full(31, 8.0)])
        self._angle = 0.0
        self._road(lane, 5.0, True)
        for east in np.arange(-22.0, 25.0, 15.0):
            for north in (20.0, -4.0):
                self._house(east, north, 5.5, 4.2, self._rng.normal(0, 0.05))
        for east in np.arange(-28.0, 29.0, 5.0):
            for north in np.arange(-29.0, -13.0, 5.0):
                self._tree(east, north, self._rng.uniform(1.2, 1.9), self._rng.uniform(2.5, 4.0))

    # What is painted

    def _fields(self) -> None:
        """Parcels from halving a turned rectangle, each with its own crop, rows and wear."""
        side = 1.5 * self._side
        parcels = self._split(-side / 2, -side / 2, side / 2, side / 2)
        label = np.zeros(self.shape, np.int32)
        for number, (a, b, c, d) in enumerate(parcels):
            corners = np.array([(a, b), (c, b), (c, d), (a, d)])
            cv2.fillConvexPoly(label, self._pixels(corners), int(number))
        count = len(parcels)
        crop = np.array(CROPS, np.float32)[self._rng.integers(len(CROPS), size=count)]
        crop *= self._rng.uniform(0.88, 1.12, (count, 1)).astype(np.float32)
        self.colour = crop[label]
        along, across = self._turned(self._angle)
        sideways = (self._rng.random(count) < 0.4)[label]
        row = np.where(sideways, along, across) + 0.3 * self._noise(12, 2)
        period = self._rng.choice([0.9, 1.4, 2.2, 3.0], count).astype(np.float32)[label]
        depth = self._rng.uniform(0.01, 0.11, count).astype(np.float32)[label]
        shade = 1 + depth * np.sin(2 * np.pi * row / period) * (1 + self._noise(6, 2))
        tracks = np.abs(np.abs(row % 12.0 - 6.0) - 0.9) < 0.22
        shade[tracks & (depth > 0.03)] *= 0.84
        wear = self._noise(14, 5)
        shade += 0.22 * wear + 0.18 * self._noise(3, 3)
        self.colour *= shade[..., None]
        edge = cv2.morphologyEx(label.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
        margin = cv2.dilate(edge.astype(np.uint8), self._disc(0.7)) > 0
        grass = np.array((0.36, 0.42, 0.22), np.float32)
        self.colour[margin] = (grass * (1 + 0.4 * self._noise(1.5, 3)[..., None]))[margin]

    def _split(self, a: float, b: float, c: float, d: float) -> list[tuple[float, ...]]:
        wide, high = c - a, d - b
        if max(wide, high) < 42 or (max(wide, high) < 75 and self._rng.random() < 0.35):
            return [(a, b, c, d)]
        cut = self._rng.uniform(0.33, 0.67)
        if wide > high:
            m = a + cut * wide
            return self._split(a, b, m, d) + self._split(m, b, c, d)
        m = b + cut * high
        return self._split(a, b, c, m) + self._split(a, m, c, d)

    def _patches(self) -> None:
        """Bare earth and scrub where nothing is grown."""
        where = np.clip((self._noise(22, 4) - 0.42) * 5, 0, 1)[..., None]
        earth = np.array((0.55, 0.46, 0.34), np.float32) * (1 + 0.3 * self._noise(2, 4)[..., None])
        self.colour = (1 - where) * self.colour + where * earth

    def _roads(self) -> list[NDArray[np.float64]]:
        """Draw two to four roads and return their middle lines, (P, 2) m."""
        reach = 0.8 * self._side
        steps = np.arange(-reach, reach, 2.0)
        roads = []
        for number in range(int(self._rng.integers(2, 5))):
            offset = self._rng.uniform(-0.25, 0.25) * reach
            bend = self._rng.uniform(2, 9) * np.sin(steps / self._rng.uniform(30, 70) + number)
            along, across = steps, offset + bend
            line = np.stack((along, across) if number % 2 == 0 else (across, along), 1)
            paved = number < 2 or self._rng.random() < 0.4
            width = self._rng.uniform(5.0, 6.5) if paved else self._rng.uniform(2.4, 3.2)
            self._road(line, width, paved)
            roads.append(self._world(line))
        return roads

    def _road(self, line: NDArray[np.float64], width: float, paved: bool) -> None:
        points = self._pixels(line)
        verge = self._stroke(points, width + 2.2)
        self.colour[verge] = self.colour[verge] * 0.5 + np.array((0.24, 0.24, 0.17), np.float32)
        lane = self._stroke(points, width)
        grey = (0.43, 0.43, 0.44) if paved else (0.66, 0.57, 0.44)
        wear = (1 + 0.16 * self._noise(5, 4) + 0.10 * self._noise(0.8, 2))[lane][:, None]
        self.colour[lane] = np.array(grey, np.float32) * wear
        if not paved:
            rut = self._stroke(points, width * 0.35)
            self.colour[rut] = self.colour[rut] * np.array((0.8, 0.87, 0.75), np.float32)
            return
        paint = np.zeros(self.shape, np.uint8)
        for i in range(0, len(points) - 1, 3):
            cv2.line(paint, points[i].tolist(), points[i + 1].tolist(), 1, self._cells(0.25))
        worn = (paint > 0) & (self._noise(2, 2) > -0.35)
        self.colour[worn] = (0.86, 0.86, 0.83)
        world = self._world(line)
        for at in np.flatnonzero(self._rng.random(len(line) - 1) < 0.05):
            i = int(at)
            heading = np.arctan2(*(world[i + 1] - world[i])[::-1])
            side = (width / 4) * self._rng.choice([-1, 1])
            e, n = world[i] + side * np.array([-np.sin(heading), np.cos(heading)])
            self._box(e, n, 2.2, 0.95, heading, 1.5, CARS[self._rng.integers(len(CARS))])

    def _houses(self, roads: list[NDArray[np.float64]]) -> None:
        """Houses with garden plots along the roads; none on a road or on one another."""
        near_road = np.zeros(self.shape, np.uint8)
        for road in roads:
            cv2.polylines(near_road, [self._grid_points(road)], False, 1, self._cells(8.5))
        taken = near_road > 0
        for road in roads:
            position, step = self._rng.uniform(0, 10), 2.0
            while position / step < len(road) - 2:
                i = int(position / step)
                heading = np.arctan2(*(road[i + 1] - road[i])[::-1])
                for side in (-1, 1):
                    if self._rng.random() < 0.72:
                        self._plot(road[i], heading, side, taken)
                position += self._rng.uniform(15, 24)

    def _plot(self, at: NDArray[np.float64], heading: float, side: int, taken: Mask) -> None:
        half_a, half_b = self._rng.uniform(4.5, 8.0), self._rng.uniform(3.4, 5.2)
        away = side * (half_b + self._rng.uniform(6.0, 10.0))
        normal = np.array([-np.sin(heading), np.cos(heading)])
        e, n = at + away * normal
        turn = heading + self._rng.normal(0, 0.06)
        patch = self._patch(e, n, 20.0)
        if patch is None:
            return

        def within(where: NDArray[np.float64], a: float, b: float, turn: float) -> Mask:
            along, across = self._local(patch, where[0], where[1], turn)
            return (np.abs(along) <= a) & (np.abs(across) <= b)

        house = np.array([e, n])
        footprint = within(house, half_a, half_b, turn)
        if not footprint.any() or taken[patch][footprint].any():
            return
        free = ~taken[patch]
        middle = house + side * 3.0 * normal
        garden = within(middle, 9.5, 11.0, heading)
        lawn = self._rng.uniform((0.33, 0.38, 0.20), (0.44, 0.49, 0.27)).astype(np.float32)
        colour, height = self.colour[patch], self.height[patch]
        colour[garden & free] = colour[garden & free] * 0.35 + lawn * 0.65
        hedge = garden & ~within(middle, 8.8, 10.3, heading) & free
        colour[hedge] = (0.20, 0.26, 0.14)
        height[hedge] = self.ground[patch][hedge] + 1.3
        drive = within(at + side * 5 * normal, 1.5, 5.0, heading) & free
        colour[drive] = np.array((0.6, 0.58, 0.55), np.float32) * self._rng.uniform(0.8, 1.1)
        height[drive] = self.ground[patch][drive]
        if self._rng.random() < 0.18:
            pool = within(middle + 5 * side * normal, 2.4, 1.3, turn) & free
            colour[pool] = (0.30, 0.62, 0.70)
        self._house(e, n, half_a, half_b, turn)
        taken[patch] |= within(house, half_a + 2, half_b + 2, turn)
        for _ in range(int(self._rng.integers(0, 5))):
            a, b = self._rng.uniform(-9, 9), side * self._rng.uniform(6.5, 12)
            te = e + a * np.cos(heading) - b * np.sin(heading)
            tn = n + a * np.sin(heading) + b * np.cos(heading)
            self._tree(te, tn, self._rng.uniform(0.9, 2.2), self._rng.uniform(1.5, 4.5))

    def _house(self, e: float, n: float, half_a: float, half_b: float, turn: float) -> None:
        """A gable roof on four walls; `half_a` runs along the ridge."""
        patch = self._patch(e, n, float(np.hypot(half_a, half_b)) + 3 * self.cell)
        if patch is None:
            return
        a, b = self._local(patch, e, n, turn)
        base = float(self.ground[patch].mean())
        wall, rise = self._rng.uniform(3.0, 7.0), self._rng.uniform(0.25, 0.65) * half_b
        if self._rng.random() < 0.2:
            rise = 0.0
        eave = base + wall
        over = (np.abs(a) <= half_a) & (np.abs(b) <= half_b)
        roof = eave + rise * (1 - np.abs(b) / half_b)
        tone = np.array(ROOFS, np.float32)[self._rng.integers(len(ROOFS))]
        tone = tone * self._rng.uniform(0.85, 1.12)
        tiles = 1 + 0.07 * np.sign(np.sin(2 * np.pi * b / 0.55))
        tiles = tiles + self._rng.normal(0, 0.05, a.shape) + 0.16 * self._mottle[patch]
        tiles = np.where(np.abs(b) < 0.18, 1.22, tiles)
        paint = tone * tiles[..., None].astype(np.float32)
        for _ in range(int(self._rng.integers(0, 4))):
            u, v = self._rng.uniform(-0.8, 0.8) * half_a, self._rng.uniform(-0.7, 0.7) * half_b
            paint[(np.abs(a - u) < 0.45) & (np.abs(b - v) < 0.6)] = (0.20, 0.24, 0.30)
        if self._rng.random() < 0.3:
            panel = (np.abs(a) < 0.7 * half_a) & (np.abs(b - 0.5 * half_b) < 0.32 * half_b)
            joint = (np.abs(a % 1.0 - 0.5) > 0.44) | (np.abs(b % 1.6 - 0.8) > 0.74)
            paint[panel] = (0.10, 0.13, 0.24)
            paint[panel & joint] = (0.55, 0.57, 0.60)
        u, v = self._rng.uniform(-0.6, 0.6) * half_a, self._rng.uniform(-0.4, 0.4) * half_b
        chimney = (np.abs(a - u) < 0.45) & (np.abs(b - v) < 0.45)
        roof = np.where(chimney, eave + rise + 0.9, roof)
        paint[chimney] = (0.45, 0.30, 0.25)
        self.height[patch][over] = roof[over]
        self.colour[patch][over] = paint[over]

        reach = 2 * self.cell
        near = (np.abs(a) <= half_a + reach) & (np.abs(b) <= half_b + reach)
        end = np.abs(a) / half_a > np.abs(b) / half_b
        self.house[patch][near] = len(self._eaves)
        self.wall_along[patch][near] = np.where(end, b, a)[near]
        facing = np.where(end, turn, turn + np.pi / 2) + np.pi * (np.where(end, a, b) < 0)
        light = np.clip(np.cos(facing) * SUN[0] + np.sin(facing) * SUN[1], 0, 1)
        self.wall_light[patch][near] = (0.45 + 0.6 * light)[near]
        self._eaves.append(eave)
        plaster = self._rng.uniform((0.66, 0.60, 0.52), (0.88, 0.86, 0.82))
        self._walls.append((float(plaster[0]), float(plaster[1]), float(plaster[2])))

    def _box(
        self, e: float, n: float, half_a: float, half_b: float, turn: float, high: float,
        colour: tuple[float, float, float],
    ) -> None:  # fmt: skip
        """A car."""
        patch = self._patch(e, n, float(np.hypot(half_a, half_b)) + self.cell)
        if patch is None:
            return
        a, b = self._local(patch, e, n, turn)
        over = (np.abs(a) <= half_a) & (np.abs(b) <= half_b)
        cabin = (np.abs(a + 0.2) < 0.45 * half_a) & over
        self.height[patch][over] = self.ground[patch][over] + high * 0.6
        self.height[patch][cabin] = self.ground[patch][cabin] + high
        self.colour[patch][over] = colour
        glass = over & (np.abs(np.abs(a + 0.2) - 0.5 * half_a) < 0.22)
        self.colour[patch][glass] = (0.10, 0.11, 0.13)

    def _woods(self) -> None:
        """Single trees everywhere, and groves where a slow noise is high."""
        grove = self._noise(30, 3)
        for e, n in self._scatter(0.020):
            row, column = self._cell_of(e, n)
            dense = grove[row, column] > 0.22
            if (dense or self._rng.random() < 0.06) and self.house[row, column] == 0:
                road = self.colour[row, column]
                if road.max() - road.min() < 0.04:
                    continue
                radius = self._rng.uniform(1.3, 3.4)
                self._tree(e, n, radius, radius * self._rng.uniform(1.4, 2.2))

    def _tree(self, e: float, n: float, radius: float, tall: float) -> None:
        patch = self._patch(e, n, radius * 1.25)
        if patch is None:
            return
        a, b = self._local(patch, e, n, 0.0)
        angle, phase = np.arctan2(b, a), self._rng.uniform(0, 6.28, 2)
        rim = radius * (
            1 + 0.13 * np.sin(3 * angle + phase[0]) + 0.09 * np.sin(7 * angle + phase[1])
        )
        self._crown(patch, np.hypot(a, b) / rim, tall, self._rng.uniform(0.75, 1.3))

    def _palm(self, e: float, n: float, radius: float, tall: float) -> None:
        patch = self._patch(e, n, radius * 1.1)
        if patch is None:
            return
        a, b = self._local(patch, e, n, self._rng.uniform(0, 6.28))
        fronds = 0.42 + 0.58 * np.abs(np.cos(4.5 * np.arctan2(b, a)))
        self._crown(patch, np.hypot(a, b) / (radius * fronds), tall, self._rng.uniform(0.9, 1.2))

    def _crown(
        self, patch: tuple[slice, slice], distance: NDArray[np.floating], tall: float, tone: float
    ) -> None:
        """Raise a crown where `distance` (in radii) is below 1."""
        leaves = self._soften(self._rng.standard_normal(distance.shape, np.float32), 0.22)
        leaves /= leaves.std() + 1e-6
        dome = np.sqrt(np.clip(1 - distance**2, 0, None))
        top = self.ground[patch] + tall * (0.2 + 0.8 * dome) + 0.10 * tall * dome * leaves
        over = (distance < 1) & (top > self.height[patch])
        green = np.array((0.29, 0.35, 0.19), np.float32) * tone * self._rng.uniform(0.9, 1.1, 3)
        shade = (0.62 + 0.42 * dome) * (1 + 0.20 * leaves)
        self.height[patch][over] = top[over]
        self.colour[patch][over] = (green * shade[..., None])[over]
        self.house[patch][over] = 0

    def _grain(self, contrast: float) -> None:
        """The fine mottle of real ground that feature detectors live on."""
        fine = self._noise(1.2, 3) + 0.5 * self._noise(3.2 * self.cell, 2)
        tint = 1 + 0.05 * self._noise(7, 3)[..., None] * np.array((1, 0.2, -1), np.float32)
        self.colour *= tint * (1 + contrast * 1.6 * fine)[..., None]

    def _light(self) -> None:
        """Shade slopes by their angle to the sun, and darken what lies in a shadow."""
        surface = self._soften(self.height, 0.12)
        slope_e = cv2.Sobel(surface, cv2.CV_32F, 1, 0, ksize=3, scale=1 / (8 * self.cell))
        slope_n = -cv2.Sobel(surface, cv2.CV_32F, 0, 1, ksize=3, scale=1 / (8 * self.cell))
        facing = (SUN[2] - slope_e * SUN[0] - slope_n * SUN[1]) / np.sqrt(
            1 + slope_e**2 + slope_n**2
        )
        light = np.clip(facing / SUN[2], 0, 1.45)
        longest = 10.0 / SUN[2] * float(np.hypot(SUN[0], SUN[1]))
        shadow = np.zeros(self.shape, np.float32)
        stride = max(0.35, 1.5 * self.cell)
        for run in np.arange(stride, longest, stride):
            horizontal = float(np.hypot(SUN[0], SUN[1]))
            shift = run / horizontal / self.cell
            move = np.array([[1, 0, -shift * SUN[0]], [0, 1, shift * SUN[1]]], np.float32)
            size = (self.shape[1], self.shape[0])
            blocker = cv2.warpAffine(self.height, move, size, borderMode=cv2.BORDER_REPLICATE)
            above = blocker - self.height - np.float32(run * SUN[2] / horizontal)
            np.maximum(shadow, np.clip(above * 2, 0, 1), out=shadow)
        self._shine(light * (1 - self._soften(shadow, 0.15)))

    def _shine(self, sun: NDArray[np.floating]) -> None:
        """Light the colours by the sky and by (H, W) a share of the sun."""
        sky, direct = np.array(SKYLIGHT, np.float32), np.array(SUNLIGHT, np.float32)
        self.colour = np.clip(self.colour * (sky + direct * sun[..., None]), 0, 1)

    # Small tools

    def _noise(self, wavelength: float, octaves: int) -> FloatImage:
        """Noise of mean 0 and about unit range, from `wavelength` m down by halves."""
        total = np.zeros(self.shape, np.float32)
        for octave in range(octaves):
            spacing = max(wavelength / 2**octave / self.cell, 1.0)
            size = tuple(int(s / spacing) + 4 for s in self.shape)
            knots = self._rng.uniform(-0.5, 0.5, size).astype(np.float32)
            rows = int(np.ceil(size[0] * spacing)), int(np.ceil(size[1] * spacing))
            smooth = cv2.resize(knots, rows[::-1], interpolation=cv2.INTER_CUBIC)
            total += 0.55**octave * smooth[: self.shape[0], : self.shape[1]]
        return total

    def _soften(self, grid: FloatImage, metres: float) -> FloatImage:
        sigma = max(metres / self.cell, 0.5)
        return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma), np.float32)

    def _turned(self, angle: float) -> tuple[FloatImage, FloatImage]:
        cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        along = self._east * cosine + self._north * sine
        return along, self._north * cosine - self._east * sine

    def _world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn points of the landscape's own frame into east and north."""
        cosine, sine = np.cos(self._angle), np.sin(self._angle)
        return points @ np.array([[cosine, sine], [-sine, cosine]])

    def _pixels(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        return self._grid_points(self._world(points))

    def _grid_points(self, world: NDArray[np.float64]) -> NDArray[np.int32]:
        columns = (world[:, 0] - self.extent.west) / self.cell
        rows = (self.extent.north - world[:, 1]) / self.cell
        return np.stack([columns, rows], 1).round().astype(np.int32)

    def _stroke(self, points: NDArray[np.int32], width: float) -> Mask:
        mask = np.zeros(self.shape, np.uint8)
        cv2.polylines(mask, [points], False, 1, self._cells(width))
        return mask > 0

    def _scatter(self, density: float) -> NDArray[np.float64]:
        """Random positions, `density` a square metre."""
        wide, high = self.extent.east - self.extent.west, self.extent.north - self.extent.south
        count = int(self._rng.poisson(density * wide * high))
        low = (self.extent.west, self.extent.south)
        return self._rng.uniform(low, (self.extent.east, self.extent.north), (count, 2))

    def _cell_of(self, e: float, n: float) -> tuple[int, int]:
        row = int(np.clip((self.extent.north - n) / self.cell, 0, self.shape[0] - 1))
        return row, int(np.clip((e - self.extent.west) / self.cell, 0, self.shape[1] - 1))

    def _patch(self, e: float, n: float, reach: float) -> tuple[slice, slice] | None:
        """Return the cells within `reach` m of a place; None where that is outside the grid."""
        top, left = (self.extent.north - n - reach), (e - reach - self.extent.west)
        rows = slice(max(int(top / self.cell), 0), max(int((top + 2 * reach) / self.cell) + 1, 0))
        columns = slice(
            max(int(left / self.cell), 0), max(int((left + 2 * reach) / self.cell) + 1, 0)
        )
        patch = rows, columns
        return patch if self.ground[patch].size else None

    def _local(
        self, patch: tuple[slice, slice], e: float, n: float, turn: float
    ) -> tuple[FloatImage, FloatImage]:
        east, north = self._east[patch] - np.float32(e), self._north[patch] - np.float32(n)
        cosine, sine = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        return east * cosine + north * sine, north * cosine - east * sine

    def _cells(self, metres: float) -> int:
        return max(round(metres / self.cell), 1)

    def _disc(self, radius: float) -> NDArray[np.uint8]:
        size = 2 * self._cells(radius) + 1
        return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)).astype(np.uint8)
