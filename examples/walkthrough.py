"""A walk through the library: from photos to a sparse model in five calls.

    python examples/walkthrough.py [FOLDER]

renders a small flight into FOLDER (default: walkthrough) and reconstructs it. With your own
photos, leave the first call out and point `photos` to their folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.commands.reconstruct import reconstruct
from colmap_netvlad.demo.render import FlightOptions, render_flight
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.project import open_project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project


def main(folder: Path, method: str = DEFAULT) -> None:
    flight = render_flight(folder, FlightOptions(rows=3, columns=5, width=480, height=360))
    photos, database = flight.images, folder / "project.db"

    # Photos -> SIFT features in a COLMAP database.
    extract_features(photos, database, FeatureOptions(max_features=2500))
    project = open_project(database, photos)

    # Photos -> global descriptors -> a ranking: the partners of each image, best first.
    ranking = rank_project(project, method, RetrievalOptions(k=6))
    best = ranking.names[ranking.partners[0, 0]]
    print(f"{ranking.names[0]} looks most like {best} (score {ranking.scores[0, 0]:.3f}).")

    # The same as a pairs list on disk; descriptors are in the project's cache by now.
    make_pairs(project, method, RetrievalOptions(k=6))

    # Pairs -> verified matches -> sparse models in sparse/0, 1, ...
    report = reconstruct(project)
    print(
        f"{report.total.registered} of {report.images} photos registered, "
        f"{report.total.points:,} points, "
        f"{report.total.mean_reprojection_error:.2f} px mean reprojection error."
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "walkthrough"), *sys.argv[2:])
