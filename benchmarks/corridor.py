"""What position priors in the adjustment do for a corridor: three lines of 100 photos over 2.4 km.

    python benchmarks/corridor.py [--noise 2 0.02] [--seeds 3] [--lines 3] [--photos 100]

A simulated flight (features and matches with noise, no photos) with GPS of a stated noise is mapped
incrementally and in parallel, without and with its positions in the adjustment, brought into the
world, and held against its true camera centres.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.colmap.engine import silence
from colmap_netvlad.commands.georegister import georegister_in_place
from colmap_netvlad.demo.simulate import FOCAL, FRAME, RADIAL, SimulationOptions, simulate_flight
from colmap_netvlad.geo.places import find_places
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.parallel import map_parallel
from colmap_netvlad.mapping.priors import PositionPriors

CLUSTER = 60
"""Photos of a cluster of the parallel mapper; half the flight where that is less."""

HEAD = (
    "| GPS noise | mapper | positions | horizontal | vertical | largest | bend | focal | k1 | s |"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--noise", type=float, nargs="+", default=[2.0, 0.02])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--lines", type=int, default=3)
    parser.add_argument("--photos", type=int, default=100)
    arguments = parser.parse_args()
    silence()
    print(HEAD)
    print("|---" * HEAD.count(" | ") + "|---|")
    for noise in arguments.noise:
        for mapper in ("incremental", "parallel"):
            for positions in ("after", "in"):
                rows = [
                    measure(arguments.lines, arguments.photos, noise, mapper, positions, seed)
                    for seed in range(arguments.seeds)
                ]
                means = np.mean(rows, axis=0)
                cells = (
                    *(f"{value:.3f} m" for value in means[:4]),
                    f"{means[4]:+.2f} px",
                    f"{means[5]:+.5f}",
                    f"{means[6]:.0f}",
                )
                where = "aligned after" if positions == "after" else "in the adjustment"
                cells = f"{noise:g} m", mapper, where, *cells
                print("| " + " | ".join(cells) + " |", flush=True)


def measure(
    lines: int, photos: int, noise: float, mapper: str, positions: str, seed: int
) -> tuple[float, ...]:
    """Map one flight; return errors (m): horizontal, vertical, largest, bend; camera; seconds."""
    with tempfile.TemporaryDirectory() as folder:
        database, output = Path(folder, "database.db"), Path(folder, "sparse")
        truth = simulate_flight(
            database, SimulationOptions(lines=lines, photos=photos, gps=noise, seed=seed)
        )
        places = find_places(image_names(database), database, None)
        deviations = np.full(places.metres.shape, noise)
        priors = PositionPriors(places.names, places.metres, deviations)
        options = MappingOptions(
            cluster_size=min(CLUSTER, lines * photos // 2),
            priors=priors if positions == "in" else None,
        )
        run = map_parallel if mapper == "parallel" else map_incremental
        start = time.monotonic()
        models = run(database, None, output, options)
        seconds = time.monotonic() - start
        georegister_in_place(output, places, adjusted=positions == "in")
        model = pycolmap.Reconstruction(output / "0")
        assert len(models) == 1 and model.num_reg_images() == len(truth), "not in one piece"
    frame = places.frame
    assert frame is not None
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    found = FRAME.from_wgs84(frame.to_wgs84(np.array([i.projection_center() for i in images])))
    true = np.array([truth[image.name] for image in images])
    error = found - true
    along = true[:, 1]
    curve = np.polyval(np.polyfit(along, error[:, 2], 2), along)
    (camera,) = model.cameras.values()
    return (
        float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
        float(np.sqrt((error[:, 2] ** 2).mean())),
        float(np.linalg.norm(error, axis=1).max()),
        float(np.ptp(curve)),
        float(camera.params[0] - FOCAL),
        float(camera.params[3] - RADIAL),
        seconds,
    )


if __name__ == "__main__":
    main()
