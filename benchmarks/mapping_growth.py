"""How mapping grows with the flight: incremental, COLMAP's hierarchical, and ours.

    python benchmarks/mapping_growth.py --sizes 100,250,500,1000,2000 --output growth.csv

Each mapper maps the same simulated flight (`colmap_netvlad.demo.simulate`) in a process of its
own on the same two processors. Accuracy is the distance of camera centres from the true ones
after a similarity alignment, in metres at 100 m flying height. Memory is the resident memory of
all its processes together, sampled. Runs that are in the CSV already are not done again.
"""

from __future__ import annotations

import csv
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import numpy as np
import pycolmap
from rich.console import Console
from rich.table import Table

from colmap_netvlad.colmap import engine
from colmap_netvlad.demo.simulate import SimulationOptions, simulate_flight
from colmap_netvlad.mapping import MAPPERS
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.summary import summarize
from colmap_netvlad.terminal import Command

FIELDS = (
    "images", "mapper", "models", "registered", "points", "error_px",
    "rms_m", "max_m", "wall_s", "cpu_s", "peak_mib", "load",
)  # fmt: skip

SAMPLE_SECONDS = 0.25


def shape(size: int) -> tuple[int, int]:
    """Return lines and photos a line of a flight that is about square on the ground."""
    lines = max(2, round((size * 24 / 45) ** 0.5))
    return lines, round(size / lines)


def truth_of(database: Path, size: int) -> dict[str, np.ndarray]:
    """Simulate a flight of about `size` images."""
    lines, photos = shape(size)
    return simulate_flight(database, SimulationOptions(lines=lines, photos=photos))


def session_bytes(session: int) -> int:
    """Return the resident memory of all processes of a session (Linux)."""
    total = 0
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session:
            total += int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
    return total


def measure(database: Path, mapper: str, threads: int, output: Path) -> dict[str, float]:
    """Run one mapper in a session of its own."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start, load = time.monotonic(), os.getloadavg()[0]
    command = [sys.executable, __file__, "--one", mapper, "--threads", str(threads)]
    process = subprocess.Popen(
        [*command, "--database", str(database), "--output", str(output)], start_new_session=True
    )
    peak = 0
    while process.poll() is None:
        peak = max(peak, session_bytes(process.pid))
        time.sleep(SAMPLE_SECONDS)
    wall = time.monotonic() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": wall, "cpu_s": cpu, "peak_mib": peak / 2**20, "load": load}


def judge(output: Path, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the figures of the largest model, and its distance from the truth."""
    models = [pycolmap.Reconstruction(path) for path in sorted(output.iterdir())]
    model = max(models, key=lambda model: model.num_reg_images())
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    found = np.array([image.projection_center() for image in images])
    true = np.array([truth[image.name] for image in images])
    matrix = pycolmap.estimate_sim3d(found, true).matrix()
    away = np.linalg.norm(found @ matrix[:, :3].T + matrix[:, 3] - true, axis=1)
    figures = summarize(model)
    return {
        "models": len(models),
        "registered": figures.registered,
        "points": figures.points,
        "error_px": figures.mean_reprojection_error,
        "rms_m": float(np.sqrt((away**2).mean())),
        "max_m": float(away.max()),
    }


def read(path: Path) -> list[dict[str, str]]:
    """Return the rows measured so far."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def show(rows: list[dict[str, str]]) -> None:
    """Print the table."""
    table = Table(*FIELDS)
    for row in sorted(rows, key=lambda row: int(row["images"])):
        table.add_row(*(row[field] for field in FIELDS))
    Console(width=150).print(table)


@click.command(cls=Command)
@click.option("--sizes", default="100,250,500,1000,2000", show_default=True)
@click.option("--mapper", "mappers", default="incremental,hierarchical,parallel")
@click.option("--threads", default=2, show_default=True)
@click.option("--output", type=click.Path(path_type=Path), default=Path("growth.csv"))
@click.option("--one", hidden=True)
@click.option("--database", type=click.Path(path_type=Path), hidden=True)
def main(
    sizes: str, mappers: str, threads: int, output: Path, one: str | None, database: Path | None
) -> None:
    """Measure and print; rows go to the CSV as they come."""
    if one is not None and database is not None:
        engine.silence()
        MAPPERS[one](database, None, output, MappingOptions(threads=threads))
        return
    for size in map(int, sizes.split(",")):
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            truth = truth_of(folder / "flight.db", size)
            done = {row["mapper"] for row in read(output) if int(row["images"]) == len(truth)}
            for mapper in mappers.split(","):
                if mapper in done:
                    continue
                figures = measure(folder / "flight.db", mapper, threads, folder / mapper)
                figures |= judge(folder / mapper, truth)
                row = {"images": f"{len(truth)}", "mapper": mapper}
                row |= {key: f"{value:.4g}" for key, value in figures.items()}
                fresh = not output.exists()
                with output.open("a", newline="") as file:
                    writer = csv.DictWriter(file, FIELDS)
                    if fresh:
                        writer.writeheader()
                    writer.writerow(row)
    show(read(output))


if __name__ == "__main__":
    main()
