"""What the page shows beside the figures: rankings, verified pairs, positions, plans."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.graph.pair import Pair


@dataclass(frozen=True, eq=False)
class Plan:
    """What is drawn of a model, in its own coordinates.

    Attributes:
        names: M registered images.
        centres: (M, 3) camera centres.
        points: (P, 3) an even sample of its 3D points.
        colours: (P, 3) uint8 RGB.
    """

    names: tuple[str, ...]
    centres: NDArray[np.float64]
    points: NDArray[np.float64]
    colours: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything behind a comparison's figures, read from its workspace.

    Attributes:
        names: N image names in the database's order.
        images: the photo folder for thumbnails, or None.
        partners: by ranking method: (N, K) int32 indices into `names`, best first, -1 after the
            last one.
        pairs: by method: its distinct pairs at the largest k.
        verified: verified matches of every pair that was matched.
        truth: the reference's correct pairs.
        plans: by method: its largest model.
        positions: (N, 3) GPS or priors, m east, north, up; NaN where unknown.
    """

    names: tuple[str, ...]
    images: Path | None
    partners: Mapping[str, NDArray[np.int32]]
    pairs: Mapping[str, set[Pair]]
    verified: Mapping[Pair, int]
    truth: set[Pair]
    positions: NDArray[np.float64]
    plans: Mapping[str, Plan] = field(default_factory=dict)

    def view_graph(self, pairs: Iterable[Pair]) -> nx.Graph:
        """Return all images, joined by those of the pairs that are correct."""
        graph = nx.Graph()
        graph.add_nodes_from(self.names)
        graph.add_edges_from(sorted(self.truth.intersection(pairs)))
        return graph
