"""The figures of a flight's page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from colmap_netvlad.report.drawing import COLOURS, GREY, PAPER, STYLE, map_axes, png, svg_text
from colmap_netvlad.report.ground import Overlap
from colmap_netvlad.report.modeldata import ERROR_BINS, CameraErrors

Floats = NDArray[np.float64]

PHOTOS = (1, 2, 3, 4, 5, 7, 10)
"""Steps of the overlap map's scale; the last is "or more"."""

OVERLAP_COLOURS = ("#c1121f", "#f3722c", "#f9c74f", "#c9d96b", "#8cc152", "#4d9e3f", "#1f6f2b")
"""Red below three photos, green from there on: darker is more."""

CAMERA = "#1450d2"
LOST = "#c1121f"
WEAK = "#e85d04"

DRAWN_EDGES = 60_000
"""Edges drawn of a view graph; the weakest are left out first."""

RASTER = 700
"""Longer side of the picture of the points, px."""

WIDE = (6.4, 4.6)


def plan(
    centres: Floats, gps: Floats, outliers: NDArray[np.bool_], lost: Floats, metric: bool
) -> tuple[bytes, float]:
    """Draw computed cameras, their GPS positions, and the residuals between them.

    Args:
        centres: (N, 2 or 3) computed camera centres.
        gps: (N, 2 or 3) their GPS positions; NaN where unknown.
        outliers: (N) positions put aside.
        lost: (L, 2 or 3) GPS positions of photos without a pose.
        metric: whether the unit is the metre.

    Returns:
        The picture, and by how much its residual vectors are longer than true.
    """
    known = np.isfinite(gps[:, :2]).all(axis=1)
    vectors = (centres - gps)[known][:, :2]
    stretch = _stretch(vectors[~outliers[known]], np.vstack([centres[:, :2], lost[:, :2]]))
    with mpl.rc_context({**STYLE, **PAPER}):
        figure = Figure(figsize=WIDE, dpi=150, layout="constrained")
        axes = figure.subplots()
        size = _marker_size(len(centres))
        tips = gps[known][:, :2] + stretch * vectors
        axes.add_collection(
            LineCollection(
                list(np.stack([gps[known][:, :2], tips], axis=1)),
                colors="#d55e00",
                linewidths=1.1,
                zorder=4.5,
            )
        )
        _dots(axes, centres[:, :2], s=size, marker="s", color=CAMERA, linewidths=0, zorder=3)
        _dots(axes, gps[known][:, :2], s=size, facecolors="none", edgecolors="#333333",
                     linewidths=0.6, zorder=4)  # fmt: skip
        _dots(axes, gps[outliers][:, :2], s=3 * size, facecolors="none", edgecolors=LOST,
                     linewidths=1.2, zorder=4)  # fmt: skip
        _dots(axes, lost[:, :2], s=size + 14, marker="x", color=LOST, linewidths=1, zorder=5)
        map_axes(axes, np.vstack([centres[:, :2], gps[known][:, :2], lost[:, :2]]), metric)
        handles = [_dot("s", CAMERA, "computed camera")]
        if known.any():
            times = f", drawn {stretch:g} times as long" if stretch != 1 else ""
            handles += [
                Line2D([], [], marker="o", ls="", mfc="none", mec="#333333", label="GPS position"),
                Line2D([], [], color="#d55e00", label=f"residual{times}"),
            ]
        if outliers.any():
            handles.append(
                Line2D([], [], marker="o", ls="", ms=9, mfc="none", mec=LOST, label="put aside")
            )
        if len(lost):
            handles.append(_dot("x", LOST, "photo without a pose"))
        _legend_below(figure, handles)
        return png(figure), stretch


def overlap(ground: Overlap, centres: Floats, metric: bool) -> bytes:
    """Draw how many photos see each place of the ground, and the cameras."""
    with mpl.rc_context({**STYLE, **PAPER}):
        figure = Figure(figsize=WIDE, dpi=150, layout="constrained")
        axes = figure.subplots()
        colours, norm = _overlap_scale()
        seen = np.ma.masked_equal(ground.count, 0)
        axes.imshow(seen, origin="lower", extent=ground.extent, cmap=colours, norm=norm,
                    interpolation="nearest")  # fmt: skip
        hull = cv2.convexHull(centres[:, :2].astype(np.float32))[:, 0]
        axes.plot(*np.vstack([hull, hull[:1]]).T, color="#111111", lw=0.9, ls="--")
        _dots(axes, centres[:, :2], s=_marker_size(len(centres)) / 4, color="#111111",
                     linewidths=0)  # fmt: skip
        west, east, south, north = ground.extent
        map_axes(axes, np.array([(west, south), (east, north)]), metric)
        more = [f"{n} photo{'s' if n > 1 else ''}" for n in PHOTOS]
        more[-1] = f"{PHOTOS[-1]} or more"
        more[4:6] = ["5 or 6", "7 to 9"]
        handles: list[Artist] = [
            Patch(color=c, label=t) for c, t in zip(OVERLAP_COLOURS, more, strict=True)
        ]
        handles.append(
            Line2D([], [], color="#111111", ls="--", lw=0.9, label="between the cameras")
        )
        _legend_below(figure, handles, columns=4)
        return png(figure)


def overlap_picture(ground: Overlap) -> bytes:
    """Return the overlap map alone as PNG, north up, transparent where nothing is seen."""
    colours, norm = _overlap_scale()
    rgba = (colours(norm(np.maximum(ground.count, 1))) * 255).astype(np.uint8)
    rgba[ground.count == 0] = 0
    return _encode(rgba[::-1, :, [2, 1, 0, 3]])


def points_picture(points: Floats, colours: NDArray[np.uint8], box: Floats) -> bytes:
    """Draw points from above in their colours, the highest on top, as PNG without axes.

    Args:
        points: (P, 3) in the page's frame.
        colours: (P, 3) uint8 RGB.
        box: (2, 2) lower left and upper right corner.
    """
    cell = float((box[1] - box[0]).max()) / RASTER
    columns, rows = np.maximum(np.ceil((box[1] - box[0]) / cell).astype(int), 1).tolist()
    rgba = np.zeros((rows, columns, 4), np.uint8)
    place = ((points[:, :2] - box[0]) / cell).astype(int)
    inside = ((place >= 0) & (place < [columns, rows])).all(axis=1)
    order = np.argsort(points[inside, 2], kind="stable")
    column, row = place[inside][order].T
    shade = colours[inside][order]
    if not colours.any():
        shade = np.full_like(shade, 120)
    rgba[row, column, :3] = shade[:, ::-1]
    rgba[row, column, 3] = 255
    # Sparse points are drawn larger, so that they make a picture.
    if len(points) and rows * columns / len(points) > 8:
        grown = cv2.dilate(rgba, np.ones((3, 3), np.uint8))
        rgba = np.where(rgba[..., 3:] > 0, rgba, grown)
    return _encode(rgba[::-1])


def view_graph(
    xy: Floats,
    edges: NDArray[np.int32],
    matches: NDArray[np.int64],
    weak_edges: NDArray[np.int32],
    weak_images: Sequence[int],
    metric: bool,
    label: str,
) -> bytes:
    """Draw the view graph; bridges, articulation images and images without edge stand out.

    Args:
        xy: (N, 2 or 3) positions; NaN where an image is not drawn.
        edges: (E, 2) indices of images.
        matches: (E) of each.
        weak_edges: (B, 2) bridges.
        weak_images: articulation images.
        label: what `matches` counts.
    """
    drawn = np.asarray(np.isfinite(xy[:, :2]).all(axis=1))
    shown = drawn[edges].all(axis=1) if len(edges) else np.zeros(0, bool)
    degrees = np.bincount(edges.ravel(), minlength=len(xy))
    edges, matches = edges[shown], matches[shown]
    order = np.argsort(matches, kind="stable")[-DRAWN_EDGES:]
    weak_edges = weak_edges[drawn[weak_edges].all(axis=1)] if len(weak_edges) else weak_edges
    xy = xy[:, :2]
    with mpl.rc_context({**STYLE, **PAPER}):
        figure = Figure(figsize=WIDE, dpi=150, layout="constrained")
        axes = figure.subplots()
        top = max(int(matches.max(initial=32)), 32)
        norm = LogNorm(15, top)
        if len(edges):
            thin = float(np.clip(60 / np.sqrt(len(edges)), 0.25, 1.3))
            axes.add_collection(
                LineCollection(
                    list(xy[edges[order]]), array=matches[order], cmap="viridis_r", norm=norm,
                    linewidths=thin, alpha=0.85,
                )
            )  # fmt: skip
        if len(weak_edges):
            axes.add_collection(
                LineCollection(list(xy[weak_edges]), colors=WEAK, linewidths=2.4, zorder=4)
            )
        size = _marker_size(int(drawn.sum()))
        joined, alone = drawn & (degrees > 0), drawn & (degrees == 0)
        _dots(axes, xy[joined], s=size, color="#1b1b1b", zorder=3, linewidths=0)
        _dots(axes, xy[alone], s=size + 14, marker="x", color=LOST, linewidths=1, zorder=5)
        weak = [i for i in weak_images if drawn[i]]
        _dots(axes, xy[weak].reshape(-1, 2), s=3 * size + 12, facecolors="none",
                     edgecolors=WEAK, linewidths=1.4, zorder=5)  # fmt: skip
        map_axes(axes, xy[drawn], metric)
        handles = [_dot("o", "#1b1b1b", "photo")]
        if len(weak_edges):
            handles.append(Line2D([], [], color=WEAK, lw=2.4, label="the only pair between parts"))
        if weak:
            handles.append(
                Line2D([], [], marker="o", ls="", ms=8, mfc="none", mec=WEAK, mew=1.4,
                       label="the only photo between parts")
            )  # fmt: skip
        if alone.any():
            handles.append(_dot("x", LOST, "photo without a pair"))
        _legend_below(figure, handles)
        bar = figure.colorbar(ScalarMappable(norm, "viridis_r"), ax=axes, shrink=0.8, aspect=30)
        bar.set_label(label)
        bar.ax.minorticks_off()
        ticks = [t for t in (15, 30, 100, 300, 1000, 3000, 10000) if t <= top]
        bar.set_ticks(ticks, labels=[f"{t:,}" for t in ticks])
        return png(figure)


def error_regions(errors: CameraErrors, width: int, height: int) -> tuple[bytes, float]:
    """Draw reprojection errors by image region: mean length as colour, mean vector as arrow.

    Returns:
        The picture, and by how much its arrows are longer than true.
    """
    known = errors.count >= 5
    count = np.maximum(errors.count, 1)
    lengths = np.ma.masked_where(~known, errors.lengths / count)
    vectors = np.where(known[..., None], errors.vectors / count[..., None], 0)
    rows, columns = errors.count.shape
    x = (np.arange(columns) + 0.5) * width / columns
    y = (np.arange(rows) + 0.5) * height / rows
    longest = float(np.linalg.norm(vectors, axis=-1).max())
    stretch = _round_down(0.7 * width / columns / longest) if longest > 0 else 1.0
    with mpl.rc_context({**STYLE, **PAPER}):
        figure = Figure(figsize=(4.6, 3.6), dpi=150, layout="constrained")
        axes = figure.subplots()
        top = float(lengths.max()) if known.any() else 0.0
        box = (0, width, height, 0)
        shown = axes.imshow(lengths, extent=box, cmap="YlGnBu", vmin=0, vmax=max(1.0, top))
        axes.quiver(x, y, stretch * vectors[..., 0], stretch * vectors[..., 1], angles="xy",
                    scale_units="xy", scale=1, width=0.005, color="#b3261e")  # fmt: skip
        axes.set_xlim(0, width)
        axes.set_ylim(height, 0)
        axes.set_xticks([0, width])
        axes.set_yticks([0, height])
        bar = figure.colorbar(shown, ax=axes, location="bottom", shrink=0.8, aspect=30)
        bar.set_label("mean reprojection error, px")
        return png(figure), stretch


def histogram(values: NDArray[np.integer], label: str, unit: str) -> str:
    """Draw a histogram of counts as SVG; the last bar holds everything beyond."""
    last = int(np.clip(np.percentile(values, 99), 6, 30)) if len(values) else 6
    bars = np.bincount(np.minimum(values, last), minlength=last + 1)
    first = int(np.flatnonzero(bars)[0]) if bars.any() else 0
    with mpl.rc_context(STYLE):
        figure, axes = _chart()
        axes.bar(range(first, last + 1), bars[first:], color=COLOURS[0], width=0.8)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        ticks = [t for t in axes.get_xticks().tolist() if first <= t < last - 0.08 * (last - first)]
        axes.set_xticks([*ticks, last], labels=[*(f"{t:g}" for t in ticks), f"{last}+"])
        _label(axes, label, unit)
        return svg_text(figure)


def error_histogram(counts: NDArray[np.int64]) -> str:
    """Draw observations by reprojection error as SVG."""
    with mpl.rc_context(STYLE):
        figure, axes = _chart()
        width = ERROR_BINS[1] - ERROR_BINS[0]
        axes.bar(ERROR_BINS[:-1] + width / 2, counts[:-1], color=COLOURS[0], width=0.85 * width)
        _label(axes, "reprojection error, px", "observations")
        return svg_text(figure)


def photo_histogram(keypoints: NDArray[np.int64], seen: NDArray[np.int64]) -> str:
    """Draw how many keypoints photos have, and how many of them see a point, as SVG."""
    top = float(max(keypoints.max(initial=1), 1))
    edges = np.linspace(0, top, 25).tolist()
    with mpl.rc_context(STYLE):
        figure, axes = _chart()
        axes.hist(keypoints, edges, color=GREY, alpha=0.55, label="keypoints")
        axes.hist(seen, edges, color=COLOURS[0], alpha=0.8, label="that see a point")
        axes.legend(frameon=False, fontsize=8)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        _label(axes, "keypoints of a photo", "photos")
        return svg_text(figure)


def _chart() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(4.3, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.grid(axis="y")
    axes.set_axisbelow(True)
    return figure, axes


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.yaxis.set_major_formatter(lambda value, position: f"{value:,.0f}")


def _overlap_scale() -> tuple[ListedColormap, BoundaryNorm]:
    colours = ListedColormap(list(OVERLAP_COLOURS))
    return colours, BoundaryNorm([*PHOTOS, 10**6], colours.N)


def _dots(axes: Axes, xy: Floats, **look: Any) -> None:
    axes.scatter(xy[:, 0], xy[:, 1], **look)


def _marker_size(count: int) -> float:
    return float(np.clip(2400 / max(count, 1), 2, 22))


def _dot(marker: str, colour: str, label: str) -> Line2D:
    return Line2D([], [], marker=marker, ls="", color=colour, ms=5, label=label)


def _legend_below(figure: Figure, handles: Sequence[Artist], columns: int = 5) -> None:
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False,
                  fontsize=8, handlelength=1.4, columnspacing=1.2)  # fmt: skip


def _stretch(vectors: Floats, places: Floats) -> float:
    """By how much to stretch vectors so that the usual one is a twelfth of the plan: longer than
    a marker."""
    places = places[np.isfinite(places).all(axis=1)]
    if not len(vectors) or not len(places):
        return 1.0
    usual = float(np.median(np.linalg.norm(vectors, axis=1)))
    wide = float(np.ptp(places, axis=0).max())
    return max(_round_down(wide / 12 / usual), 1.0) if usual > 0 and wide > 0 else 1.0


def _round_down(value: float) -> float:
    """Round to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def _encode(bgra: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(bgra))[1].tobytes()
