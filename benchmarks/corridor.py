"""What position priors in the adjustment do for a corridor: three lines of 100 photos over 2.4 km.

    python benchmarks/corridor.py [--noise 2 0.02] [--seeds 3] [--lines 3] [--photos 100]
    python benchmarks/corridor.py --rendered FOLDER --seeds 1

A simulated flight (features and matches with noise, no photos), or one of rendered photos, their
SIFT features and matches, with GPS of a stated noise is mapped incrementally and in parallel,
without and with its positions in the adjustment, brought into the world, and held against its true
camera centres.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.colmap.engine import silence
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.commands.georegister import georegister_in_place
from colmap_netvlad.demo.render import FlightOptions, flight_exists, read_flight, render_flight
from colmap_netvlad.demo.simulate import (
    FOCAL,
    FRAME,
    RADIAL,
    SimulationOptions,
    simulate_flight,
    write_gps,
)
from colmap_netvlad.geo.places import find_places
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.parallel import map_parallel
from colmap_netvlad.mapping.priors import PositionPriors
from colmap_netvlad.matching.run import match_pairs

CLUSTER = 60
"""Photos of a cluster of the parallel mapper; half the flight where that is less."""

PARTNERS, FEATURES = 14, 1500
"""Nearest photos that a rendered one is matched with, and its features."""

HEAD = (
    "| GPS noise | mapper | positions | horizontal | vertical | largest | bend | focal | k1 | s |"
)


@dataclass(frozen=True)
class Flight:
    """What is true of a flight: camera centres by image name, focal length (px), distortion."""

    truth: dict[str, np.ndarray]
    focal: float
    radial: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--noise", type=float, nargs="+", default=[2.0, 0.02])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--lines", type=int, default=3)
    parser.add_argument("--photos", type=int, default=100)
    parser.add_argument("--mappers", nargs="+", default=["incremental", "parallel"])
    parser.add_argument("--positions", choices=["after", "in"], nargs="+", default=["after", "in"])
    parser.add_argument("--rendered", type=Path, help="folder of a flight of rendered photos")
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()
    silence()
    print(HEAD)
    print("|---" * HEAD.count(" | ") + "|---|")
    for noise in arguments.noise:
        for mapper in arguments.mappers:
            for positions in arguments.positions:
                rows = [
                    measure(arguments, noise, mapper, positions, seed)
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


def rendered(arguments: argparse.Namespace, database: Path, noise: float, seed: int) -> Flight:
    """Write a database of rendered photos, matched with their nearest; made once in a folder."""
    folder = arguments.rendered
    options = FlightOptions(
        arguments.lines, arguments.photos, width=480, height=360, ground="country"
    )
    flight = (
        read_flight(folder) if flight_exists(folder, options) else render_flight(folder, options)
    )
    matched = folder / "matched.db"
    if not matched.exists():
        made = folder / "making.db"
        extract_features(flight.images, made, FeatureOptions(max_features=FEATURES))
        partners = min(PARTNERS, len(flight.names) - 1)
        _, near = cKDTree(flight.centres).query(flight.centres, partners + 1)
        pairs = {tuple(sorted((i, int(j)))) for i, row in enumerate(near) for j in row if i != j}
        match_pairs(made, [(flight.names[i], flight.names[j]) for i, j in sorted(pairs)])
        made.rename(matched)
    shutil.copyfile(matched, database)
    opened = pycolmap.Database.open(database)
    with pycolmap.DatabaseTransaction(opened):
        opened.clear_pose_priors()
        write_gps(opened, list(flight.names), flight.centres, noise, seed)
    opened.close()
    return Flight(dict(zip(flight.names, flight.centres, strict=True)), flight.focal, 0.0)


def simulated(arguments: argparse.Namespace, database: Path, noise: float, seed: int) -> Flight:
    """Write a database of simulated features and matches."""
    options = SimulationOptions(
        lines=arguments.lines, photos=arguments.photos, gps=noise, seed=seed
    )
    return Flight(simulate_flight(database, options), FOCAL, RADIAL)


def measure(
    arguments: argparse.Namespace, noise: float, mapper: str, positions: str, seed: int
) -> tuple[float, ...]:
    """Map one flight; return errors (m): horizontal, vertical, largest, bend; camera; seconds."""
    with tempfile.TemporaryDirectory() as folder:
        database, output = Path(folder, "database.db"), Path(folder, "sparse")
        make = rendered if arguments.rendered else simulated
        flight = make(arguments, database, noise, seed)
        truth = flight.truth
        places = find_places(image_names(database), database, None)
        deviations = np.full(places.metres.shape, noise)
        priors = PositionPriors(places.names, places.metres, deviations)
        options = MappingOptions(
            cluster_size=min(CLUSTER, len(truth) // 2),
            threads=arguments.threads,
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
        float(camera.params[0] - flight.focal),
        float(camera.params[3] - flight.radial),
        seconds,
    )


if __name__ == "__main__":
    main()
