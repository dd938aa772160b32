"""The figures of a comparison's page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from colmap_netvlad.comparison.result import EXHAUSTIVE, Comparison, MethodResult
from colmap_netvlad.report.drawing import COLOURS, GREY, PAPER, STYLE, map_axes, png, svg_text
from colmap_netvlad.report.numbers import seconds as duration

MARKERS = "osD^vPX*<>"
DASHES = ("-", "--", "-.", ":")

STAGES = (
    ("Describing", "#0072b2", ""),
    ("Searching", "#56b4e9", "////"),
    ("Matching", "#e69f00", ""),
    ("Mapping", "#009e73", "...."),
)
"""Title, colour and hatch of a part of a time bar: readable without colour."""

DRAWN_EDGES = 60_000
"""Edges drawn of a view graph; the weakest are left out first."""


@dataclass(frozen=True)
class Look:
    """How a method is drawn in every chart."""

    colour: str
    marker: str
    dash: str


def looks(comparison: Comparison) -> dict[str, Look]:
    """Give each method a colour, a marker and a dash pattern of its own."""
    ranked = [m.name for m in comparison.methods if m.ranks]
    styles = {
        name: Look(COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)], DASHES[i % len(DASHES)])
        for i, name in enumerate(ranked)
    }
    return {**styles, EXHAUSTIVE: Look(GREY, "", ":")}


def curve(comparison: Comparison, field: str, title: str) -> str:
    """Draw a retrieval figure in per cent over k, a line for each method, as SVG."""
    styles = looks(comparison)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.3, 3.0), layout="constrained")
        axes = figure.subplots()
        for method in comparison.methods:
            points = [(f.k, getattr(f, field)) for f in method.at_k]
            points = [(k, 100 * value) for k, value in points if value is not None]
            if not points or (not method.ranks and field != "accuracy"):
                continue
            look = styles[method.name]
            ks, values = zip(*points, strict=True)
            label = method.name if method.ranks else f"{method.name} (all pairs)"
            axes.plot(ks, values, color=look.colour, marker=look.marker, ls=look.dash, lw=1.8,
                      markersize=5.5, label=label)  # fmt: skip
        axes.set_xlabel("partners retrieved for each image, k")
        axes.set_ylabel(f"{title}, %")
        axes.set_xticks(comparison.ks)
        axes.margins(x=0.06, y=0.12)
        axes.grid(axis="y")
        return svg_text(figure)


def legend(comparison: Comparison) -> list[tuple[str, str]]:
    """Return each ranked method's name with a small SVG of its line and marker."""
    swatches = []
    for name, look in looks(comparison).items():
        if not any(m.name == name and m.at_k for m in comparison.methods):
            continue
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(0.45, 0.16))
            axes = figure.add_axes((0, 0, 1, 1))
            axes.plot([0, 1, 2], [0, 0, 0], color=look.colour, ls=look.dash, lw=1.8)
            axes.plot([1], [0], color=look.colour, marker=look.marker, markersize=5.5)
            axes.set_axis_off()
            swatches.append((name, svg_text(figure)))
    return swatches


def time_bars(comparison: Comparison) -> str:
    """Draw where each method's time goes, a bar for each method, as SVG."""
    methods = [m for m in comparison.methods if m.seconds_match is not None]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.4, 0.75 + 0.42 * max(len(methods), 1)), layout="constrained")
        axes = figure.subplots()
        left = np.zeros(len(methods))
        unit, name = (60.0, "minutes") if _longest(methods) >= 100 else (1.0, "seconds")
        for stage, (title, colour, hatch) in enumerate(STAGES):
            spent = np.array([_stages(m)[stage] for m in methods])
            axes.barh(range(len(methods)), spent / unit, left=left / unit, height=0.62,
                      color=colour, hatch=hatch, label=title, lw=0)  # fmt: skip
            left += spent
        for row, total in enumerate(left):
            axes.annotate(duration(total), (total / unit, row), xytext=(4, 0),
                          textcoords="offset points", va="center", fontsize=8)  # fmt: skip
        axes.set_yticks(range(len(methods)), [m.name for m in methods])
        axes.invert_yaxis()
        axes.set_xlabel(name)
        axes.margins(x=0.16)
        axes.set_xlim(left=0)
        axes.grid(axis="x")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
        figure.legend(loc="outside upper left", ncols=len(STAGES), frameon=False, fontsize=8,
                      handlelength=1.2, columnspacing=1.2)  # fmt: skip
        return svg_text(figure)


def view_graph(
    xy: NDArray[np.float64],
    edges: NDArray[np.int64],
    matches: NDArray[np.int64],
    strongest: int,
    metric: bool,
) -> bytes:
    """Draw a view graph on the ground plan as PNG.

    Args:
        xy: (N, 2) positions; NaN where an image is not drawn.
        edges: (E, 2) indices of images.
        matches: (E) verified matches of each.
        strongest: end of the colour scale, equal for all methods.
        metric: whether the unit is the metre.
    """
    drawn = np.asarray(np.isfinite(xy).all(axis=1))
    seen = drawn[edges].all(axis=1) if len(edges) else np.zeros(0, bool)
    edges, matches = edges[seen], matches[seen]
    order = np.argsort(matches, kind="stable")[-DRAWN_EDGES:]
    with mpl.rc_context({**STYLE, **PAPER}):
        figure = Figure(figsize=(4.6, 4.0), dpi=150, layout="constrained")
        axes = figure.subplots()
        top = max(strongest, 32)
        norm = LogNorm(16, top)
        degrees = np.bincount(edges.ravel(), minlength=len(xy))
        thin = float(np.clip(60 / np.sqrt(max(len(edges), 1)), 0.25, 1.3))
        if len(edges):
            axes.add_collection(
                LineCollection(
                    list(xy[edges[order]]), array=matches[order], cmap=_EDGE_MAP, norm=norm,
                    linewidths=thin, alpha=0.85,
                )
            )  # fmt: skip
        size = float(np.clip(2400 / max(drawn.sum(), 1), 1.2, 26))
        joined, alone = drawn & (degrees > 0), drawn & (degrees == 0)
        axes.scatter(xy[joined, 0], xy[joined, 1], s=size, color="#1b1b1b", zorder=3, linewidths=0)
        if alone.any():
            axes.scatter(
                xy[alone, 0], xy[alone, 1], s=size * 2 + 12, marker="x", color="#c1121f", zorder=4
            )
        map_axes(axes, xy[drawn], metric)
        bar = figure.colorbar(
            ScalarMappable(norm, _EDGE_MAP), ax=axes, location="bottom", shrink=0.75, aspect=35
        )
        bar.set_label("verified matches of a pair")
        bar.ax.minorticks_off()
        ticks = [t for t in (16, 30, 100, 300, 1000, 3000, 10000) if t <= top]
        bar.set_ticks(ticks, labels=[f"{t:,}" for t in ticks])
        return png(figure)


def model_plan(
    centres: NDArray[np.float64],
    points: NDArray[np.float64],
    colours: NDArray[np.uint8],
    window: NDArray[np.float64],
    metric: bool,
) -> bytes:
    """Draw a model from above as PNG: points in their colours, cameras in blue (figure 12).

    Args:
        centres: (M, 2 or 3) camera centres.
        points: (P, 2 or 3) points.
        colours: (P, 3) uint8 RGB.
        window: (2, 2) lower left and upper right corner of the plan, equal for all methods.
        metric: whether the unit is the metre.
    """
    with mpl.rc_context({**STYLE, **PAPER}):
        figure = Figure(figsize=(4.6, 4.0), dpi=150, layout="constrained")
        axes = figure.subplots()
        if len(points):
            shade = colours / 255 if colours.any() else "#7a7a7a"
            axes.scatter(points[:, 0], points[:, 1], s=1.1, c=shade, linewidths=0)
        size = float(np.clip(2400 / max(len(centres), 1), 2, 22))
        axes.scatter(centres[:, 0], centres[:, 1], s=size, marker="s", color="#1450d2",
                     edgecolors="#ffffff", linewidths=0.3, zorder=3)  # fmt: skip
        map_axes(axes, window, metric)
        axes.set_xlim(window[0, 0], window[1, 0])
        axes.set_ylim(window[0, 1], window[1, 1])
        return png(figure)


def plan_window(clouds: Sequence[NDArray[np.float64]], margin: float = 0.12) -> NDArray[np.float64]:
    """Return the (2, 2) corners of a box around the camera centres of all models, with margin."""
    cameras = np.vstack([cloud[:, :2] for cloud in clouds])
    low, high = cameras.min(axis=0), cameras.max(axis=0)
    edge = margin * float(max((high - low).max(), 1e-6)) + 0.03 * (high - low)
    return np.array([low - edge, high + edge])


_EDGE_MAP = mpl.colormaps["viridis_r"]


def _stages(method: MethodResult) -> tuple[float, float, float, float]:
    model = method.model
    matching, mapping = (model.seconds_match, model.seconds) if model else (method.seconds_match, 0)
    return (
        method.seconds_describe or 0.0,
        method.seconds_search or 0.0,
        matching or 0.0,
        mapping,
    )


def _longest(methods: Sequence[MethodResult]) -> float:
    return max((sum(_stages(method)) for method in methods), default=0.0)
