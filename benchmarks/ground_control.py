"""What ground points do for a corridor: three lines of 100 photos over 2.4 km, GPS of 2 m.

    python benchmarks/ground_control.py [--seeds 3]

A simulated flight is mapped without its positions in the adjustment, aligned to ten ground points
with marks of 0.5 px noise, eight of them control and two check points, and adjusted with them.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from colmap_netvlad.colmap.engine import silence
from colmap_netvlad.demo.simulate import (
    FRAME,
    SimulationOptions,
    simulate_control,
    simulate_flight,
)
from colmap_netvlad.geo.gcp import (
    adjust_to_control,
    align_to_control,
    measure_control,
    read_control,
)
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions

CHECK = ("GCP3", "GCP8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--lines", type=int, default=3)
    parser.add_argument("--photos", type=int, default=100)
    arguments = parser.parse_args()
    silence()
    found = [measure(arguments.lines, arguments.photos, seed) for seed in range(arguments.seeds)]
    print("| ground points | control: horizontal, vertical | check: horizontal, vertical |")
    print("|---|---|---|")
    for name, row in zip(("aligned to", "and adjusted with"), np.mean(found, axis=0), strict=True):
        print(f"| {name} | {row[0]:.3f}, {row[1]:.3f} m | {row[2]:.3f}, {row[3]:.3f} m |")


def measure(lines: int, photos: int, seed: int) -> list[tuple[float, ...]]:
    """Return the root mean squares (m) of control and check points after each of both steps."""
    options = SimulationOptions(lines=lines, photos=photos, gps=2.0, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        database, listed = Path(folder, "database.db"), Path(folder, "gcp_list.txt")
        truth = simulate_flight(database, options)
        simulate_control(listed, options, rows=5, columns=2)
        control = read_control(listed, truth, CHECK)
        (model,) = map_incremental(database, None, Path(folder, "sparse"), MappingOptions())
    steps: list[tuple[float, ...]] = []
    model.transform(align_to_control(model, control, FRAME))
    steps.append(both(model, control))
    adjust_to_control(model, control, FRAME)
    steps.append(both(model, control))
    return steps


def both(model: pycolmap.Reconstruction, control: object) -> tuple[float, ...]:
    report = measure_control(model, control, FRAME)  # type: ignore[arg-type]
    return (*report.rms(check=False), *report.rms(check=True))


if __name__ == "__main__":
    main()
