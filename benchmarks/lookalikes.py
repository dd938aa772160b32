"""How well look-alikes are found: precision and recall against the true poses of a flight.

    python benchmarks/lookalikes.py PHOTOS DATABASE [--render first | --render held-out]

With --render, a flight over copies of one estate is rendered first (PHOTOS is its folder
`images`), its features extracted and each photo's 20 nearest matched: the flight on which the
limits were chosen (96 photos, pairs by the default method), or one that was looked at once they
stood (68 photos, another estate, crossing lines higher up, pairs by vlad). There a verified pair
is a look-alike where its matches join different places. On other databases, with verified pairs,
what would be dropped is counted and listed, to be looked at.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from colmap_netvlad.colmap.database import Database, open_database
from colmap_netvlad.demo.render import (
    TRUTH_FILE,
    FlightOptions,
    RenderedFlight,
    read_flight,
    render_flight,
)
from colmap_netvlad.graph.lookalikes import Moves, fit_plan, judge_moves, read_moves
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.project import Project

APART = 10.0
"""Matches join different places where they lie this far apart on the ground, m."""


def wrong_pairs(flight: RenderedFlight, database: Database, moves: Moves) -> set[Pair]:
    """Return the pairs whose matches join different places: more than `APART` m in the median."""
    ids = {row.name: row.image_id for row in database.images()}
    photo = {name: i for i, name in enumerate(flight.names)}

    def ground(name: str, keypoints: np.ndarray) -> np.ndarray:
        i = photo[name]
        half = (keypoints - [flight.width / 2, flight.height / 2]) / flight.focal
        rays = np.column_stack([half, np.ones(len(half))]) @ flight.rotations[i]
        centre = flight.centres[i]
        return centre[:2] - rays[:, :2] / rays[:, 2:] * centre[2]

    wrong = set()
    for i, j in moves.edges.tolist():
        a, b = moves.names[i], moves.names[j]
        matches = database.inlier_matches(ids[a], ids[b])
        first = ground(a, database.keypoints(ids[a])[matches[:, 0]])
        second = ground(b, database.keypoints(ids[b])[matches[:, 1]])
        if np.median(np.linalg.norm(first - second, axis=1)) > APART:
            wrong.add(as_pair(a, b))
    return wrong


FLIGHTS = {
    "first": (FlightOptions(rows=8, columns=12, ground="copies"), DEFAULT),
    "held-out": (
        FlightOptions(rows=6, columns=9, cross_rows=2, overlap=0.65, ground="copies", seed=5),
        "vlad",
    ),
}
"""What is rendered, and the method that chooses the pairs."""

K = 20
"""Partners of a photo that are matched."""


def render(images: Path, database: Path, which: str) -> None:
    """Render a flight over copies, and match each photo's nearest."""
    from colmap_netvlad.colmap.features import FeatureOptions
    from colmap_netvlad.commands.features import import_photos
    from colmap_netvlad.commands.match import match
    from colmap_netvlad.commands.pairs import make_pairs
    from colmap_netvlad.retrieval.options import RetrievalOptions

    options, method = FLIGHTS[which]
    render_flight(images.parent, options)
    import_photos(images, database, FeatureOptions(max_features=2500))
    project = Project(database, images)
    match(project, make_pairs(project, method, RetrievalOptions(k=K)))


def positions_of(project: Project) -> dict[str, np.ndarray]:
    """Return the known positions of the photos, m."""
    from colmap_netvlad.flight import open_flight

    with open_flight(project) as flight:
        metres = flight.positions.metres
        return {
            name: row
            for name, row in zip(flight.names, metres, strict=True)
            if np.isfinite(row).all()
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path, help="photo folder")
    parser.add_argument("database", type=Path)
    parser.add_argument("--render", choices=FLIGHTS, help="render and match this flight first")
    arguments = parser.parse_args()
    if arguments.render:
        render(arguments.images, arguments.database, arguments.render)
    project = Project(arguments.database, arguments.images)
    truth = arguments.images.parent / TRUTH_FILE
    with open_database(arguments.database) as database:
        moves = read_moves(database)
        wrong = None
        if truth.is_file():
            wrong = wrong_pairs(read_flight(truth.parent), database, moves)
    pairs = [as_pair(moves.names[i], moves.names[j]) for i, j in moves.edges.tolist()]
    plan = fit_plan(moves)
    judged = np.isfinite(plan.beside)
    print(f"{len(moves.names)} photos, {len(pairs):,} verified pairs, {judged.sum():,} judged")
    if wrong is not None:
        print(f"{len(wrong):,} of them are look-alikes: their matches join different places")
    for title, positions in (("without GPS", {}), ("with GPS", positions_of(project))):
        found = judge_moves(moves, positions)
        dropped = {one.pair for one in found if one.contradicted}
        crowded = sum(not one.contradicted for one in found)
        line = f"{title}: {len(dropped):,} contradicted, {crowded:,} crowded"
        if wrong is not None:
            right = len(dropped & wrong)
            true = len(pairs) - len(wrong)
            line += (
                f"; precision {right / max(len(dropped), 1):.3f}, "
                f"recall {right / max(len(wrong), 1):.3f}, "
                f"true pairs dropped {len(dropped - wrong)} of {true:,}"
            )
        print(line)
        for one in found[: 0 if wrong is not None else 5]:
            print(f"  {one.pair[0]} {one.pair[1]} {one.inliers}: {one.reason}")
    if judged.any():
        shares = np.percentile(plan.beside[judged], [50, 90, 99, 100])
        print("beside the plan, photo widths, 50/90/99/100 %:", *(f"{v:.3f}" for v in shares))


if __name__ == "__main__":
    main()
