"""What a command reads of a project: once, and passed on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

from colmap_netvlad.cache.photos import gps_positions
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import Database, ImageRow, open_database
from colmap_netvlad.photos.positions import Positions, place
from colmap_netvlad.project import Project


@dataclass(frozen=True, eq=False)
class Flight:
    """The images of a project and what the database says of them. Made by `open_flight`.

    Everything that ranks takes one, so that a command reads its database and its cache once.

    Attributes:
        project: where database, photos and cache are.
        images: N images in the order of their ids, the order of all rankings.
        keypoints, descriptors: how many an image has, by image id; images without are absent.
        frames: rig frame by image id; empty where the database has none.
        database: open, read only.
        store: the project's cache, open.
    """

    project: Project
    images: tuple[ImageRow, ...]
    keypoints: Mapping[int, int]
    descriptors: Mapping[int, int]
    frames: Mapping[int, int]
    database: Database
    store: Store

    @cached_property
    def names(self) -> tuple[str, ...]:
        """N image names, relative to the photo folder."""
        return tuple(image.name for image in self.images)

    @cached_property
    def features(self) -> dict[int, str]:
        """Fingerprint of each image's SIFT features, by image id; images without are absent."""
        return self.database.feature_fingerprints()

    @cached_property
    def positions(self) -> Positions:
        """Where the photos were taken: the database's priors, else GPS in the photos' EXIF.

        Cartesian and WGS84 priors are not mixed: the larger group counts.
        """
        priors = self.database.pose_priors()
        missing = [image.name for image in self.images if image.image_id not in priors]
        folder = self.project.images
        gps = {}
        if missing and folder is not None and folder.is_dir():
            gps = gps_positions(self.store, {name: folder / name for name in missing})
        found = [priors.get(image.image_id) or gps.get(image.name) for image in self.images]
        return place(found, self.names)


@contextmanager
def open_flight(project: Project) -> Iterator[Flight]:
    """Read a project's images; its database (read only) and its cache stay open in the block.

    Raises:
        InputError: the database or the cache cannot be read.
    """
    with open_database(project.database) as database, Store(project.cache) as store:
        if project.images is not None:
            store.remember_images(project.images)
        yield Flight(
            project,
            tuple(database.images()),
            database.keypoint_counts(),
            database.descriptor_counts(),
            database.frames(),
            database,
            store,
        )
