"""Where images stand on the ground plan: the one frame in which all view graphs are drawn."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.comparison.evidence import Evidence, Plan
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.report.moves import Points, from_above, similarity

NOWHERE = np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class Layout:
    """Images on the ground plan.

    Attributes:
        names: N image names.
        xyz: (N, 3) positions seen from above (x right, y up, z towards the viewer); NaN where an
            image could not be placed.
        source: a phrase of where the positions come from.
        metric: whether the unit is the metre and up is north.
        estimated: images placed at the middle of their verified partners.
    """

    names: tuple[str, ...]
    xyz: Points
    source: str
    metric: bool
    estimated: tuple[str, ...] = ()

    @property
    def placed(self) -> NDArray[np.bool_]:
        """(N) whether an image has a position."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))


def lay_out(evidence: Evidence) -> Layout:
    """Place the images by the largest model of all methods, else by GPS, else by the view graph.

    A model is turned so that the ground lies in the plane of the page; where GPS
    positions are known it is moved onto them, so that north is up and the unit is the metre.
    """
    known = dict(_finite(evidence.names, evidence.positions))
    best = max(evidence.plans.items(), key=lambda item: len(item[1].names), default=None)
    if best is not None and len(best[1].names) >= 3:
        method, plan = best
        target = np.array([known.get(name, NOWHERE) for name in plan.names])
        onto_positions = similarity(plan.centres, target)
        move = onto_positions or from_above(plan.centres, plan.points)
        placed, metric = dict(zip(plan.names, move(plan.centres), strict=True)), False
        source = f"camera positions of the model of {method}, seen from above"
        if onto_positions:
            placed, metric = {**known, **placed}, True
            source = f"camera positions of the model of {method}, moved onto the GPS positions"
    elif len(known) >= 3:
        placed, metric, source = known, True, "GPS positions or priors"
    else:
        placed, metric = spectral_positions(evidence.names, evidence.truth), False
        source = "the view graph alone (spectral layout): near means many common partners"
    placed, estimated = _between_partners(evidence, placed)
    xyz = np.full((len(evidence.names), 3), np.nan)
    for i, name in enumerate(evidence.names):
        if name in placed:
            xyz[i] = placed[name]
    return Layout(evidence.names, xyz, source, metric, estimated)


def align(plan: Plan, layout: Layout) -> Plan:
    """Return a model moved into the layout's frame, or seen from above where they share too few
    images to tell how."""
    index = {name: i for i, name in enumerate(layout.names)}
    target = np.array([layout.xyz[index[name]] for name in plan.names]).reshape(-1, 3)
    move = similarity(plan.centres, target)
    if move is None:
        move = from_above(plan.centres, plan.points)
    return Plan(plan.names, move(plan.centres), move(plan.points), plan.colours)


def spectral_positions(names: tuple[str, ...], pairs: Collection[Pair]) -> dict[str, Points]:
    """Place the images of the view graph's largest component by its spectral layout."""
    graph = nx.Graph()
    graph.add_nodes_from(names)
    graph.add_edges_from(sorted(pairs))
    largest: set[str] = max(nx.connected_components(graph), key=len, default=set())
    if len(largest) < 3:
        return {}
    members = graph.subgraph([name for name in names if name in largest])
    placed = nx.spectral_layout(members)
    return {name: np.array([x, y, 0.0]) for name, (x, y) in placed.items()}


def _finite(names: tuple[str, ...], positions: Points) -> list[tuple[str, Points]]:
    whole = np.asarray(np.isfinite(positions).all(axis=1))
    return [(name, positions[i]) for i, name in enumerate(names) if whole[i]]


def _between_partners(
    evidence: Evidence, placed: dict[str, Points]
) -> tuple[dict[str, Points], tuple[str, ...]]:
    partners: dict[str, list[str]] = {name: [] for name in evidence.names if name not in placed}
    for a, b in sorted(evidence.truth):
        for name, other in ((a, b), (b, a)):
            if name in partners and other in placed:
                partners[name].append(other)
    found = {
        name: np.mean([placed[other] for other in others], axis=0)
        for name, others in partners.items()
        if others
    }
    return {**placed, **found}, tuple(found)
