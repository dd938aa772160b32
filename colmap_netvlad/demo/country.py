"""Ground for flights of thousands: square blocks between roads, painted piece by piece.

What a block holds depends on its place and the seed alone, and so does all noise: a piece of the
country can be painted without the rest, and where two pieces overlap they are the same. Many
blocks look alike (terraces of equal roofs, car parks, orchards, fields), some show next to
nothing (ponds, meadows).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.demo.landscape import (
    CARS,
    CROPS,
    SKYLIGHT,
    SUNLIGHT,
    Extent,
    FloatImage,
    Ground,
    Landscape,
)

BLOCK = 96.0
"""Side of a block, m; roads run along its borders."""

SHEET = 3
"""Blocks along a side of a sheet: the piece over which photos are rendered together."""

SHEET_SIDE = SHEET * BLOCK
"""m."""

ROAD, VERGE = 6.0, 2.0
"""Width of a road and of the grass on either side, m."""

KINDS = ("gardens", "terrace", "parking", "strips", "orchard", "pond", "meadow")
SHARES = (0.24, 0.18, 0.10, 0.24, 0.12, 0.05, 0.07)

SEQUENCE = 1 << 20
"""Random numbers that the knots of all noise are taken from."""

Patch = tuple[slice, slice]


class Country(Landscape):
    """The blocks of a rectangle.

    Args:
        low, high: (column, row) of the first block and of the one after the last, counted east
            and north of the flight's origin.
        cell: width of a grid cell, m; rounded so that a block is a whole number of them.
        seed: of the whole country.
    """

    def __init__(self, low: tuple[int, int], high: tuple[int, int], cell: float, seed: int) -> None:
        self._low, self._high, self._seed = low, high, seed
        self._across = round(BLOCK / cell)
        self._numbers = np.random.default_rng([seed, 30]).uniform(-0.5, 0.5, SEQUENCE)
        self._numbers = self._numbers.astype(np.float32)
        self._layer = 0
        extent = Extent(*(BLOCK * place for place in (*low, *high)))
        super().__init__(extent, BLOCK / self._across, "country", seed)
        del self._mottle, self._wear, self._rough, self._lines  # as large as what is looked up

    def _paint(self, ground: Ground) -> None:
        self._wear = 0.22 * self._noise(14, 5) + 0.18 * self._noise(3, 3)
        self._rough = self._noise(1.5, 3)
        self._lines = 0.3 * self._noise(12, 2)
        self.colour = np.zeros((*self.shape, 3), np.float32)
        for row in range(self._low[1], self._high[1]):
            for column in range(self._low[0], self._high[0]):
                # No seed is negative.
                self._rng = np.random.default_rng([self._seed, 31, column % 2**32, row % 2**32])
                kind = self._rng.choice(KINDS, p=SHARES)
                place = BLOCK * (column + 0.5), BLOCK * (row + 0.5)
                getattr(self, f"_{kind}")(self._block(column, row), *place)
        self._streets()

    def _block(self, column: int, row: int) -> Patch:
        """Return the cells of a block."""
        top, left = (self._high[1] - 1 - row), (column - self._low[0])
        return (
            slice(top * self._across, (top + 1) * self._across),
            slice(left * self._across, (left + 1) * self._across),
        )

    # Kinds of blocks: `patch` its cells, (e, n) its middle

    def _gardens(self, patch: Patch, e: float, n: float) -> None:
        """Houses that each differ, lawns and trees."""
        self._grass(patch, 0.12)
        for a in np.arange(-32.0, 33.0, 21.0):
            for b in np.arange(-33.0, 34.0, 22.0):
                if self._rng.random() < 0.8:
                    da, db = self._rng.uniform(-2.5, 2.5, 2)
                    half_a, half_b = self._rng.uniform(4.5, 7.0), self._rng.uniform(3.4, 4.8)
                    turn = self._rng.normal(0, 0.15)
                    self._house(e + a + da, n + b + db, half_a, half_b, turn)
                for _ in range(int(self._rng.integers(1, 4))):
                    da, db = self._rng.uniform(-10, 10, 2)
                    radius = self._rng.uniform(0.9, 2.2)
                    self._tree(e + a + da, n + b + db, radius, self._rng.uniform(1.5, 4.0))

    def _terrace(self, patch: Patch, e: float, n: float) -> None:
        """Four rows of equal houses, the same in every such block but for a few trees."""
        self._grass(patch, 0.12)
        own, self._rng = self._rng, np.random.default_rng([self._seed, 32])
        state = self._rng.bit_generator.state
        for b in np.arange(-33.0, 34.0, 22.0):
            for a in np.arange(-36.0, 37.0, 9.0):
                self._rng.bit_generator.state = state
                self._house(e + a, n + b, 4.23, 5.07, 0.0)
        self._rng = own
        for a, b in self._rng.uniform(-42, 42, (14, 2)):
            self._tree(e + a, n + b, self._rng.uniform(0.8, 1.6), self._rng.uniform(1.5, 3.0))

    def _parking(self, patch: Patch, e: float, n: float) -> None:
        """Asphalt with rows of bays, two thirds of them taken."""
        a, b = self._local(patch, e, n, 0.0)
        self.colour[patch] = 0.42 * (1 + 0.5 * self._wear[patch])[..., None]
        bay = np.abs(b % 16.0 - 8.0) < 4.8
        line = bay & (np.abs(a % 2.6 - 1.3) > 1.2) & (np.abs(a) < 40) & (np.abs(b) < 40)
        self.colour[patch][line] = 0.82
        for b0 in np.arange(-40.0, 40.0, 16.0):
            for side in (5.6, 10.4):
                for a0 in np.arange(-39.0, 39.0, 2.6):
                    if self._rng.random() < 0.66:
                        de, dn = self._rng.normal(0, 0.12, 2)
                        self._box(
                            e + a0 + de, n + b0 + side + dn, 2.1, 0.88, math.pi / 2, 1.5,
                            CARS[self._rng.integers(len(CARS))],
                        )  # fmt: skip

    def _strips(self, patch: Patch, e: float, n: float) -> None:
        """Two to four strips of crops in rows."""
        _, b = self._local(patch, e, n, self._rng.choice([0.0, math.pi / 2]))
        cuts = np.sort(self._rng.uniform(-30, 30, int(self._rng.integers(1, 4))))
        strip = np.searchsorted(cuts, b.ravel()).reshape(b.shape)
        count = len(cuts) + 1
        crop = np.array(CROPS, np.float32)[self._rng.integers(len(CROPS), size=count)]
        period = self._rng.choice([0.9, 1.4, 2.2, 3.0], count).astype(np.float32)[strip]
        depth = self._rng.uniform(0.02, 0.11, count).astype(np.float32)[strip]
        row = b + self._lines[patch]
        shade = 1 + depth * np.sin(2 * np.pi * row / period) + self._wear[patch]
        tracks = np.abs(np.abs(row % 12.0 - 6.0) - 0.9) < 0.22
        shade[tracks] *= 0.86
        self.colour[patch] = crop[strip] * shade[..., None]

    def _orchard(self, patch: Patch, e: float, n: float) -> None:
        """Trees of one age in rows."""
        self._grass(patch, 0.2)
        radius = self._rng.uniform(1.4, 2.0)
        for b in np.arange(-39.0, 40.0, 6.5):
            for a in np.arange(-39.0, 40.0, 5.2):
                if self._rng.random() < 0.95:
                    de, dn = self._rng.normal(0, 0.2, 2)
                    size = radius * self._rng.uniform(0.85, 1.15)
                    self._tree(e + a + de, n + b + dn, size, 1.9 * size)

    def _pond(self, patch: Patch, e: float, n: float) -> None:
        """Water with next to no texture, trees on its bank."""
        self._grass(patch, 0.15)
        a, b = self._local(patch, e, n, 0.0)
        angle, phase = np.arctan2(b, a), self._rng.uniform(0, 6.28, 2)
        shore = 27 + 4 * np.sin(2 * angle + phase[0]) + 2 * np.sin(5 * angle + phase[1])
        distance = np.hypot(a, b)
        water, bank = distance < shore, (distance >= shore) & (distance < shore + 2.5)
        level = np.float32(self.ground[patch][water].min())
        # The ground slopes down to the water over ten metres.
        slope = np.clip((distance - shore) / 10, 0, 1)
        for grid in (self.ground, self.height):
            grid[patch] = level + slope * (grid[patch] - level)
        self.colour[patch][bank] = (0.55, 0.48, 0.36)
        self.colour[patch][water] = (0.16, 0.24, 0.27)
        for angle0 in self._rng.uniform(0, 6.28, 16):
            out = self._rng.uniform(36, 42)
            radius = self._rng.uniform(1.0, 2.4)
            tall = radius * self._rng.uniform(1.2, 1.8)
            self._tree(e + out * np.cos(angle0), n + out * np.sin(angle0), radius, tall)

    def _meadow(self, patch: Patch, e: float, n: float) -> None:
        """Grass and a few bushes."""
        self._grass(patch, 0.1)
        for a, b in self._rng.uniform(-42, 42, (int(self._rng.integers(4, 14)), 2)):
            self._tree(e + a, n + b, self._rng.uniform(0.5, 1.5), self._rng.uniform(0.5, 1.5))

    def _grass(self, patch: Patch, contrast: float) -> None:
        tone = self._rng.uniform((0.33, 0.38, 0.20), (0.42, 0.46, 0.26)).astype(np.float32)
        shade = 1 + self._wear[patch] + contrast * self._rough[patch]
        self.colour[patch] = tone * shade[..., None]

    def _streets(self) -> None:
        """Paint the roads along the borders of all blocks, over what reaches into them."""
        east, north = (
            np.abs((line + BLOCK / 2) % BLOCK - BLOCK / 2)
            for line in (self._east[0], self._north[:, 0])
        )
        to_road = np.minimum(east, north[:, None])
        verge, lane = to_road < ROAD / 2 + VERGE, to_road < ROAD / 2
        self.height[verge] = self.ground[verge]
        self.house[verge] = 0
        shade = 1 + self._wear + 0.3 * self._rough
        self.colour[verge] = np.array((0.36, 0.42, 0.22), np.float32) * shade[verge][:, None]
        self.colour[lane] = np.array((0.43, 0.43, 0.44), np.float32) * shade[lane][:, None]
        dashes = np.maximum(east, north[:, None]) % 6.0 < 3.0
        self.colour[(to_road < 0.12) & dashes & (self._rough > -0.3)] = (0.86, 0.86, 0.83)

    def _shine(self, sun: NDArray[np.floating]) -> None:
        """Light one colour after the other: a third of the memory."""
        for channel, (sky, direct) in enumerate(zip(SKYLIGHT, SUNLIGHT, strict=True)):
            lit = np.float32(sky) + np.float32(direct) * sun.astype(np.float32)
            self.colour[..., channel] = np.clip(self.colour[..., channel] * lit, 0, 1)

    # The same noise wherever a piece begins

    def _noise(self, wavelength: float, octaves: int) -> FloatImage:
        """Noise of mean 0 and about unit range whose knots stand at fixed places."""
        left, top = self._low[0] * self._across, -self._high[1] * self._across
        total = np.zeros(self.shape, np.float32)
        for octave in range(octaves):
            self._layer += 1
            spacing = max(round(wavelength / 2**octave / self.cell), 1)
            first = top // spacing - 2, left // spacing - 2
            size = tuple(side // spacing + 6 for side in self.shape)
            knots = self._knots(first, size)
            smooth = knots
            if spacing > 1:
                whole = size[1] * spacing, size[0] * spacing
                smooth = cv2.resize(knots, whole, interpolation=cv2.INTER_CUBIC)  # type: ignore[assignment]
            row, column = top - first[0] * spacing, left - first[1] * spacing
            cut = smooth[row : row + self.shape[0], column : column + self.shape[1]]
            total += np.float32(0.55**octave) * cut
        return total

    def _knots(self, first: tuple[int, int], size: tuple[int, ...]) -> NDArray[np.float32]:
        """Return the random numbers of the current layer at rows and columns from `first` on.

        Each row is a stretch of one long sequence, begun at a place of its own: cheap, and no
        area comes twice.
        """
        rows = np.arange(first[0], first[0] + size[0], dtype=np.int64).astype(np.uint64)
        mixed = rows * np.uint64(0x9E3779B97F4A7C15) + np.uint64(
            self._layer * 0x632BE59BD9B4E019 % 2**64
        )
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        begin = (mixed >> np.uint64(44)).astype(np.int32)
        columns = np.arange(first[1], first[1] + size[1], dtype=np.int32)
        return self._numbers[(begin[:, None] + columns) & (SEQUENCE - 1)]


def sheet_of(column: int, row: int, reach: float, cell: float, seed: int) -> Country:
    """Paint the sheet whose photos' centres lie over `SHEET` x `SHEET` blocks.

    Args:
        column, row: of the sheet, counted east and north of the origin.
        reach: how far beyond them the photos see, m.
    """
    margin = math.ceil((reach + 12.0) / BLOCK)  # a shadow is at most 10 m long
    low = SHEET * column - margin, SHEET * row - margin
    high = SHEET * (column + 1) + margin, SHEET * (row + 1) + margin
    return Country(low, high, cell, seed)
