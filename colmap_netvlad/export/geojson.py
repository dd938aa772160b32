"""GeoJSON (RFC 7946: WGS84, longitude first): cameras, footprints, pairs and weak links."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.export.world import World
from colmap_netvlad.runtime.files import write_atomically

DEGREES, HEIGHT = 9, 4
"""Decimals of degrees (0.1 mm) and of m."""

STEEP = 0.2
"""A footprint's rays point down at least this much: an oblique photo's upper edge has none on the
ground."""


def write_cameras(world: World, path: Path) -> None:
    """Write a point for each camera, with its name, camera and number of 3D points."""
    _, articulation = world.weak
    write_features(
        path,
        (
            feature(
                "Point",
                position(place),
                name=image.name,
                camera=image.camera_id,
                points=image.num_points3D,
                weak=image.name in articulation,
            )
            for image, place in zip(world.images, world.wgs84, strict=True)
        ),
    )


def write_footprints(world: World, path: Path) -> None:
    """Write the outline of each photo on level ground at the median height of its points.

    Photos that look to the horizon have none and are left out, and so are those of a lens whose
    distortion has no inverse in a corner.
    """
    found = []
    for image in world.images:
        outline = footprint(world.model, image)
        if outline is None:
            continue
        ring = [position(place)[:2] for place in world.geographic(outline)]
        found.append(feature("Polygon", [[*ring, ring[0]]], name=image.name))
    write_features(path, found)


def write_pairs(world: World, path: Path) -> None:
    """Write a line for each pair: its matches, and whether the flight hangs on it."""
    place = {
        image.name: position(there) for image, there in zip(world.images, world.wgs84, strict=True)
    }
    bridges, _ = world.weak
    write_features(
        path,
        (
            feature(
                "LineString",
                [place[first], place[second]],
                name1=first,
                name2=second,
                matches=count,
                weak=(min(first, second), max(first, second)) in bridges,
            )
            for (first, second), count in world.pairs.items()
        ),
    )


def footprint(model: pycolmap.Reconstruction, image: pycolmap.Image) -> NDArray[np.float64] | None:
    """Return (4, 3) corners of a photo on the ground, counterclockwise; None if they are not."""
    seen = [model.point3D(p.point3D_id).xyz[2] for p in image.points2D if p.has_point3D()]
    if not seen:
        return None
    camera = model.camera(image.camera_id)
    width, height = float(camera.width), float(camera.height)
    corners = np.array([[0, 0], [0, height], [width, height], [width, 0]])
    rays = np.column_stack([camera.cam_from_img(corners), np.ones(4)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays @ image.cam_from_world().rotation.matrix()
    centre = image.projection_center()
    above = centre[2] - float(np.median(seen))
    # A corner has no ray (NaN) where the lens's distortion has no inverse, beyond any scene.
    if above <= 0 or not (rays[:, 2] <= -STEEP).all():
        return None
    ground: NDArray[np.float64] = centre - rays * (above / rays[:, 2:])
    return ground


def feature(kind: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    """Return a GeoJSON feature."""
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def position(place: NDArray[np.float64]) -> list[float]:
    """Return longitude, latitude, height of latitude, longitude, height, rounded."""
    latitude, longitude, height = place.tolist()
    return [round(longitude, DEGREES), round(latitude, DEGREES), round(height, HEIGHT)]


def write_features(path: Path, features: Iterable[dict[str, Any]]) -> None:
    """Write a collection, a feature a line."""
    rows = ",\n".join(json.dumps(one, ensure_ascii=False) for one in features)
    write_atomically(path, f'{{"type": "FeatureCollection", "features": [\n{rows}\n]}}\n')
