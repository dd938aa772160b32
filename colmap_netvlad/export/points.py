"""3D points as LAS 1.4, in a projected system, with colours."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np

from colmap_netvlad.export.world import World
from colmap_netvlad.runtime.files import atomic_path

SCALE = 0.001
"""Coordinates are whole thousandths of the system's units: mm, where these are m."""

WITH_COLOUR = 7
"""LAS's point format with colours and a coordinate system as WKT."""


def write_las(world: World, path: Path) -> None:
    """Write the points: easting, northing, height, colour; the system as WKT in the header."""
    points = list(world.model.points3D.values())
    local = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    colours = np.array([point.color for point in points], np.uint16).reshape(-1, 3)
    places = world.frame.to_crs(local, world.crs)
    header = laspy.LasHeader(version="1.4", point_format=WITH_COLOUR)
    header.scales = np.full(3, SCALE)
    header.offsets = np.floor(places.min(axis=0)) if len(places) else np.zeros(3)
    header.add_crs(world.crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = places.T
    # LAS keeps 16 bits a channel.
    cloud.red, cloud.green, cloud.blue = (colours * 257).T
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        cloud.write(file)
