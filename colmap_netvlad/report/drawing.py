"""How figures are drawn: charts as inline SVG in the page's own colours, maps as PNG."""

from __future__ import annotations

import hashlib
import io
import re

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

INK = "#010203"
"""Stands for the page's text colour: replaced by `currentColor`, so charts follow dark mode."""

COLOURS = (
    "#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#8c6bb1", "#a6761d",
    "#5f9e3a", "#e7298a",
)  # fmt: skip
"""Okabe and Ito's palette without black and yellow, and four more: told apart by colour-blind
readers, seen on white and on dark paper."""

GREY = "#808080"

STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "colmap-netvlad",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "hatch.color": "#ffffff",
    "hatch.linewidth": 0.7,
}

PAPER = dict.fromkeys(
    ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), "#333333"
)
"""A map's ink: maps are drawn on white paper in dark mode too."""


def map_axes(axes: Axes, xy: NDArray[np.float64], metric: bool) -> None:
    """Fit a map's axes around (N, 2) positions; metres are written on them where there are any."""
    axes.set_aspect("equal")
    if len(xy):
        low, high = xy.min(axis=0), xy.max(axis=0)
        edge = 0.05 * float(max((high - low).max(), 1e-6))
        axes.set_xlim(low[0] - edge, high[0] + edge)
        axes.set_ylim(low[1] - edge, high[1] + edge)
    if metric:
        axes.set_xlabel("east, m")
        axes.set_ylabel("north, m")
        axes.locator_params(nbins=5)
    else:
        axes.set_xticks([])
        axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(metric)
        side.set_color("#bbbbbb")


def png(figure: Figure) -> bytes:
    """Return a figure as PNG on white."""
    out = io.BytesIO()
    figure.savefig(out, format="png", facecolor="#ffffff", metadata={"Software": None})
    return out.getvalue()


def svg_text(figure: Figure) -> str:
    """Return the figure as inline SVG: text as text in the page's font and colour, no id twice."""
    out = io.StringIO()
    figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = out.getvalue()[out.getvalue().index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = svg.replace(INK, "currentColor")
    svg = re.sub(r"<style.*?</style>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'font-family: [^;"]*;? ?', "", svg)
    prefix = f"f{hashlib.sha256(svg.encode()).hexdigest()[:8]}-"
    svg = re.sub(r'\bid="', f'id="{prefix}', svg)
    svg = re.sub(r'(href="#|url\(#)', rf"\g<1>{prefix}", svg)
    return svg.replace("<svg ", '<svg aria-hidden="true" focusable="false" ', 1).strip()
