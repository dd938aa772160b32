"""A picture of a reconstructed flight: photos, and the model from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from matplotlib import image as photos
from matplotlib.figure import Figure, SubFigure

from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.runtime.files import atomic_path

SAMPLES = 6
"""Photos shown."""


def draw_result(
    path: Path, flight: RenderedFlight, models: Sequence[pycolmap.Reconstruction]
) -> None:
    """Draw sample photos, and the largest model's points and cameras in the flight's frame."""
    figure = Figure(figsize=(12.5, 6.4), layout="constrained", facecolor="white")
    left, right = figure.subfigures(1, 2, width_ratios=(1.12, 1), squeeze=False)[0]
    frames = left.subplots(3, 2)
    chosen = np.linspace(0, len(flight.names) - 1, SAMPLES).round().astype(int)
    for frame, i in zip(frames.flat, chosen, strict=True):
        frame.imshow(photos.imread(flight.images / flight.names[i]))
        frame.set_title(flight.names[i], fontsize=8, pad=2)
        frame.axis("off")
    model = max(models, key=lambda model: model.num_reg_images(), default=None)
    if model is not None:
        _draw_model(right, flight, model)
    with atomic_path(path) as draft:
        figure.savefig(draft, format="png", dpi=110)


def _draw_model(panel: SubFigure, flight: RenderedFlight, model: pycolmap.Reconstruction) -> None:
    true = dict(zip(flight.names, flight.centres, strict=True))
    images = [image for image in model.images.values() if image.has_pose and image.name in true]
    images.sort(key=lambda image: image.name)
    found = np.array([image.projection_center() for image in images])
    move = pycolmap.estimate_sim3d(found, np.array([true[image.name] for image in images]))
    if move is None:
        return
    found = np.array([move * centre for centre in found])
    points = [point for point in model.points3D.values() if point.track.length() > 2]
    colours = np.array([point.color for point in points]).reshape(-1, 3) / 255
    places = np.array([move * point.xyz for point in points]).reshape(-1, 3)
    everything = np.concatenate([places, found, flight.centres])
    # Single stray points must not shrink the drawing.
    low, high = np.percentile(everything, (0.1, 99.9), axis=0)
    low, high = np.minimum(low, found.min(axis=0)) - 6, np.maximum(high, found.max(axis=0)) + 6
    tall = high - low
    plan, side = panel.subplots(2, 1, height_ratios=tall[1:].tolist())
    for axes, up in ((plan, 1), (side, 2)):
        axes.scatter(places[:, 0], places[:, up], s=3.0, c=colours, linewidths=0)
        axes.plot(found[:, 0], found[:, up], color="#d62728", linewidth=0.7, alpha=0.6)
        axes.plot(
            flight.centres[:, 0], flight.centres[:, up], "o", markersize=8, markerfacecolor="none",
            markeredgecolor="black", markeredgewidth=0.8, label="true camera centres",
        )  # fmt: skip
        axes.plot(
            found[:, 0], found[:, up], ".", color="#d62728", markersize=5,
            label="reconstructed camera centres",
        )  # fmt: skip
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[up], high[up])
    plan.set_ylabel("north (m)")
    side.set_ylabel("up (m)")
    side.set_xlabel("east (m)")
    plan.legend(loc="lower right", fontsize=7, framealpha=0.9)
    plan.set_title(
        f"{len(images)} of {len(flight.names)} photos registered, {model.num_points3D():,} points",
        fontsize=10,
    )
