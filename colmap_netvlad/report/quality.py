"""The figures of one flight's report, and the verdict on them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.colmap.database import InitialCamera, open_database
from colmap_netvlad.graph.lookalikes import Lookalike, Moves, find_lookalikes
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.graph.viewgraph import (
    MIN_INLIERS,
    GraphStatistics,
    ViewGraph,
    edge_weights,
    weigh_database,
)
from colmap_netvlad.photos.shutters import RollingShutter, find_rolling_shutters
from colmap_netvlad.report.cameras import CameraReport, camera_reports
from colmap_netvlad.report.contradictions import with_model
from colmap_netvlad.report.ground import (
    ENOUGH,
    Frame,
    Overlap,
    fit_frame,
    footprints,
    ground_sample_distances,
    overlap_map,
)
from colmap_netvlad.report.missing import MissingPhoto, missing_photos
from colmap_netvlad.report.modeldata import ModelData, read_model_data

Floats = NDArray[np.float64]
Level = Literal["green", "yellow", "red", "unknown"]

ORDER: tuple[Level, ...] = ("red", "yellow", "green", "unknown")
"""Worst first; what is not known does not count."""

NOT_KNOWN = "not known"

DOWNWARD = 0.5
"""Least cosine between the median view and straight down for which footprints mean something."""


@dataclass(frozen=True)
class Run:
    """How a model came about, so that it can be made again.

    Attributes:
        command: the command line, or a name of what made it.
        seconds: duration by stage, s.
        options: option name -> value as text.
        versions: of the programs.
        dropped: contradicted pairs that were left out before mapping.
        source: fingerprint of what it was mapped from; empty where that is not known.
    """

    command: str
    seconds: Mapping[str, float] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    dropped: int = 0
    source: str = ""


@dataclass(frozen=True)
class GroundPoint:
    """How a surveyed point lies in the model.

    Attributes:
        name: of the list of ground points.
        check: it was not used for placing the model, only measured.
        residual: computed minus surveyed: east, north, up, m; None where it could not be told.
        pixels: mean reprojection error of its marks, px.
    """

    name: str
    check: bool
    residual: Sequence[float | None]
    pixels: float | None

    @property
    def figures(self) -> list[float | None]:
        """East, north, up, m, and px: a row of the page."""
        return [*self.residual, self.pixels]


@dataclass(frozen=True, eq=False)
class Source:
    """What a report is made from. What is None is not there, and the page says so.

    Attributes:
        name: of the project, for the title.
        model: the sparse model.
        folder: where it lies.
        database: the COLMAP database it was made from.
        images: the photo folder.
        positions: known positions by image name: east, north, up, m.
        elsewhere: images by the other models of the same run that have them.
        run: how the model was made.
        ground: surveyed points, where the model was placed or measured by some.
        moves: of the database's pairs, where they were read before the model was made.
    """

    name: str
    model: pycolmap.Reconstruction
    folder: Path
    database: Path | None = None
    images: Path | None = None
    positions: Mapping[str, Floats] = field(default_factory=dict)
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    run: Run | None = None
    ground: Sequence[GroundPoint] = ()
    moves: Moves | None = None

    @property
    def dropped(self) -> bool:
        """Whether contradicted pairs were left out before mapping."""
        return self.run is not None and self.run.dropped > 0


@dataclass(frozen=True)
class Check:
    """One line of the verdict.

    Attributes:
        title: what is judged.
        value: the figure, as text.
        level: how good it is; "unknown" where it could not be told.
        reason: what it means, and what to do where it is not green.
    """

    title: str
    value: str
    level: Level
    reason: str


@dataclass(frozen=True, eq=False)
class Quality:
    """Everything the page of a flight shows.

    Attributes:
        source: what it was made from.
        data: the model as arrays.
        frame: model -> page.
        pixel: (N) ground sample distance of each registered image, page units a pixel.
        corners: (N, 4, 2) footprints, page units.
        overlap: photos a ground cell, or None where footprints mean nothing.
        cameras: each camera that took a registered image.
        shutters: rolling shutters among them.
        graph: the view graph: of verified matches where there is a database, else of common
            points.
        verified: whether it is of verified matches.
        links: how well its part of registered images holds together, by the pairs that were mapped.
        lookalikes: verified pairs that something speaks against, the strongest case first.
        missing: photos of the database without a pose; None without a database.
        not_shown: what the page cannot show and why, sentences.
    """

    source: Source
    data: ModelData
    frame: Frame
    pixel: Floats
    corners: Floats
    overlap: Overlap | None
    cameras: Sequence[CameraReport]
    shutters: Sequence[RollingShutter]
    graph: ViewGraph
    verified: bool
    links: GraphStatistics
    lookalikes: Sequence[Lookalike]
    missing: Sequence[MissingPhoto] | None
    not_shown: Sequence[str]

    @property
    def images(self) -> int:
        """Photos in the database, or in the model where there is no database."""
        return len(self.data.names) + len(self.missing or ())

    @property
    def errors_against_gps(self) -> tuple[float, float] | None:
        """Root mean square residual against GPS, horizontally and in height, m, without the
        positions put aside; None where there are none."""
        kept = np.isfinite(self.frame.residuals).all(axis=1) & ~self.frame.outliers
        residuals = self.frame.residuals[kept]
        if not len(residuals):
            return None
        squared = (residuals**2).mean(axis=0)
        return math.sqrt(squared[0] + squared[1]), math.sqrt(squared[2])


def measure(source: Source) -> Quality:
    """Compute a report's figures.

    Raises:
        InputError: the database cannot be read.
    """
    model, not_shown = source.model, []
    data = read_model_data(model)
    nowhere = np.full(3, np.nan)
    positions = np.array([source.positions.get(name, nowhere) for name in data.names])
    frame = fit_frame(data, positions.reshape(-1, 3))
    pixel = ground_sample_distances(data, model, frame)
    corners = footprints(data, model, frame)
    overlap = overlap_map(corners, frame.move(data.centres))
    initial: Mapping[int, InitialCamera] = {}
    missing: list[MissingPhoto] | None = None
    lookalikes: list[Lookalike] = []
    if source.database is None:
        not_shown.append(
            "There is no database: which photos are missing and why, matches, and the cameras "
            "before adjustment are not known."
        )
        graph = common_points_graph(data)
    else:
        with open_database(source.database) as database:
            initial = database.cameras()
            graph = weigh_database(database)
            points_of = _points_of_keypoints(model)
            missing = missing_photos(database, set(data.names), points_of, source.elsewhere)
            found = find_lookalikes(database, source.positions, source.moves)
            lookalikes = with_model(found, database, data, frame, points_of)
    if not len(data.points):
        not_shown.append("The model has no points: ground, overlap and errors are not known.")
    elif overlap is not None and not _looks_down(data, frame):
        overlap = None
        not_shown.append(
            "Most cameras look along the ground, not down on it: footprints and overlap are not "
            "shown."
        )
    if not frame.metric:
        not_shown.append(_why_not_metric(int(np.isfinite(positions).all(axis=-1).sum())))
    if source.images is None:
        not_shown.append("There is no photo folder: photos are not shown.")
    cameras = camera_reports(model, data, frame, initial) if len(data.names) else []
    shutters = find_rolling_shutters(source.images, data.names) if source.images else []
    left_out = {one.pair for one in lookalikes if one.contradicted and source.dropped}
    links = within(graph, set(data.names), left_out).statistics()
    return Quality(
        source, data, frame, pixel, corners, overlap, cameras, shutters, graph,
        source.database is not None, links, lookalikes, missing, not_shown,
    )  # fmt: skip


def _why_not_metric(known: int) -> str:
    without = "so area, ground sample distance and residuals in metres are not known."
    if known < 3:
        return f"GPS: {known or 'no'} registered photo{_s(known)} with a position, {without}"
    return f"GPS: the {known} positions known lie on one line or in one place, {without}"


def common_points_graph(data: ModelData) -> ViewGraph:
    """Return the view graph of a model alone: images that see `MIN_INLIERS` common points."""
    images = np.repeat(np.arange(len(data.names)), np.diff(data.starts))
    shape = (len(data.names), len(data.points))
    seen = sparse.csr_array(
        (np.ones(len(images), np.int32), (images, data.seen_points)), shape=shape
    )
    seen.data[:] = 1
    common = sparse.triu(seen @ seen.T, k=1).tocoo()
    enough = common.data >= MIN_INLIERS
    edges = np.column_stack([common.row[enough], common.col[enough]]).astype(np.int32)
    inliers = common.data[enough].astype(np.int64)
    order = np.lexsort(edges.T[::-1])
    edges, inliers = edges[order], inliers[order]
    nothing = np.zeros((len(edges), 2))
    return ViewGraph(data.names, edges, inliers, *edge_weights(inliers, nothing, nothing, 1.0))


def _points_of_keypoints(
    model: pycolmap.Reconstruction,
) -> Callable[[str], NDArray[np.int64]]:
    by_name = {model.image(i).name: i for i in model.reg_image_ids()}

    @cache
    def points_of(name: str) -> NDArray[np.int64]:
        image = model.image(by_name[name])
        points = np.full(image.num_points2D(), -1, np.int64)
        for index in image.get_observation_point2D_idxs():
            points[index] = image.point2D(index).point3D_id
        return points

    return points_of


def _looks_down(data: ModelData, frame: Frame) -> bool:
    views = frame.turned(data.rotations[:, 2])
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    return bool(np.median(-views[:, 2]) >= DOWNWARD)


# The verdict


def judge(quality: Quality) -> list[Check]:
    """Return the verdict's lines: each figure, how good it is, and why."""
    return [
        check
        for check in (
            _registered(quality),
            _one_model(quality),
            _overlap(quality),
            _reprojection(quality),
            _points(quality),
            _links(quality),
            _lookalikes(quality),
            _gps(quality),
            _cameras(quality),
        )
        if check is not None
    ]


def overall(checks: Sequence[Check]) -> Level:
    """Return the worst level of the checks."""
    return min((check.level for check in checks), key=ORDER.index, default="unknown")


def _level(value: float, green: float, yellow: float) -> Level:
    """Grade a value: at least (or, where green < yellow, at most) these."""
    if not math.isfinite(value):
        return "unknown"
    if green > yellow:
        return "green" if value >= green else "yellow" if value >= yellow else "red"
    return "green" if value <= green else "yellow" if value <= yellow else "red"


def _registered(quality: Quality) -> Check:
    title, registered = "Photos registered", len(quality.data.names)
    if quality.missing is None:
        reason = "Without a database it is not known how many photos there were."
        return Check(title, f"{registered:,}", "unknown", reason)
    share = registered / max(quality.images, 1)
    value = f"{registered:,} of {quality.images:,} ({percent(share)})"
    if not quality.missing:
        return Check(title, value, "green", "Every photo has its place.")
    counts = Counter(photo.reason for photo in quality.missing).most_common()
    listed = "; ".join(f"{count:,} {reason}" for reason, count in counts)
    return Check(title, value, _level(share, 0.98, 0.9), f"Missing: {listed}.")


def _one_model(quality: Quality) -> Check | None:
    others = Counter(quality.source.elsewhere.values())
    if not others:
        return None
    listed = ", ".join(f"{count:,} in {name}" for name, count in sorted(others.items()))
    return Check(
        "Models", f"{len(others) + 1}", "yellow",
        f"The flight fell apart: photos also {listed}. Pairs between the parts are missing "
        "(a larger `k`, or `rounds`).",
    )  # fmt: skip


def _overlap(quality: Quality) -> Check:
    title = f"Ground seen by {ENOUGH} photos or more"
    if quality.overlap is None or not quality.overlap.inside.any():
        return Check(title, "–", "unknown", "Not known: see what this page cannot show.")
    share = quality.overlap.share(ENOUGH)
    level = _level(share, 0.95, 0.8)
    reason = "Measured between the cameras; the edge of a flight is always seen by fewer."
    if level != "green":
        reason += " Fly with more overlap where the map is red or orange."
    return Check(title, percent(share), level, reason)


def _reprojection(quality: Quality) -> Check:
    error = quality.data.mean_error
    level = _level(error, 1.0, 1.5)
    reason = "Distance between keypoints and projected points, mean of all points."
    if level in ("yellow", "red"):
        reason += " Blur, a rolling shutter, or a camera model that does not fit the lens."
    return Check("Reprojection error", number(error, "px", 2), level, reason)


def _points(quality: Quality) -> Check:
    seen = quality.data.observations
    median = float(np.median(seen)) if len(seen) else math.nan
    level = _level(median, 300, 100)
    poor = int((seen < 100).sum())
    reason = f"Median of all photos; {poor:,} photo{_s(poor)} see{'' if poor != 1 else 's'} "
    reason += "fewer than 100 and may be off their place." if poor else "fewer than 100."
    value = f"{median:,.0f}" if math.isfinite(median) else "–"
    return Check("Points a photo sees", value, level, reason)


def _links(quality: Quality) -> Check:
    title = "Weak links"
    images, bridges = quality.links.articulation_images, quality.links.bridges
    if (parts := len(quality.links.component_sizes)) > 1:
        return Check(
            title, f"{parts:,} parts", "yellow",
            "No verified pair joins these parts of the model: the database's matches are not those "
            "that it was made from, or it hangs together by points alone.",
        )  # fmt: skip
    if not images and not bridges:
        return Check(title, "none", "green", "No single photo or pair holds the model together.")
    value = f"{len(images):,} photo{_s(len(images))}, {len(bridges):,} pair{_s(len(bridges))}"
    return Check(
        title, value, "yellow",
        "There the model hangs on one photo or one pair, and may be bent; see the view graph.",
    )  # fmt: skip


def _lookalikes(quality: Quality) -> Check | None:
    if not quality.verified:
        return None
    title, found = "Look-alikes", [one for one in quality.lookalikes if one.contradicted]
    if not found:
        reason = "No verified pair contradicts the others."
        if doubtful := len(quality.lookalikes):
            value = f"none contradicted, {doubtful:,} doubtful"
            return Check(title, value, "green", f"{reason} Those in doubt are shown below.")
        return Check(title, "none found", "green", reason)
    value = f"{len(found):,} pair{_s(len(found))}"
    if quality.source.dropped:
        reason = "They were left out before mapping; what they look like is shown below."
        return Check(title, value, "green", reason)
    return Check(
        title, value, "yellow",
        "Verified pairs of what are probably different places; they can fold a model. Look at them "
        "below; `reconstruct` leaves them out unless it is told to keep them.",
    )  # fmt: skip


def _gps(quality: Quality) -> Check:
    title, found = "Against GPS", quality.errors_against_gps
    if found is None:
        return Check(title, "–", "unknown", "Not enough GPS positions to compare with.")
    across, height = found
    aside = int(quality.frame.outliers.sum())
    level = _level(across, 5, 15)
    reason = "Root mean square; GPS without corrections is good to 2 to 5 m."
    if level != "green":
        reason += " Larger residuals: wrong positions, or a model that is bent or folded."
    if aside:
        level = "yellow" if level == "green" else level
        reason += (
            f" {aside:,} photo{_s(aside)} left out of this figure, far from the GPS position: "
            "a wrong position, or a photo in a wrong place."
        )
    value = f"{across:.2f} m across, {height:.2f} m in height"
    return Check(title, value, level, reason)


def _cameras(quality: Quality) -> Check | None:
    if not quality.cameras:
        return None
    warned = [camera for camera in quality.cameras if camera.warnings]
    count = len(quality.cameras)
    value = f"{count:,} camera{_s(count)}"
    if not warned:
        return Check("Camera parameters", value, "green", "Well determined by the photos.")
    first = warned[0].warnings[0]
    of = f"Camera {warned[0].camera_id}: " if count > 1 else ""
    return Check("Camera parameters", value, "yellow", f"{of}{first}")


def within(graph: ViewGraph, inside: Collection[str], left_out: Collection[Pair]) -> ViewGraph:
    """Return the part of a view graph that lies within some of its images, without some pairs."""
    kept = np.array([name in inside for name in graph.names], bool)
    place = np.cumsum(kept) - 1
    both = np.array(
        [
            bool(kept[i] and kept[j]) and as_pair(graph.names[i], graph.names[j]) not in left_out
            for i, j in graph.edges.tolist()
        ],
        bool,
    )
    return ViewGraph(
        tuple(name for name in graph.names if name in inside),
        place[graph.edges[both]].astype(np.int32).reshape(-1, 2),
        graph.inliers[both],
        graph.weight_inlier[both],
        graph.weight_overlap[both],
        graph.weights[both],
    )


def verdict_lines(quality: Quality, checks: Sequence[Check], page: Path) -> list[str]:
    """Return the verdict in five lines for the terminal, the last with the page's path."""
    worst = overall(checks)
    marked = [check for check in checks if check.level == worst]
    why = (
        "" if worst in ("green", "unknown") else f" ({', '.join(c.title.lower() for c in marked)})"
    )
    by_title = {check.title: check for check in checks}
    registered = by_title["Photos registered"]
    model = quality.data
    ground = [text for text in (area(quality), pixel_size(quality)) if text != NOT_KNOWN]
    aside = int(quality.frame.outliers.sum())
    left_out = (
        f", {aside:,} photo{_s(aside)} far from {'its' if aside == 1 else 'their'} GPS left out"
    )
    if quality.overlap is not None:
        share = by_title[f"Ground seen by {ENOUGH} photos or more"].value
        ground.append(f"{share} of it seen by {ENOUGH} photos or more")
    gps = quality.errors_against_gps
    return [
        f"Verdict: {worst.upper()}{why}. Photos registered: {registered.value}. "
        f"{'' if registered.level == 'green' else registered.reason}".rstrip(),
        f"Ground between the cameras: {', '.join(ground) or NOT_KNOWN}.",
        f"Model: {len(model.points):,} points, seen by {number(model.mean_track_length, '', 2)} "
        f"photos each; reprojection error {number(model.mean_error, 'px', 2)}.",
        "GPS: no positions to compare with."
        if gps is None
        else f"GPS: {by_title['Against GPS'].value} (root mean square{left_out if aside else ''}).",
        f"Report: {page}",
    ]


def area(quality: Quality) -> str:
    """Write the ground between the cameras."""
    if quality.overlap is None or not quality.frame.metric:
        return NOT_KNOWN
    square = quality.overlap.inner_area
    return f"{square / 1e4:,.2f} ha" if square >= 1000 else f"{square:,.0f} m²"


def pixel_size(quality: Quality) -> str:
    """Write the median ground sample distance."""
    known = quality.pixel[np.isfinite(quality.pixel)]
    if not quality.frame.metric or not len(known):
        return NOT_KNOWN
    return f"{100 * float(np.median(known)):.1f} cm a pixel"


def percent(share: float) -> str:
    """Write 0..1 as per cent; only what is whole is 100."""
    if not math.isfinite(share):
        return "–"
    text = f"{100 * share:.1f} %"
    return "99.9 %" if text == "100.0 %" and share < 1 else text.replace("100.0", "100")


def number(value: float, unit: str, digits: int) -> str:
    """Write a figure with its unit, or a dash where there is none."""
    return f"{value:.{digits}f} {unit}".strip() if math.isfinite(value) else "–"


def _s(count: int) -> str:
    return "" if count == 1 else "s"
