"""The quality report of one flight as an HTML page that needs nothing beside it."""

from __future__ import annotations

import base64
import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from colmap_netvlad.graph.lookalikes import Lookalike
from colmap_netvlad.report import flight_plots as plots
from colmap_netvlad.report.numbers import count, seconds
from colmap_netvlad.report.pages import pages
from colmap_netvlad.report.quality import (
    ENOUGH,
    Check,
    Quality,
    area,
    number,
    overall,
    percent,
    pixel_size,
)
from colmap_netvlad.report.thumbnails import Thumbnails, data_uri

Floats = NDArray[np.float64]

MISSING_SHOWN = 60
"""Missing photos shown with a thumbnail; the table of photos has all of them."""

PAIRS_SHOWN, OF_A_PHOTO = 16, 2
"""Look-alikes shown, both photos side by side, and how often at most the same photo."""

WEAK_SHOWN = 30
"""Articulation images and bridges named."""

CAMERAS_SHOWN = 8
"""Cameras whose parameters are listed."""

REGIONS_SHOWN = 4
"""Cameras whose errors by image region are drawn."""

MAP_EDGES = 20_000
"""Pairs on the map that can be looked into; the weakest are left out first."""

COLUMNS = {
    "Keypoints": "features found in the photo",
    "Pairs": "photos it is joined to in the view graph",
    "Points": "keypoints that see a 3D point",
    "Error, px": "mean reprojection error",
    "Pixel, cm": "ground sample distance",
    "GPS, m": "distance from its GPS position",
}
"""Columns of the table of photos, and what they are."""

WORDS = {
    "green": "Green: nothing found that speaks against this model",
    "yellow": "Yellow: usable, but look at what is marked",
    "red": "Red: something is missing or wrong; look at what is marked before you rely on it",
    "unknown": "Too little is known for a verdict",
}


@dataclass(frozen=True)
class Picture:
    """A figure of the page: what it shows, in words too. `svg` or `image` is set."""

    title: str
    alt: str
    image: str = ""
    svg: str = ""
    caption: str = ""


def render_flight_page(quality: Quality, checks: Sequence[Check]) -> str:
    """Return the page's HTML.

    What is drawn is capped, so that a flight of 5,000 photos gives a page of a few megabytes.
    Nothing in it runs but our own script, which the page's content policy names by its hash.
    """
    environment = pages()
    environment.filters.update(count=count, duration=seconds, percent=percent, number=number)
    script = files("colmap_netvlad.report").joinpath("templates/flight.js").read_text("utf-8")
    missing = list(quality.missing or ())
    facts = _facts(quality)
    return environment.get_template("flight.html").render(
        quality=quality,
        data=quality.data,
        source=quality.source,
        run=quality.source.run,
        checks=checks,
        verdict=overall(checks),
        words=WORDS,
        area=area(quality),
        pixel=pixel_size(quality),
        gps=quality.errors_against_gps,
        residuals=_residual_rows(quality),
        ground=quality.source.ground,
        enough=ENOUGH,
        plan=_plan(quality),
        overlap=_overlap(quality),
        graph=_view_graph(quality),
        statistics=quality.links,
        weak_shown=WEAK_SHOWN,
        lookalikes=_shown(quality.lookalikes),
        missing=missing[:MISSING_SHOWN],
        all_missing=len(missing),
        charts=_charts(quality),
        regions=_regions(quality),
        cameras=list(quality.cameras)[:CAMERAS_SHOWN],
        all_cameras=len(quality.cameras),
        shutters=_shutters(quality),
        thumbnail=Thumbnails(quality.source.images),
        facts=Markup(_json(facts)),
        columns=[(title, COLUMNS[title]) for title, *_ in facts["columns"]],
        script=Markup(script),
        policy=_policy(script),
    )


def _policy(script: str) -> str:
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'"
    )


def _json(facts: object) -> str:
    """Return JSON that can stand in a script element: no character of HTML in it."""
    text = json.dumps(facts, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


# The figures


def _plan(quality: Quality) -> Picture | None:
    if not len(quality.data.names):
        return None
    lost = _lost_positions(quality)
    centres = quality.frame.move(quality.data.centres)
    picture, _ = plots.plan(
        centres, quality.frame.gps, quality.frame.outliers, lost, quality.frame.metric
    )
    words = f"{len(centres):,} computed cameras seen from above"
    known = int(np.isfinite(quality.frame.gps).all(axis=1).sum())
    if known:
        words += f", {known:,} with GPS positions"
    return _png("Plan of the cameras", picture, words)


def _lost_positions(quality: Quality) -> Floats:
    if not quality.frame.metric:
        return np.zeros((0, 3))
    known = [
        quality.source.positions[photo.name]
        for photo in quality.missing or ()
        if photo.name in quality.source.positions
    ]
    lost = np.array(known).reshape(-1, 3)
    return lost[np.isfinite(lost).all(axis=1)]


def _residual_rows(quality: Quality) -> list[tuple[str, float, float, float]]:
    """Mean, root mean square and largest residual against GPS: east, north, up, m."""
    kept = np.isfinite(quality.frame.residuals).all(axis=1) & ~quality.frame.outliers
    residuals = quality.frame.residuals[kept]
    if not len(residuals):
        return []
    rows = (
        ("mean", residuals.mean(axis=0)),
        ("root mean square", np.sqrt((residuals**2).mean(axis=0))),
        ("largest", np.abs(residuals).max(axis=0)),
    )
    # Adding zero turns a rounded -0.0 into 0.0.
    return [(title, *(np.round(values, 2) + 0.0).tolist()) for title, values in rows]


def _shutters(quality: Quality) -> list[str]:
    """Say what rolling shutters cost, in pixels where the ground sample distance is known."""
    known = quality.pixel[np.isfinite(quality.pixel)]
    pixel = float(np.median(known)) if quality.frame.metric and len(known) else None
    return [shutter.sentence(pixel) for shutter in quality.shutters]


def _overlap(quality: Quality) -> Picture | None:
    if quality.overlap is None:
        return None
    centres = quality.frame.move(quality.data.centres)
    picture = plots.overlap(quality.overlap, centres, quality.frame.metric)
    words = f"Map of how many photos see each place; {percent(quality.overlap.share(ENOUGH))} of "
    return _png(
        "Overlap", picture, f"{words}the ground between the cameras is seen by {ENOUGH} or more"
    )


def _view_graph(quality: Quality) -> Picture | None:
    graph = quality.graph
    if not len(graph.names):
        return None
    xyz = _positions_of(quality, graph.names)
    index = {name: i for i, name in enumerate(graph.names)}
    bridges = np.array([(index[a], index[b]) for a, b in quality.links.bridges], np.int32)
    weak = [index[name] for name in quality.links.articulation_images]
    label = "verified matches" if quality.verified else "common points"
    picture = plots.view_graph(
        xyz,
        graph.edges,
        graph.inliers,
        bridges.reshape(-1, 2),
        weak,
        quality.frame.metric,
        f"{label} of a pair",
    )
    words = f"{len(graph.edges):,} pairs with more than 15 {label}"
    hidden = int((~np.isfinite(xyz).all(axis=1)).sum())
    if hidden:
        words += f"; {hidden:,} photo{'' if hidden == 1 else 's'} of unknown place not drawn"
    return _png("View graph", picture, words)


def _positions_of(quality: Quality, names: Sequence[str]) -> Floats:
    """Computed centres, and GPS positions of what has none; NaN where nothing is known."""
    centres = quality.frame.move(quality.data.centres)
    known = dict(zip(quality.data.names, centres, strict=True))
    if quality.frame.metric:
        known = {**quality.source.positions, **known}
    nowhere = np.full(3, np.nan)
    return np.array([known.get(name, nowhere) for name in names]).reshape(-1, 3)


def _shown(lookalikes: Sequence[Lookalike]) -> list[Lookalike]:
    """Return the strongest cases, without showing the same photo again and again."""
    seen: Counter[str] = Counter()
    shown: list[Lookalike] = []
    for one in lookalikes:
        if len(shown) < PAIRS_SHOWN and max(seen[name] for name in one.pair) < OF_A_PHOTO:
            seen.update(one.pair)
            shown.append(one)
    return shown


def _charts(quality: Quality) -> list[Picture]:
    data = quality.data
    if not len(data.points):
        return []
    length = f"{data.mean_track_length:.2f}"
    error = f"{data.observation_error:.2f}"
    return [
        Picture(
            "Track lengths",
            f"Histogram of how many photos see a point; {length} on average.",
            svg=Markup(plots.histogram(data.track_lengths, "photos that see a point", "points")),
            caption=f"A point is seen by {length} photos on average. More is firmer.",
        ),
        Picture(
            "Reprojection errors",
            f"Histogram of reprojection errors; {error} px on average.",
            svg=Markup(plots.error_histogram(data.histogram)),
            caption=f"{error} px on average over {int(data.observations.sum()):,} observations, "
            f"{data.mean_error:.2f} px over points (COLMAP's figure).",
        ),
        Picture(
            "Keypoints and points a photo",
            "Histograms of keypoints of a photo, and of those that see a point.",
            svg=Markup(plots.photo_histogram(data.keypoints, data.observations)),
            caption=f"Median of {np.median(data.keypoints):,.0f} keypoints a photo, "
            f"{np.median(data.observations):,.0f} of them see a point.",
        ),
    ]


def _regions(quality: Quality) -> list[Picture]:
    pictures = []
    for camera in list(quality.cameras)[:REGIONS_SHOWN]:
        errors = quality.data.regions.get(camera.camera_id)
        if errors is None or not errors.count.any():
            continue
        picture, stretch = plots.error_regions(errors, camera.width, camera.height)
        words = (
            f"Camera {camera.camera_id}, {camera.images:,} photos; arrows are the mean error, "
            f"{stretch:g} times as long."
        )
        title = f"Camera {camera.camera_id}: errors by image region"
        pictures.append(_png(title, picture, words))
    return pictures


def _png(title: str, picture: bytes, words: str) -> Picture:
    return Picture(title, f"{words}.", image=data_uri("image/png", picture), caption=words)


# What the page's script looks into


def _facts(quality: Quality) -> dict[str, Any]:
    """Rows of the table, and what the map shows: columns, as they are shorter than rows."""
    data, frame, graph = quality.data, quality.frame, quality.graph
    missing = {photo.name: photo for photo in quality.missing or ()}
    names = sorted({*data.names, *missing})
    place = {name: i for i, name in enumerate(data.names)}
    index = {name: i for i, name in enumerate(names)}
    own = [place.get(name, -1) for name in names]
    degree = dict(zip(graph.names, graph.degrees().tolist(), strict=True))
    residual = np.linalg.norm(frame.residuals, axis=1) if len(data.names) else np.zeros(0)

    def column(values: NDArray[np.generic], digits: int = 0) -> list[float | None]:
        return [None if i < 0 else _rounded(float(values[i]), digits) for i in own]

    xyz = _positions_of(quality, names)
    digits = _digits(xyz)
    return {
        "names": names,
        "status": [missing[name].reason if name in missing else "registered" for name in names],
        "details": {index[name]: photo.details for name, photo in missing.items()},
        "columns": [
            ["Keypoints", 0, column(data.keypoints)],
            ["Pairs", 0, [degree.get(name) for name in names]],
            ["Points", 0, column(data.observations)],
            ["Error, px", 2, column(data.errors, 2)],
            *([["Pixel, cm", 1, column(100 * quality.pixel, 1)]] if frame.metric else []),
            *([["GPS, m", 2, column(residual, 2)]] if frame.metric else []),
        ],
        "x": [_rounded(float(v), digits) for v in xyz[:, 0]],
        "y": [_rounded(float(v), digits) for v in xyz[:, 1]],
        "corners": [
            None
            if i < 0 or not np.isfinite(quality.corners[i]).all()
            else [_rounded(float(v), digits) for v in quality.corners[i].ravel()]
            for i in own
        ],
        "edges": _map_edges(quality, index),
        "metric": frame.metric,
        **_underlays(quality, xyz),
    }  # fmt: skip


def _map_edges(quality: Quality, index: dict[str, int]) -> list[list[int]]:
    graph = quality.graph
    strongest = np.sort(np.argsort(-graph.inliers, kind="stable")[:MAP_EDGES])
    return [
        [index[graph.names[i]], index[graph.names[j]], int(n)]
        for (i, j), n in zip(
            graph.edges[strongest].tolist(), graph.inliers[strongest].tolist(), strict=True
        )
        if graph.names[i] in index and graph.names[j] in index
    ]


def _underlays(quality: Quality, xyz: Floats) -> dict[str, object]:
    """Pictures under the map and the boxes they fill: west, south, east, north."""
    placed = xyz[np.isfinite(xyz).all(axis=1), :2]
    if not len(placed):
        return {"box": None, "points": None, "overlap": None}
    points = quality.frame.move(quality.data.points) if len(quality.data.points) else None
    box = _box(placed, points)
    found: dict[str, object] = {"box": box.ravel().tolist(), "points": None, "overlap": None}
    if points is not None:
        picture = plots.points_picture(points, quality.data.colours, box)
        found["points"] = data_uri("image/png", picture)
    if quality.overlap is not None:
        west, east, south, north = quality.overlap.extent
        picture = plots.overlap_picture(quality.overlap)
        found["overlap"] = {
            "picture": data_uri("image/png", picture),
            "box": [west, south, east, north],
        }
    return found


def _box(placed: Floats, points: Floats | None) -> Floats:
    """Return the corners of the map: all cameras and nearly all points, but no stray ones."""
    low, high = placed.min(axis=0), placed.max(axis=0)
    edge = 0.06 * float(max((high - low).max(), 1e-6))
    if points is not None:
        around = high - low + edge
        core = np.percentile(points[:, :2], [1, 99], axis=0)
        low = np.minimum(low, np.maximum(core[0], low - around))
        high = np.maximum(high, np.minimum(core[1], high + around))
    return np.array([low - edge, high + edge])


def _digits(xyz: Floats) -> int:
    """Decimals that tell a thousandth of the plan."""
    known = xyz[np.isfinite(xyz).all(axis=1)]
    wide = float(np.ptp(known[:, :2], axis=0).max()) if len(known) else 1.0
    return int(np.clip(4 - np.floor(np.log10(max(wide, 1e-9))), 1, 8))


def _rounded(value: float, digits: int) -> float | None:
    if not np.isfinite(value):
        return None
    return int(value) if digits == 0 else round(value, digits)
