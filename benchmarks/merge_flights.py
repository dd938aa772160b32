"""Two flights mapped apart and merged, against the model made at once.

    python benchmarks/merge_flights.py project.db --images images --cut DJI_0135.jpg

The database has features and matches (`pairs`, then `match`) and is left as it is. Photos from CUT
on, by name, are the second flight. Each is mapped from its own matches; `merge` then finds the
pairs across. Camera centres of the merged model are compared with those of the model of all photos
at once, after a similarity, as a share of the extent.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
import pycolmap

from colmap_netvlad.colmap.copies import copy_database, copy_images
from colmap_netvlad.colmap.database import image_names, open_database, pair_id
from colmap_netvlad.colmap.engine import silence
from colmap_netvlad.commands.merge import MergeOptions, merge_lines, merge_models
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.project import Project


@click.command()
@click.argument("database", type=click.Path(path_type=Path, exists=True))
@click.option("--images", type=click.Path(path_type=Path, exists=True), required=True)
@click.option("--cut", required=True, help="First photo of the second flight, by name.")
@click.option("--method", default="vlad", show_default=True)
@click.option("--whole", type=click.Path(path_type=Path), help="The model made at once, if there.")
@click.option("--parts", nargs=2, type=click.Path(path_type=Path), help="The flights' models.")
def main(
    database: Path,
    images: Path,
    cut: str,
    method: str,
    whole: Path | None,
    parts: tuple[Path, Path] | None,
) -> None:
    silence()
    names = image_names(database)
    flights = [[n for n in names if n < cut], [n for n in names if n >= cut]]
    with TemporaryDirectory(dir=database.parent) as folder:
        copy = Path(folder, "project.db")
        copy_database(database, copy, matches=True)
        forget_across(copy, flights)
        if whole is None:
            (once, *_) = map_incremental(database, None, Path(folder, "whole"), MappingOptions())
        else:
            once = pycolmap.Reconstruction(whole)
        models = list(parts or [])
        for number, flight in enumerate(flights if not models else []):
            own = Path(folder, f"{number}.db")
            copy_images(database, own, flight)
            map_incremental(own, None, Path(folder, str(number)), MappingOptions())
            models.append(Path(folder, str(number)))
        report = merge_models(
            Project(copy, images), models, Path(folder, "merged"), MergeOptions(method)
        )
        print("\n".join(merge_lines(report)))
        merged = pycolmap.Reconstruction(Path(folder, "merged", "0"))
    found, true = centres(merged), centres(once)
    common = sorted(found.keys() & true.keys())
    a, b = (np.array([place[name] for name in common]) for place in (found, true))
    matrix = pycolmap.estimate_sim3d(a, b).matrix()
    apart = np.linalg.norm(a @ matrix[:, :3].T + matrix[:, 3] - b, axis=1)
    extent = float(np.linalg.norm(np.ptp(b, axis=0)))
    print(
        f"{len(common)} common images; merged against at once: mean {apart.mean() / extent:.4%}, "
        f"largest {apart.max() / extent:.4%} of the extent"
    )
    for name, model in (("at once", once), ("merged", merged)):
        model.update_point_3d_errors()
        print(
            f"{name}: {model.num_reg_images()} images, {model.num_points3D():,} points, "
            f"{model.compute_mean_reprojection_error():.3f} px, track length "
            f"{model.compute_mean_track_length():.2f}"
        )


def forget_across(database: Path, flights: list[list[str]]) -> None:
    """Delete the matches between photos of different flights."""
    with open_database(database) as opened:
        home = {row.image_id: row.name in flights[1] for row in opened.images()}
        across = [p for p in opened.verified_matches() if home[p[0]] != home[p[1]]]
    with closing(sqlite3.connect(database)) as connection:
        for table in ("matches", "two_view_geometries"):
            connection.executemany(
                f"DELETE FROM {table} WHERE pair_id = ?", [(pair_id(*pair),) for pair in across]
            )
        connection.commit()


def centres(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image.projection_center() for image in images}


if __name__ == "__main__":
    main()
