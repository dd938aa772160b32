"""What the formats share: a model's cameras and points in WGS84 and in a projected system."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import networkx as nx
import numpy as np
import pycolmap
from numpy.typing import NDArray
from pyproj import CRS
from scipy import sparse

from colmap_netvlad.geo.frames import LocalFrame

Array = NDArray[np.float64]
Pair = tuple[str, str]

STEP = 1.0
"""m over which the axes of a projected system are taken at a camera."""

ENOUGH_SHARED = 15
"""Common 3D points from which two images count as a pair where no database says."""


@dataclass(frozen=True, eq=False)
class World:
    """A georegistered model.

    Attributes:
        model: in m of `frame`.
        frame: local east-north-up.
        crs: the projected system of tables and point clouds.
        verified: verified matches by pair of image names, from a database; None: pairs are those
            with common 3D points in the model.
    """

    model: pycolmap.Reconstruction
    frame: LocalFrame
    crs: CRS
    verified: dict[Pair, int] | None = field(default=None)

    def geographic(self, metres: Array) -> Array:
        """Return (N, 3) latitude, longitude (degrees), height (m) of (N, 3) m of the frame.

        Longitudes run on over 180 degrees, so that no outline goes around the globe.
        """
        places = self.frame.to_wgs84(metres)
        places[:, 1] += 360 * np.round((self.frame.longitude - places[:, 1]) / 360)
        return places

    @cached_property
    def images(self) -> list[pycolmap.Image]:
        """The N registered images by name."""
        images = [self.model.image(image_id) for image_id in self.model.reg_image_ids()]
        return sorted(images, key=lambda image: image.name)

    @cached_property
    def centres(self) -> Array:
        """(N, 3) camera centres, m of the frame."""
        return np.array([image.projection_center() for image in self.images]).reshape(-1, 3)

    @cached_property
    def wgs84(self) -> Array:
        """(N, 3) latitude, longitude (degrees), height (m) of the cameras."""
        return self.geographic(self.centres)

    @cached_property
    def projected(self) -> Array:
        """(N, 3) easting, northing, height of the cameras, in the projected system's units."""
        return self.frame.to_crs(self.centres, self.crs)

    @cached_property
    def rotations(self) -> Array:
        """(N, 3, 3) camera (x right, y down, z ahead) from the projected system's axes.

        The axes turn from place to place: by the meridian convergence, and with the vertical.
        """
        columns = [
            self.frame.to_crs(self.centres + step, self.crs)
            - self.frame.to_crs(self.centres - step, self.crs)
            for step in STEP * np.eye(3)
        ]
        # Nearest rotation: the projection's scale is none of the camera's.
        u, _, vt = np.linalg.svd(np.stack(columns, axis=2))
        crs_from_frame = u @ vt
        cam_from_frame = np.array(
            [image.cam_from_world().rotation.matrix() for image in self.images]
        ).reshape(-1, 3, 3)
        return cam_from_frame @ crs_from_frame.transpose(0, 2, 1)

    @cached_property
    def pairs(self) -> dict[Pair, int]:
        """Matches (or common 3D points) of each pair of registered images, names in order."""
        if self.verified is not None:
            names = {image.name for image in self.images}
            return {
                pair: count
                for pair, count in sorted(self.verified.items())
                if count and names.issuperset(pair)
            }
        return self._common_points()

    @cached_property
    def weak(self) -> tuple[set[Pair], set[str]]:
        """Pairs and images without which the flight falls apart: bridges, articulation images."""
        graph = nx.Graph(list(self.pairs))
        bridges = {(min(pair), max(pair)) for pair in nx.bridges(graph)}
        return bridges, set(nx.articulation_points(graph))

    def _common_points(self) -> dict[Pair, int]:
        row = {image.image_id: i for i, image in enumerate(self.images)}
        seen = [
            (row[element.image_id], column)
            for column, point in enumerate(self.model.points3D.values())
            for element in point.track.elements
        ]
        i, j = np.array(seen, np.int64).reshape(-1, 2).T
        shape = (len(row), self.model.num_points3D())
        sees = sparse.csr_array((np.ones(len(i), np.int64), (i, j)), shape=shape)
        common = sparse.triu(sees @ sees.T, k=1).tocoo()
        names = [image.name for image in self.images]
        return {
            (names[a], names[b]): count
            for a, b, count in sorted(
                zip(common.row.tolist(), common.col.tolist(), common.data.tolist(), strict=True)
            )
            if count >= ENOUGH_SHARED
        }
