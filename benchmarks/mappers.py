"""All mappers on one matched database, in one run: the same report, and how far from incremental.

    python benchmarks/mappers.py DATABASE [--images FOLDER] [--cluster-size 60]

Every mapper works on its own copy of the database. Camera centres are compared with those of
the incremental model after a similarity alignment, over the largest extent of that model.
CPU seconds count all threads and worker processes: on a busy machine they say more than minutes.
"""

from __future__ import annotations

import resource
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
import pycolmap
from rich.console import Console
from rich.table import Table

from colmap_netvlad.colmap import engine
from colmap_netvlad.mapping import MAPPERS
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.summary import combine
from colmap_netvlad.terminal import Command

NAMES = ("incremental", "parallel", "hierarchical", "global")


def cpu_seconds() -> float:
    """Return the processor time of this process and of all that it started and that ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in used)


def centres(models: Sequence[pycolmap.Reconstruction]) -> dict[str, np.ndarray]:
    """Return the camera centres of the largest model by image name."""
    model = max(models, key=lambda model: model.num_reg_images())
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image.projection_center() for image in images}


def offsets(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> np.ndarray:
    """Return distances of common centres after alignment, over the extent of `other`."""
    names = sorted(one.keys() & other.keys())
    a, b = (np.array([centre[name] for name in names]) for centre in (one, other))
    matrix = pycolmap.estimate_sim3d(a, b).matrix()
    return np.linalg.norm(a @ matrix[:, :3].T + matrix[:, 3] - b, axis=1) / np.ptp(b, axis=0).max()


@click.command(cls=Command)
@click.argument("database", type=click.Path(path_type=Path, exists=True))
@click.option("--images", type=click.Path(path_type=Path, exists=True))
@click.option("--cluster-size", default=60, show_default=True)
@click.option("--threads", default=2, show_default=True)
@click.option("--mapper", "mappers", multiple=True, default=NAMES, show_default=True)
@click.option("--keep", type=click.Path(path_type=Path), help="Keep the models in this folder.")
def main(
    database: Path,
    images: Path | None,
    cluster_size: int,
    threads: int,
    mappers: tuple[str, ...],
    keep: Path | None,
) -> None:
    """Run the mappers one after another and print one table."""
    engine.silence()
    options = MappingOptions(cluster_size=cluster_size, threads=threads)
    table = Table(
        "mapper", "registered", "points", "error px", "track", "observations",
        "centre offset % of extent: median", "max", "minutes", "CPU s",
    )  # fmt: skip
    reference: dict[str, np.ndarray] | None = None
    with tempfile.TemporaryDirectory() as scratch:
        for mapper in mappers:
            copy = Path(scratch) / f"{mapper}.db"
            shutil.copy(database, copy)
            start, used = time.monotonic(), cpu_seconds()
            models = MAPPERS[mapper](copy, images, (keep or Path(scratch)) / mapper, options)
            minutes, used = (time.monotonic() - start) / 60, cpu_seconds() - used
            if not models:
                table.add_row(mapper, "0", *[""] * 6, f"{minutes:.1f}", f"{used:.0f}")
                continue
            figures, found = combine(models), centres(models)
            reference = reference or found
            away = 100 * offsets(found, reference)
            table.add_row(
                mapper + (f" ({len(models)} models)" if len(models) > 1 else ""),
                f"{figures.registered}",
                f"{figures.points}",
                f"{figures.mean_reprojection_error:.4f}",
                f"{figures.mean_track_length:.2f}",
                f"{figures.observations}",
                f"{np.median(away):.4f}",
                f"{away.max():.4f}",
                f"{minutes:.1f}",
                f"{used:.0f}",
            )
            print(f"{mapper}: {minutes:.1f} min", flush=True)
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
