"""OpenDroneMap's `shots.geojson`: where WebODM and its neighbours look for cameras."""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from colmap_netvlad.export.geojson import feature, position, write_features
from colmap_netvlad.export.world import World


def write_shots(world: World, path: Path) -> None:
    """Write a point for each camera in OpenDroneMap's layout.

    `translation` is easting, northing, height of the camera in the system's units; `rotation` the
    axis and angle (rad) of camera from projected system, x right, y down, z ahead (OpenSfM's camera
    is COLMAP's); `focal` the focal length as a share of the photo's longer side.
    """
    turns = Rotation.from_matrix(world.rotations).as_rotvec()
    found = []
    for i, image in enumerate(world.images):
        camera = world.model.camera(image.camera_id)
        longer = max(camera.width, camera.height)
        found.append(
            feature(
                "Point",
                position(world.wgs84[i]),
                filename=image.name,
                focal=round(float(camera.mean_focal_length()) / longer, 8),
                width=camera.width,
                height=camera.height,
                translation=[round(value, 4) for value in world.projected[i].tolist()],
                rotation=[round(value, 10) for value in turns[i].tolist()],
            )
        )
    write_features(path, found)
