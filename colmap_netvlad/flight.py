"""What a command reads of a project, once."""

from __future__ import annotations

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.photos.positions import Positions, place, read_gps
from colmap_netvlad.project import Project
from colmap_netvlad.runtime import progress


def read_positions(project: Project) -> Positions:
    """Return the positions of all images, in the order of the database.

    The database's priors come first; photos it has none for are asked for their EXIF GPS where
    the photo folder is known. Cartesian and WGS84 priors are not mixed: the larger group counts.
    """
    with open_database(project.database) as database:
        images = database.images()
        priors = database.pose_priors()
    found = [priors.get(image.image_id) for image in images]
    missing = [i for i, prior in enumerate(found) if prior is None]
    if missing and project.images is not None and project.images.is_dir():
        with progress.step("Reading GPS of photos", len(missing)) as bar:
            for i in missing:
                found[i] = read_gps(project.images / images[i].name)
                bar.advance()
    return place(found, [image.name for image in images])
