"""Draw the figures of docs/how-it-works.md from the demo's rendered flight.

    python scripts/make_figures.py [FOLDER]

FOLDER (default: figures-flight) is that of a demo, or new: what is not there yet is rendered,
described and matched, every pair, some ten minutes on two cores. The figures go to docs/figures.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterable
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib import image as photos
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from PIL import Image

from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.commands.demo import DEMO_FLIGHT, MAX_FEATURES
from colmap_netvlad.demo.render import RenderedFlight, flight_exists, read_flight, render_flight
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.graph.viewgraph import read_view_graph
from colmap_netvlad.mapping.partition import partition
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.pairs.rounds import FITTED, replay
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.fusion import similarity_matrix
from colmap_netvlad.retrieval.methods import deep
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.places import Places, agreeing_matches, agreement
from colmap_netvlad.retrieval.rank import rank_project

FIGURES = Path(__file__).parents[1] / "docs" / "figures"

TRUE, FALSE, GREY = "#1b9e77", "#d95f02", "#9aa0a6"
COLOURS = ("#1b9e77", "#7570b3", "#d95f02", "#e7298a", "#66a61e", "#e6ab02")

CLUSTER = 14
"""Photos of a cluster in the figure, so that 42 photos make several."""

TURNED = 0.5
"""Photos are turned against each other where the cosine between their x axes is below this."""

SHOWN = 60
"""Agreeing places of the pair that is shown: more hide the photos."""

APART = 0.6
"""Photos this share of the flight's extent apart show different ground."""


def prepare(folder: Path) -> tuple[RenderedFlight, Project]:
    """Render the demo's flight, extract features, and match every pair into a database."""
    rendered = flight_exists(folder, DEMO_FLIGHT)
    flight = read_flight(folder) if rendered else render_flight(folder, DEMO_FLIGHT)
    features, matched = folder / "project.db", folder / "all-pairs.db"
    extract_features(flight.images, features, FeatureOptions(max_features=MAX_FEATURES))
    if not matched.exists():
        copy_database(features, matched, matches=False)
    match_pairs(matched, list(combinations(flight.names, 2)))
    return flight, Project(matched, flight.images)


def places_of(project: Project, names: Iterable[str]) -> dict[str, tuple[Places, int, int]]:
    """Return each photo's cells, and the grid's height and width."""
    model = deep.cells_key(DEFAULT, RetrievalOptions())
    found = {}
    with Store(project.cache) as store:
        numbers = store.cell_numbers(model)
        for name in names:
            cells = store.read_cells(numbers[name])
            found[name] = Places.of(cells), *cells.codes.shape[:2]
    return found


def draw_places(flight: RenderedFlight, project: Project) -> Figure:
    """Two photos of one place, turned against each other, and two of different places."""
    number = {name: i for i, name in enumerate(flight.names)}
    places = places_of(project, flight.names)
    counts = {
        pair: agreeing_matches(places[pair[0]][0], places[pair[1]][0])
        for pair in combinations(flight.names, 2)
    }

    def cosine(pair: tuple[str, str]) -> float:
        a, b = (flight.rotations[number[name]] for name in pair)
        return abs(float(a[0] @ b[0]))

    def distance(pair: tuple[str, str]) -> float:
        a, b = (flight.centres[number[name]] for name in pair)
        return float(np.linalg.norm(a - b))

    turned = [pair for pair in counts if cosine(pair) < TURNED]
    same = min(turned, key=lambda pair: abs(counts[pair] - SHOWN))
    apart = [pair for pair in counts if distance(pair) > APART * flight.extent]
    different = max(apart, key=counts.__getitem__)
    figure = Figure(figsize=(9, 7.3), layout="constrained", facecolor="white")
    for axes, pair, what in zip(
        figure.subplots(2, 1),
        (same, different),
        ("the same ground, the drone turned", "different ground of the same kind"),
        strict=True,
    ):
        _draw_pair(axes, flight, pair, places, what)
    return figure


def _draw_pair(
    axes: Axes,
    flight: RenderedFlight,
    pair: tuple[str, str],
    places: dict[str, tuple[Places, int, int]],
    what: str,
) -> None:
    gap = 0.06 * flight.width
    at = []
    for side, name in enumerate(pair):
        grey = photos.imread(flight.images / name).mean(axis=2)
        dark, light = np.percentile(grey, (1, 99))
        left = side * (flight.width + gap)
        axes.imshow(
            grey, cmap="gray", vmin=dark - 0.6 * (light - dark), vmax=light,
            interpolation="bilinear", extent=(left, left + flight.width, flight.height, 0),
        )  # fmt: skip
        found, height, width = places[name]
        scale = np.array([flight.width / width, flight.height / height])
        at.append((found.at + 0.5) * scale + (left, 0))
    matches, agree = agreement(places[pair[0]][0], places[pair[1]][0])
    for (i, j), good in sorted(zip(matches.tolist(), agree, strict=True), key=lambda row: row[1]):
        ends = np.array([at[0][i], at[1][j]])
        axes.plot(
            *ends.T, color=TRUE if good else FALSE, linewidth=0.9 if good else 0.4,
            alpha=0.9 if good else 0.45, marker="o", markersize=2 if good else 1,
        )  # fmt: skip
    axes.set_xlim(0, 2 * flight.width + gap)
    axes.set_ylim(flight.height, 0)
    axes.set_title(
        f"{pair[0]} and {pair[1]}, {what}: of {len(matches)} cells that are each other's most\n"
        f"alike, {int(agree.sum())} agree on one turn, scale and shift (green)",
        fontsize=10,
    )
    axes.axis("off")


def draw_rounds(flight: RenderedFlight, project: Project) -> Figure:
    """Three rounds of pairs from above, replayed on the matches of all pairs."""
    ranking = rank_project(project, DEFAULT, RetrievalOptions(k=len(flight.names) - 1))
    with open_database(project.database) as database:
        place = {image.image_id: i for i, image in enumerate(database.images())}
        found = database.verified_matches()
    truth = {
        (min(place[a], place[b]), max(place[a], place[b])): count for (a, b), count in found.items()
    }
    true = sum(count > CORRECT_MATCHES for count in truth.values())
    at = _plan(flight, ranking.names)
    figure = Figure(figsize=(9, 3.0), layout="constrained", facecolor="white")
    before: set[tuple[int, int]] = set()
    rounds = replay(
        similarity_matrix(ranking), truth, ranking.names, true, 3, FITTED[ranking.compared]
    )
    for number, (axes, tested) in enumerate(zip(figure.subplots(1, 3), rounds, strict=False), 1):
        _edges(axes, at, before, GREY, 0.5, 0.6)
        new = [pair for pair in tested if pair not in before]
        good = [pair for pair in new if tested[pair] > CORRECT_MATCHES]
        _edges(axes, at, good, TRUE, 0.8, 0.9)
        _edges(axes, at, [pair for pair in new if pair not in good], FALSE, 1.0, 1.0)
        axes.plot(*at.T, "o", color="black", markersize=2.5)
        axes.set_title(f"round {number}: {len(new)} pairs, {len(good)} verified", fontsize=10)
        axes.set_aspect("equal")
        axes.axis("off")
        before = set(tested)
    figure.legend(
        handles=[
            Line2D([], [], color=TRUE, label="verified"),
            Line2D([], [], color=FALSE, label="failed"),
            Line2D([], [], color=GREY, label="matched in earlier rounds"),
        ],
        loc="outside lower center",
        ncols=3,
        fontsize=9,
        frameon=False,
    )
    return figure


def draw_cut(flight: RenderedFlight, project: Project) -> Figure:
    """The view graph cut into clusters, and the photos that neighbours share."""
    graph = read_view_graph(project.database)
    clusters = partition(graph, CLUSTER)
    core = {name: i for i, cluster in enumerate(clusters) for name in cluster.core}
    at = _plan(flight, graph.names)
    figure = Figure(figsize=(9, 3.9), layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    for (i, j), weight in zip(graph.edges.tolist(), graph.weights.tolist(), strict=True):
        a, b = core[graph.names[i]], core[graph.names[j]]
        _edges(left, at, [(i, j)], COLOURS[a] if a == b else GREY, 2.5 * weight, 0.7)
    for name, cluster in core.items():
        for axes in (left, right):
            axes.plot(*at[graph.names.index(name)], "o", color=COLOURS[cluster], markersize=7)
    for number, cluster in enumerate(clusters):
        shared = [graph.names.index(name) for name in cluster.images if core[name] != number]
        right.plot(
            *at[shared].T, "o", markersize=11 + 3.5 * number, markerfacecolor="none",
            markeredgecolor=COLOURS[number], markeredgewidth=1.6,
        )  # fmt: skip
    sizes = ", ".join(str(len(cluster.core)) for cluster in clusters)
    left.set_title(f"the cut: clusters of {sizes} photos; pairs it cuts are grey", fontsize=10)
    right.set_title("rings: photos that a neighbouring cluster maps as well", fontsize=10)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.margins(0.09)
        axes.axis("off")
    return figure


def _plan(flight: RenderedFlight, names: Iterable[str]) -> NDArray[np.float64]:
    """Return (N, 2) m east and north of the photos' true centres."""
    centres = dict(zip(flight.names, flight.centres, strict=True))
    return np.array([centres[name][:2] for name in names])


def _edges(
    axes: Axes,
    at: NDArray[np.float64],
    pairs: Iterable[tuple[int, int]],
    colour: str,
    width: float,
    alpha: float,
) -> None:
    for i, j in pairs:
        axes.plot(*at[[i, j]].T, color=colour, linewidth=width, alpha=alpha, zorder=1)


def save(figure: Figure, path: Path, dpi: int = 130, colours: int = 200) -> None:
    """Save with few colours: a third of the bytes."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    picture = Image.open(drawn).convert("RGB").quantize(colours, dither=Image.Dither.NONE)
    picture.save(path, optimize=True)
    print(f"Written: {path} ({path.stat().st_size / 1000:.0f} kB)")


def main(folder: Path) -> None:
    flight, project = prepare(folder)
    rank_project(project, DEFAULT, RetrievalOptions(k=10))  # describes the photos
    FIGURES.mkdir(exist_ok=True)
    save(draw_places(flight, project), FIGURES / "places.png", dpi=100, colours=40)
    save(draw_rounds(flight, project), FIGURES / "rounds.png")
    save(draw_cut(flight, project), FIGURES / "cut.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "figures-flight"))
