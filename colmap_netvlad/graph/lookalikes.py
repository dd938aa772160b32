"""Look-alikes: verified pairs of two different places, found by what contradicts them.

Copies of a building, and rows of a plantation, give pairs with hundreds of verified matches and a
faultless geometry. What gives them away is the rest of the flight. For photos that look the same
way onto ground (a drone's nadir flight, also one with tilted photos that all look one way), the
matches of a pair tell how far apart, how turned and how high two photos were, up to one scale: a
similarity of the plane. All pairs together must agree on one plan:

- **cycles**: the plan is fitted to all pairs robustly; a pair that lies far beside the plan that
  the others agree on is contradicted by the cycles it closes.
- **GPS**: a pair whose matches say "12 m apart" where GPS says 85 m is contradicted, unless the
  plan shows that the position of one of its photos is what is wrong.

A look-alike betrays itself by what it lacks, too: around the copy lies other ground, where both
photos have matches with their true neighbours but none with each other (Zach, Irschara and
Bischof, "What can missing correspondences tell us about 3D structure and motion?", CVPR 2008).
Pairs that lack much count little in the fit, and only such pairs are contradicted by cycles.

Pairs that do not look the same way, or whose matches no similarity fits, say nothing of the plan.
Weak look-alikes are often such pairs: a few matches of each of several copies. Where other pairs,
or GPS, put both photos too far apart to have ground in common, such a pair is contradicted.
Flights of which many pairs are so (facades, orbits) have no plan, and nothing is said of them.

The two steps of the fit, turns and heights first and places then, each least squares repeated
with robust weights, follow motion averaging as in Chatterjee and Govindu, "Efficient and robust
large-scale rotation averaging" (ICCV 2013); that loops betray wrong pairs is Zach, Klopschitz and
Pollefeys, "Disambiguating visual relations using loop constraints" (CVPR 2010).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu

from colmap_netvlad.colmap.database import Database
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.runtime import progress

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

SAME_WAY = 15.0
"""Largest angle between the viewing directions of a pair that is judged, degrees."""

LOOSE = 0.05
"""Largest residual of the similarity of a pair that is judged, image widths (root mean square)."""

BESIDE = 0.35
"""A pair this far beside the plan is contradicted, image widths on the ground."""

APART = 1.5
"""Photos whose places on the ground are this far from each other have none of it in common, image
widths: the diagonal of a photo is 1.25 of them, 1.4 where it is a square."""

JUDGED = 0.8
"""Share of the verified pairs that must be judged, else the photos are no flight that looks one
way (facades, a street, an orbit) and nothing is contradicted."""

AGREE = 0.8
"""Share of the judged pairs, by their strength, that must agree closely with the plan (or GPS);
else it says nothing."""

CLOSELY = 0.3
"""Of the limit from which on a pair is contradicted: true pairs of a flight lie far within it."""

GPS_ERROR = 15.0
"""What GPS may be off between two photos, m."""

LACKING = 0.8
"""A pair that has matches in this share of the cells where it should have them is never
contradicted by cycles."""

MANY = 400
"""Verified matches from which on more do not make a pair count more."""

POSED = 100
"""Matches of a pair from which the angle between its views is found."""

IRLS = 30
"""Repetitions of the weighted least squares."""

CROWDED = 0.04
"""Share of the photo that a pair's matches cover, below which they crowd in one place."""


@dataclass(frozen=True, eq=False)
class Moves:
    """How the photos of each verified pair lie to each other on the ground.

    A place in photo i is the complex number u = ((x - w / 2) + (y - h / 2) i) / f; the photos of
    a pair show the same ground at u_j = r u_i + d.

    Attributes:
        names: N image names.
        edges: (E, 2) indices of images.
        inliers: (E) verified matches.
        turn: (E) r: turn and ratio of heights.
        shift: (E) d.
        misfit: (E) root mean square residual, image widths.
        tilt: (E) angle between the viewing directions, degrees; NaN where it is not known.
        cover: (E) share of the photo that the matches' hull covers, the smaller of both, 0..1.
        filled: (E) of the cells of a photo where the pair should have matches (the other photo
            sees them, and they have matches in other pairs), the share that has any, the smaller
            of both, 0..1; NaN where that is not known.
        widths: (N) image width over focal length.
    """

    names: tuple[str, ...]
    edges: NDArray[np.int64]
    inliers: NDArray[np.int64]
    turn: Complexes
    shift: Complexes
    misfit: Floats
    tilt: Floats
    cover: Floats
    filled: Floats
    widths: Floats

    @property
    def strength(self) -> Floats:
        """(E) how much a pair counts, 0..1: by its matches, and by what it lacks of them."""
        filled = np.nan_to_num(self.filled, nan=0.5)
        return np.asarray(np.sqrt(np.minimum(self.inliers, MANY) / MANY) * (filled + 0.02) ** 4)

    @property
    def judged(self) -> NDArray[np.bool_]:
        """(E) pairs that look the same way and that a similarity fits."""
        return np.asarray((self.misfit <= LOOSE) & (self.tilt <= SAME_WAY))


@dataclass(frozen=True)
class Lookalike:
    """A pair that something speaks against.

    Attributes:
        pair: image names.
        inliers: its verified matches.
        reason: a sentence with the numbers.
        contradicted: whether it is left out by `drop_contradicted`; else it is only shown.
        strength: how far beyond its limit it is; at least 1.
    """

    pair: Pair
    inliers: int
    reason: str
    contradicted: bool
    strength: float


def read_moves(database: Database) -> Moves:
    """Fit a similarity to the verified matches of every pair of a database."""
    images = database.images()
    index = {row.image_id: i for i, row in enumerate(images)}
    size = {row.camera_id: (row.width, row.height) for row in images}
    cameras = {
        camera_id: _camera(*size[camera_id], initial.model, initial.params)
        for camera_id, initial in database.cameras().items()
        if camera_id in size
    }
    keypoints = lru_cache(maxsize=1024)(database.keypoints)
    pairs = sorted(
        pair
        for pair, count in database.verified_matches().items()
        if count > CORRECT_MATCHES and pair[0] in index and pair[1] in index
    )
    found, cells = [], []
    with progress.step("Looking for look-alikes", len(pairs)) as bar:
        for a, b in pairs:
            one, two = (cameras[images[index[i]].camera_id] for i in (a, b))
            matches = database.inlier_matches(a, b)
            first, second = keypoints(a)[matches[:, 0]], keypoints(b)[matches[:, 1]]
            turn, shift, misfit = _similarity(_plane(first, one), _plane(second, two))
            some = slice(None, None, max(len(matches) // POSED, 1))
            tilt = _tilt(database, (a, b), one, two, first[some], second[some])
            cover = min(_cover(first, one), _cover(second, two))
            width = two.width / two.mean_focal_length()
            row = (index[a], index[b], len(matches), turn, shift, misfit / width, tilt, cover)
            found.append(row)
            cells.append((_cells(first, one), _cells(second, two)))
            bar.advance()
    columns = list(zip(*found, strict=True)) or [()] * 8
    by_image = [cameras.get(row.camera_id) for row in images]
    moves = Moves(
        names=tuple(row.name for row in images),
        edges=np.array(columns[:2], np.int64).T.reshape(-1, 2),
        inliers=np.array(columns[2], np.int64),
        turn=np.array(columns[3], np.complex128),
        shift=np.array(columns[4], np.complex128),
        misfit=np.array(columns[5], np.float64),
        tilt=np.array(columns[6], np.float64),
        cover=np.array(columns[7], np.float64),
        filled=np.full(len(found), np.nan),
        widths=np.array(
            [np.nan if c is None else c.width / c.mean_focal_length() for c in by_image]
        ),
    )
    return replace(moves, filled=_filled(moves, np.array(cells), by_image))


GRID = (12, 9)
"""Columns and rows of cells in which a photo's matches are counted."""


def _cells(pixels: NDArray[np.float32], camera: pycolmap.Camera) -> NDArray[np.uint8]:
    """Return (rows * columns) which cells of a photo hold matches."""
    columns, rows = GRID
    column = np.clip((pixels[:, 0] / camera.width * columns).astype(int), 0, columns - 1)
    row = np.clip((pixels[:, 1] / camera.height * rows).astype(int), 0, rows - 1)
    held = np.zeros(columns * rows, np.uint8)
    held[row * columns + column] = 1
    return held


def _filled(
    moves: Moves, cells: NDArray[np.uint8], cameras: Sequence[pycolmap.Camera | None]
) -> Floats:
    """Return (E) what `Moves.filled` is; `cells` are (E, 2, cells)."""
    matched = np.zeros((len(moves.names), GRID[0] * GRID[1]), np.int64)
    for side in (0, 1):
        np.add.at(matched, moves.edges[:, side], cells[:, side] if len(cells) else 0)
    filled = np.full(len(moves.edges), np.nan)
    for e, (i, j) in enumerate(moves.edges.tolist()):
        turn, shift = complex(moves.turn[e]), complex(moves.shift[e])
        one, two = cameras[i], cameras[j]
        if one is None or two is None or not np.isfinite(turn) or turn == 0:
            continue
        shares = []
        for own, other, (r, d), side, image in (
            (one, two, (turn, shift), 0, i),
            (two, one, (1 / turn, -shift / turn), 1, j),
        ):
            seen = _inside(r * _cell_middles(own) + d, other)
            # A cell counts where another pair than this one has matches too.
            wanted = seen & (matched[image] - cells[e, side] >= 1)
            if wanted.sum() >= LEAST_CELLS:
                shares.append(float(cells[e, side][wanted].mean()))
        if shares:
            filled[e] = min(shares)
    return filled


LEAST_CELLS = 4
"""Cells that must be wanted of a pair for a share to mean something."""


def _cell_middles(camera: pycolmap.Camera) -> Complexes:
    columns, rows = GRID
    x = (np.arange(columns) + 0.5) * camera.width / columns
    y = (np.arange(rows) + 0.5) * camera.height / rows
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return _plane(pixels, camera)


def _inside(places: Complexes, camera: pycolmap.Camera) -> NDArray[np.bool_]:
    focal = camera.mean_focal_length()
    across, down = np.abs(places.real) * focal, np.abs(places.imag) * focal
    return np.asarray((across < 0.45 * camera.width) & (down < 0.45 * camera.height))


def _camera(width: int, height: int, model: int, params: Sequence[float]) -> pycolmap.Camera:
    return pycolmap.Camera(
        model=pycolmap.CameraModelId(model), width=width, height=height, params=list(params)
    )


def _plane(pixels: NDArray[np.floating], camera: pycolmap.Camera) -> Complexes:
    x, y = pixels.T.astype(np.float64)
    return np.asarray(
        ((x - camera.width / 2) + 1j * (y - camera.height / 2)) / camera.mean_focal_length()
    )


def _similarity(u: Complexes, v: Complexes) -> tuple[complex, complex, float]:
    """Return r and d of v = r u + d and the root mean square residual, by weighted least squares
    that forgets what lies far beside (parallax of houses, wrong matches)."""
    weight = np.ones(len(u))
    for _ in range(4):
        total = weight.sum()
        mean_u, mean_v = (weight * u).sum() / total, (weight * v).sum() / total
        spread = (weight * np.abs(u - mean_u) ** 2).sum()
        if spread <= 0:
            return complex("nan"), complex("nan"), np.inf
        turn = (weight * np.conj(u - mean_u) * (v - mean_v)).sum() / spread
        shift = mean_v - turn * mean_u
        residual = np.abs(v - turn * u - shift)
        scale = max(2 * float(np.median(residual)), 1e-6)
        weight = 1 / (1 + (residual / scale) ** 2)
    misfit = np.sqrt((weight * residual**2).sum() / weight.sum())
    return complex(turn), complex(shift), float(misfit)


def _tilt(
    database: Database,
    pair: tuple[int, int],
    one: pycolmap.Camera,
    two: pycolmap.Camera,
    first: NDArray[np.float32],
    second: NDArray[np.float32],
) -> float:
    """Return the angle between the viewing directions of a pair, degrees; NaN where unknown."""
    kept = database.geometry(*pair)
    if kept is None:
        return np.nan
    geometry = pycolmap.TwoViewGeometry()
    for name in ("F", "E", "H"):
        if getattr(kept, name) is not None:
            setattr(geometry, name, getattr(kept, name))
    count = np.arange(len(first), dtype=np.uint32)
    geometry.inlier_matches = np.column_stack([count, count])
    try:
        geometry.config = pycolmap.TwoViewGeometryConfiguration(kept.config)
        known = pycolmap.estimate_two_view_geometry_pose(
            one, first.astype(np.float64), two, second.astype(np.float64), geometry
        )
    except (ValueError, RuntimeError):  # no such kind, or no matrix that it needs
        return np.nan
    if not known or geometry.cam2_from_cam1 is None:
        return np.nan
    facing = geometry.cam2_from_cam1.rotation.matrix()[2, 2]
    return float(np.degrees(np.arccos(np.clip(facing, -1, 1))))


def _cover(pixels: NDArray[np.float32], camera: pycolmap.Camera) -> float:
    hull = cv2.convexHull(np.ascontiguousarray(pixels, np.float32))
    return float(cv2.contourArea(hull)) / max(camera.width * camera.height, 1)


# What speaks against a pair


def find_lookalikes(
    database: Database,
    positions: Mapping[str, NDArray[np.float64]] | None = None,
    moves: Moves | None = None,
) -> list[Lookalike]:
    """Return the verified pairs that something speaks against, the strongest case first.

    Args:
        positions: known positions by image name: east, north, up, m. Where both photos of a pair
            have one that fits the plan, GPS decides alone, as it does not drift.
        moves: of the database's pairs, where they were read before (`read_moves`).
    """
    return judge_moves(moves or read_moves(database), positions or {})


def judge_moves(moves: Moves, positions: Mapping[str, NDArray[np.float64]]) -> list[Lookalike]:
    """Return the pairs that something speaks against (see `find_lookalikes`)."""
    plan = fit_plan(moves)
    by_gps = _against_gps(moves, plan, positions)
    trusted = _agreed(moves, plan.beside / BESIDE)
    beside = plan.beside if trusted else np.full(len(moves.edges), np.nan)
    apart = _apart(moves, plan, by_gps) if trusted else beside
    found = []
    for e, (i, j) in enumerate(moves.edges.tolist()):
        pair, inliers = as_pair(moves.names[i], moves.names[j]), int(moves.inliers[e])
        over, reason = 0.0, ""
        if np.isfinite(by_gps.limit[e]):
            over = by_gps.error[e] / by_gps.limit[e]
            reason = (
                f"Its matches put the photos {by_gps.matched[e]:,.0f} m apart, GPS "
                f"{by_gps.known[e]:,.0f} m."
            )
        elif beside[e] > BESIDE and moves.filled[e] < LACKING:
            over = beside[e] / BESIDE
            reason = (
                f"It lies {beside[e]:.1f} photo widths beside the plan that the pairs around "
                f"it agree on, and lacks matches in {100 * (1 - moves.filled[e]):.0f} % of what "
                "both photos would see."
            )
        elif apart[e] > APART and moves.filled[e] < LACKING:
            over = apart[e] / APART
            reason = (
                f"Its matches fit no shift, and what is known of its photos puts them "
                f"{apart[e]:.1f} photo widths apart: they have no ground in common."
            )
        if over > 1:
            found.append(Lookalike(pair, inliers, reason, True, float(over)))
        elif moves.cover[e] < CROWDED and not moves.filled[e] >= LACKING:
            reason = f"Its matches crowd on {100 * moves.cover[e]:.1f} % of the photo."
            found.append(
                Lookalike(pair, inliers, reason, False, CROWDED / max(moves.cover[e], 1e-6))
            )
    found.sort(key=lambda one: (not one.contradicted, -one.strength, one.pair))
    return found


@dataclass(frozen=True, eq=False)
class _Distances:
    """How far apart matches and GPS put the photos of each pair, m; NaN where it is not judged.

    Attributes:
        matched, known: by its matches, by GPS.
        limit: of their difference.
        metre: metres of one unit of the plan; NaN where GPS says nothing.
    """

    matched: Floats
    known: Floats
    limit: Floats
    metre: float

    @property
    def error(self) -> Floats:
        return np.asarray(np.abs(self.matched - self.known))


def _against_gps(
    moves: Moves, plan: Plan, positions: Mapping[str, NDArray[np.float64]]
) -> _Distances:
    """Compare distances; where most do not agree (not a plan, or wrong GPS) none is judged."""
    nothing = np.full(len(moves.edges), np.nan)
    nowhere = np.full(3, np.nan)
    metres = np.array([positions.get(name, nowhere) for name in moves.names]).reshape(-1, 3)
    i, j = moves.edges.T
    known = np.linalg.norm((metres[i] - metres[j])[:, :2], axis=1)
    size = np.abs(plan.turns[j])
    moved = size * np.abs(moves.shift)
    usable = moves.judged & np.isfinite(known) & np.isfinite(moved)
    far = usable & (np.abs(moves.shift) > 0.1 * moves.widths[j])
    if far.sum() < 3:
        return _Distances(nothing, nothing, nothing, np.nan)
    metre = float(np.median(known[far] / moved[far]))
    matched = metre * moved
    limit = np.maximum(GPS_ERROR, BESIDE * metre * size * moves.widths[j])
    limit = np.where(usable, limit, np.nan)
    over = np.abs(matched - known) / limit
    if not _agreed(moves, over):
        return _Distances(nothing, nothing, nothing, np.nan)
    wild = _wild_positions(moves, plan, over)
    said = np.where(wild[i] | wild[j], np.nan, 1.0)
    return _Distances(matched, known * said, limit * said, metre)


def _apart(moves: Moves, plan: Plan, by_gps: _Distances) -> Floats:
    """Return (E) how far apart the photos of pairs are that are not judged, image widths.

    It is NaN where neither GPS nor the plan says it: where no pairs that lie close to the plan and
    lack nothing join both photos.
    """
    i, j = moves.edges.T
    sound = moves.judged & (plan.beside <= BESIDE) & (moves.filled >= LACKING)
    count = len(moves.names)
    ends = tuple(moves.edges[sound].T.astype(np.int32))
    joined = sparse.coo_array((np.ones(sound.sum()), ends), shape=(count, count))
    _, part = connected_components(joined, directed=False)
    width = np.maximum(*(np.abs(plan.turns[k]) * moves.widths[k] for k in (i, j)))
    on_plan = np.where(part[i] == part[j], np.abs(plan.places[i] - plan.places[j]) / width, np.nan)
    on_gps = by_gps.known / by_gps.metre / width
    return np.where(moves.judged, np.nan, np.where(np.isfinite(on_gps), on_gps, on_plan))


def _wild_positions(moves: Moves, plan: Plan, over: Floats) -> NDArray[np.bool_]:
    """Return (N) which photos have a wrong position rather than wrong pairs.

    More of their pairs that fit the plan are contradicted by GPS than not.

    Args:
        over: (E) difference of the distances over its limit; NaN where it is not judged.
    """
    fitting = np.isfinite(over) & (plan.beside <= BESIDE)
    count = len(moves.names)
    against, for_it = (
        np.bincount(moves.edges[fitting & side].ravel(), minlength=count)
        for side in (over > 1, over <= 1)
    )
    return np.asarray(against > for_it)


def _agreed(moves: Moves, over: Floats) -> bool:
    """Whether most pairs are judged, and most of these lie closely to what is to judge the rest.

    Args:
        over: (E) distance over its limit; NaN where a pair is not judged.
    """
    judged = np.isfinite(over)
    if not judged.any() or moves.judged.mean() < JUDGED:
        return False
    strength = moves.strength[judged]
    return float(strength[over[judged] <= CLOSELY].sum()) >= AGREE * float(strength.sum())


# The plan all pairs agree on


@dataclass(frozen=True, eq=False)
class Plan:
    """Where photos lie on the ground: a place u of photo i is at `turns[i] * u + places[i]`.

    Attributes:
        turns: (N) turn and height, of arbitrary unit; NaN outside the judged pairs.
        places: (N) centre of a photo on the ground, same unit.
        beside: (E) how far a pair lies beside the plan, image widths; NaN where it is not judged.
    """

    turns: Complexes
    places: Complexes
    beside: Floats


def fit_plan(moves: Moves) -> Plan:
    """Fit the plan that most judged pairs agree on; components are apart from each other."""
    judged = moves.judged
    edges, count = moves.edges[judged], len(moves.names)
    strength = moves.strength[judged]
    # With p = a_i u_i + b_i = a_j u_j + b_j on the ground: a_i = a_j r and b_j - b_i = -a_j d.
    angle, height = -np.angle(moves.turn[judged]), -np.log(np.abs(moves.turn[judged]))

    def angles_left(x: Floats) -> Floats:
        return np.asarray(np.angle(np.exp(1j * (angle - _steps(x, edges)))))

    start = _along_tree(edges, strength, angle, count)
    angles = _agree(edges, strength, angles_left, start, 0.1)
    heights = _agree(edges, strength, lambda x: height - _steps(x, edges), np.zeros(count), 0.1)
    turns = np.exp(heights + 1j * angles)
    last = edges[:, 1]
    wanted, size = -turns[last] * moves.shift[judged], np.abs(turns[last]) * moves.widths[last]

    def places_left(x: Complexes) -> Complexes:
        return np.asarray((wanted - _steps(x, edges)) / size)

    start = np.zeros(count, np.complex128)
    places = _agree(edges, strength, places_left, start, BESIDE / 2, size)
    beside = np.full(len(moves.edges), np.nan)
    beside[judged] = np.abs(places_left(places))
    return Plan(turns, places, beside)


def _steps(x: NDArray, edges: NDArray[np.int64]) -> NDArray:
    return np.asarray(x[edges[:, 1]] - x[edges[:, 0]])


def _agree(
    edges: NDArray[np.int64],
    strength: Floats,
    left: Callable[[NDArray], NDArray],
    start: NDArray,
    near: float,
    size: Floats | float = 1.0,
) -> NDArray:
    """Return (N) values whose differences along the edges agree with what most edges say.

    Least absolute values first, which a minority of wrong edges cannot bend, then Geman and
    McClure's weights, which forget them.

    Args:
        left: residual of each edge at given values, over `size`.
        near: residual at which an edge counts half.
    """
    x = start.copy()
    count = len(x)
    i, j = edges.T
    for iteration in range(IRLS):
        residual = left(x)
        away = np.abs(residual)
        robust = (
            1 / np.maximum(away, 0.1 * near)
            if iteration < IRLS // 2
            else (near**2 / (near**2 + away**2)) ** 2
        )
        weight = strength * robust / size**2
        pull = np.asarray(weight * residual * size)
        off = sparse.coo_array((-weight, (i, j)), shape=(count, count))
        diagonal = np.bincount(i, weight, count) + np.bincount(j, weight, count)
        ridge = 1e-9 * max(float(diagonal.max(initial=0)), 1e-12)
        laplace = (off + off.T + sparse.diags_array(diagonal + ridge)).tocsc()
        right = np.zeros(count, pull.dtype)
        np.add.at(right, j, pull)
        np.subtract.at(right, i, pull)
        solved = splu(laplace).solve(np.column_stack([right.real, right.imag]))
        x = x + (solved[:, 0] + 1j * solved[:, 1] if np.iscomplexobj(x) else solved[:, 0])
    return x


def _along_tree(edges: NDArray[np.int64], strength: Floats, step: Floats, count: int) -> Floats:
    """Return (N) values that add up the steps along the strongest tree of each component."""
    x = np.zeros(count)
    if not len(edges):
        return x
    i, j = edges.T.astype(np.int32)  # csgraph's trees take no wider indices in scipy 1.12
    graph = sparse.coo_array((1 / strength, (i, j)), shape=(count, count)).tocsr()
    tree = minimum_spanning_tree(graph)
    steps = {(a, b): s for (a, b), s in zip(edges.tolist(), step.tolist(), strict=True)}
    _, label = connected_components(tree, directed=False)
    for root in np.unique(label, return_index=True)[1].tolist():
        order, before = breadth_first_order(tree, root, directed=False)
        for node in order[1:].tolist():
            parent = int(before[node])
            x[node] = x[parent] + (
                steps[parent, node] if (parent, node) in steps else -steps[node, parent]
            )
    return x
