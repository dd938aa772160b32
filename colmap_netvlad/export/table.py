"""Cameras as CSV: name, easting, northing, height, omega, phi, kappa."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.export.world import World
from colmap_netvlad.runtime.files import write_atomically

COLUMNS = ("name", "easting", "northing", "height", "omega", "phi", "kappa")


def write_table(world: World, path: Path) -> None:
    """Write a row for each camera: the system's units, and degrees (see `omega_phi_kappa`)."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    angles = omega_phi_kappa(world.rotations)
    for image, place, angle in zip(world.images, world.projected, angles, strict=True):
        numbers = [f"{value:.4f}" for value in place] + [f"{value:.6f}" for value in angle]
        rows.writerow([image.name, *numbers])
    write_atomically(path, text.getvalue())


def omega_phi_kappa(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3) omega, phi, kappa in degrees of (N, 3, 3) COLMAP rotations from a map system.

    Photogrammetry's camera has y up and z backwards, so that a nadir photo with its top to the
    north has angles of zero. The map's axes are turned by omega about x, then by phi about the
    new y, then by kappa about the new z into those of the camera.
    """
    m = np.diag([1.0, -1.0, -1.0]) @ rotations
    omega = np.arctan2(-m[:, 2, 1], m[:, 2, 2])
    phi = np.arcsin(np.clip(m[:, 2, 0], -1, 1))
    kappa = np.arctan2(-m[:, 1, 0], m[:, 0, 0])
    return np.degrees(np.column_stack([omega, phi, kappa]))
