"""Draw docs/figures/conventions.png: the frames and angles of a georegistered model.

python scripts/make_conventions.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "conventions.png"
EAST, NORTH, UP = "tab:red", "tab:green", "tab:blue"


def main() -> None:
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else FIGURE
    figure = Figure(figsize=(9, 4.2), layout="constrained", facecolor="white")
    world = figure.add_subplot(1, 2, 1, projection="3d")
    photo = figure.add_subplot(1, 2, 2, projection="3d")
    draw_world(world)
    draw_angles(photo)
    figure.savefig(target, dpi=90)


def draw_world(axes: Axes3D) -> None:
    """The local frame, and COLMAP's camera in it, looking down with its top to the north."""
    axes.set_title(
        "Model: m east, north, up of the origin\nCamera: COLMAP's x right, y down, z ahead"
    )
    arrows(axes, np.zeros(3), np.eye(3), ("east", "north", "up"), (EAST, NORTH, UP), 1.0)
    centre = np.array([1.1, 1.1, 1.5])
    camera_from_world = np.diag([1.0, -1.0, -1.0])
    names = ("x", "y", "z")
    arrows(axes, centre, camera_from_world, names, ("black", "dimgray", "gray"), 0.55)
    corners = np.array([[-0.5, -0.4], [0.5, -0.4], [0.5, 0.4], [-0.5, 0.4]])
    ground = np.column_stack([corners + centre[:2], np.zeros(4)])
    outline(axes, ground, "tab:orange")
    for corner in ground:
        line(axes, np.array([centre, corner]), "tab:orange", 0.6)
    axes.text(*(ground[0] + [-0.1, -0.25, 0]), "footprint", color="tab:orange", fontsize=8)
    frame(axes)


def draw_angles(axes: Axes3D) -> None:
    """Photogrammetry's camera (y up, z back) turned by omega, then phi, then kappa."""
    axes.set_title("omega, phi, kappa: turns of the map's axes\nabout x, the new y, the new z")
    arrows(axes, np.zeros(3), np.eye(3), ("E", "N", "up"), (EAST, NORTH, UP), 1.6)
    for axis, name, colour in ((0, "omega", EAST), (1, "phi", NORTH), (2, "kappa", UP)):
        turn = np.linspace(0.2, 1.6 * np.pi, 40)
        circle = np.zeros((40, 3))
        circle[:, axis] = 1.1
        # Right-handed: from the next axis towards the one after it.
        circle[:, (axis + 1) % 3] = 0.28 * np.cos(turn)
        circle[:, (axis + 2) % 3] = 0.28 * np.sin(turn)
        line(axes, circle, colour, 1.5)
        tip = circle[-1] - circle[-3]
        axes.quiver(*circle[-2], *tip, color=colour, arrow_length_ratio=2.0)
        axes.text(*(circle[0] + 0.12), name, color=colour)
    outline(
        axes, np.array([[-0.5, -0.4, 0], [0.5, -0.4, 0], [0.5, 0.4, 0], [-0.5, 0.4, 0]]), "gray"
    )
    axes.text(-1.0, 0.2, 0, "photo, its\ntop to N", color="gray", fontsize=8)
    frame(axes)


def arrows(
    axes: Axes3D,
    start: NDArray[np.float64],
    rows: NDArray[np.float64],
    names: tuple[str, ...],
    colours: tuple[str, ...],
    length: float,
) -> None:
    for row, name, colour in zip(rows, names, colours, strict=True):
        axes.quiver(*start, *(row * length), color=colour, arrow_length_ratio=0.12)
        axes.text(*(start + row * (length + 0.1)), name, color=colour)


def outline(axes: Axes3D, corners: NDArray[np.float64], colour: str) -> None:
    line(axes, np.vstack([corners, corners[:1]]), colour, 1.5)


def line(axes: Axes3D, points: NDArray[np.float64], colour: str, width: float) -> None:
    axes.plot(*points.T, color=colour, linewidth=width)


def frame(axes: Axes3D) -> None:
    axes.set_box_aspect((1, 1, 1), zoom=1.35)
    axes.set_xlim(-0.6, 1.7)
    axes.set_ylim(-0.6, 1.7)
    axes.set_zlim(-0.1, 2.0)
    axes.set_axis_off()
    axes.view_init(elev=22, azim=-58)


if __name__ == "__main__":
    main()
