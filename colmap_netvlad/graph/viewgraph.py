"""The weighted view graph: images joined by their verified matches.

Weights are equations 1 to 3 of the paper (section 2.2). What hangs on one photo or on one pair
is found by `articulation_images` and `bridges`: there a flight's model breaks first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.colmap.database import Database, open_database
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path
from colmap_netvlad.runtime.sequences import listed

INLIER_SHARE = 0.5
"""R_ew of equation 1: how much the number of matches counts against their spread."""

MIN_INLIERS = 15
"""An edge needs this many verified matches: COLMAP's mapper ignores pairs with fewer."""

LISTED = 10
"""Items of a list that are printed."""

CACHED_IMAGES = 1024
"""Images whose keypoints are kept in memory while edges are weighed (64 KiB each, about)."""


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """Images and the verified image pairs between them, with weights.

    Attributes:
        names: (N) image names in the database's order.
        edges: (E, 2) positions in `names`, lower first, rows sorted, no row twice.
        inliers: (E) verified matches of each edge, at least 1.
        weight_inlier: (E) equation 2, 0..1.
        weight_overlap: (E) equation 3, 0..1.
        weights: (E) equation 1, 0..1.
    """

    names: tuple[str, ...]
    edges: NDArray[np.int32]
    inliers: NDArray[np.int64]
    weight_inlier: NDArray[np.float64]
    weight_overlap: NDArray[np.float64]
    weights: NDArray[np.float64]

    def degrees(self) -> NDArray[np.int64]:
        """Return the (N) number of edges of each image."""
        return np.bincount(self.edges.ravel(), minlength=len(self.names))

    def adjacency(self) -> sparse.csr_array:
        """Return the symmetric (N, N) sparse matrix of weights, zero on the diagonal."""
        n = len(self.names)
        i, j = self.edges.T
        upper = sparse.coo_array((self.weights, (i, j)), shape=(n, n))
        return (upper + upper.T).tocsr()

    def graph(self) -> nx.Graph:
        """Return it as networkx graph; nodes are names, edges carry `inliers` and `weight`."""
        graph = nx.Graph()
        graph.add_nodes_from(self.names)
        rows = zip(
            self.edges.tolist(),
            self.inliers.tolist(),
            self.weight_inlier.tolist(),
            self.weight_overlap.tolist(),
            self.weights.tolist(),
            strict=True,
        )
        for (i, j), inliers, weight_inlier, weight_overlap, weight in rows:
            graph.add_edge(
                self.names[i],
                self.names[j],
                inliers=inliers,
                weight_inlier=weight_inlier,
                weight_overlap=weight_overlap,
                weight=weight,
            )
        return graph

    def components(self) -> list[list[str]]:
        """Return the connected components, largest first; an image without edge is one."""
        _, label = sparse.csgraph.connected_components(self.adjacency() > 0, directed=False)
        members: dict[int, list[str]] = {}
        for name, component in zip(self.names, label.tolist(), strict=True):
            members.setdefault(component, []).append(name)
        return sorted(members.values(), key=len, reverse=True)

    def isolated(self) -> list[str]:
        """Return the images without any edge."""
        return [self.names[i] for i in np.flatnonzero(self.degrees() == 0)]

    def bridges(self) -> list[tuple[str, str]]:
        """Return the edges whose loss splits a component."""
        order = {name: i for i, name in enumerate(self.names)}
        pairs = [sorted(edge, key=order.__getitem__) for edge in nx.bridges(self.graph())]
        return sorted(((a, b) for a, b in pairs), key=lambda pair: (order[pair[0]], order[pair[1]]))

    def articulation_images(self) -> list[str]:
        """Return the images whose loss splits a component."""
        cut = set(nx.articulation_points(self.graph()))
        return [name for name in self.names if name in cut]

    def statistics(self) -> GraphStatistics:
        """Return the figures a report shows."""
        degrees = self.degrees()
        return GraphStatistics(
            images=len(self.names),
            edges=len(self.edges),
            component_sizes=tuple(len(members) for members in self.components()),
            degree_min=int(degrees.min()) if len(degrees) else 0,
            degree_median=float(np.median(degrees)) if len(degrees) else 0.0,
            degree_mean=float(degrees.mean()) if len(degrees) else 0.0,
            degree_max=int(degrees.max(initial=0)),
            isolated=tuple(self.isolated()),
            bridges=tuple(self.bridges()),
            articulation_images=tuple(self.articulation_images()),
        )

    def write_graphml(self, path: Path) -> None:
        """Write it for Gephi, yEd or Cytoscape, whole or not at all.

        Raises:
            InputError: the file cannot be written.
        """
        with atomic_path(path) as temporary:
            nx.write_graphml(self.graph(), temporary)


@dataclass(frozen=True)
class GraphStatistics:
    """How well a view graph holds together.

    Attributes:
        component_sizes: images of each connected component, largest first.
        degree_min, degree_median, degree_mean, degree_max: edges an image.
        isolated: images without edge.
        bridges: edges whose loss splits a component.
        articulation_images: images whose loss splits a component.
    """

    images: int
    edges: int
    component_sizes: tuple[int, ...]
    degree_min: int
    degree_median: float
    degree_mean: float
    degree_max: int
    isolated: tuple[str, ...]
    bridges: tuple[tuple[str, str], ...]
    articulation_images: tuple[str, ...]


def statistics_lines(statistics: GraphStatistics) -> list[str]:
    """Return the figures as lines for the terminal."""
    sizes = ", ".join(f"{size:,}" for size in statistics.component_sizes[:LISTED])
    more = ", ..." if len(statistics.component_sizes) > LISTED else ""
    lines = [
        f"Images: {statistics.images:,}, verified pairs: {statistics.edges:,}.",
        f"Pairs an image: {statistics.degree_min} to {statistics.degree_max}, "
        f"median {statistics.degree_median:g}, mean {statistics.degree_mean:.1f}.",
        f"Components: {len(statistics.component_sizes)} (images: {sizes}{more}).",
    ]
    for title, items in (
        ("Images without a verified pair", statistics.isolated),
        ("Images whose loss splits the model", statistics.articulation_images),
        ("Pairs whose loss splits the model", [f"{a} {b}" for a, b in statistics.bridges]),
    ):
        if items:
            lines.append(f"{title}: {len(items):,}: {listed(items, LISTED)}.")
    return lines


def read_view_graph(
    database: Path, inlier_share: float = INLIER_SHARE, min_inliers: int = MIN_INLIERS
) -> ViewGraph:
    """Weigh the verified pairs of a COLMAP database, which stays byte-identical.

    Args:
        inlier_share: R_ew of equation 1, 0..1.
        min_inliers: verified matches an edge needs, at least 1.

    Raises:
        InputError: an argument is out of range, or the database is not COLMAP's.
    """
    with open_database(database) as opened:
        return weigh_database(opened, inlier_share, min_inliers)


def weigh_database(
    database: Database, inlier_share: float = INLIER_SHARE, min_inliers: int = MIN_INLIERS
) -> ViewGraph:
    """Weigh the verified pairs of an open database (see `read_view_graph`)."""
    if min_inliers < 1:
        raise InputError(f"An edge needs at least 1 verified match, not {min_inliers}.")
    images = database.images()
    position = {row.image_id: i for i, row in enumerate(images)}
    pairs = sorted(
        (position[a], position[b], count)
        for (a, b), count in database.verified_matches().items()
        if count >= min_inliers and a in position and b in position
    )
    table = np.array(pairs, np.int64).reshape(-1, 3)
    edges, inliers = table[:, :2].astype(np.int32), table[:, 2]
    keypoints = lru_cache(maxsize=CACHED_IMAGES)(database.keypoints)
    hulls = np.zeros((len(edges), 2))
    with progress.step("Weighing image pairs", len(edges)) as bar:
        for row, (i, j) in enumerate(edges.tolist()):
            ids = images[i].image_id, images[j].image_id
            matches = database.inlier_matches(*ids)
            for side in (0, 1):
                hulls[row, side] = hull_area(keypoints(ids[side]), matches[:, side])
            bar.advance()
    areas = np.array([row.width * row.height for row in images], np.float64)
    names = tuple(row.name for row in images)
    return ViewGraph(
        names, edges, inliers, *edge_weights(inliers, hulls, areas[edges], inlier_share)
    )


def hull_area(keypoints: NDArray[np.float32], indices: NDArray[np.uint32]) -> float:
    """Return the area in square pixels of the convex hull of matched keypoints.

    It is 0 for fewer than three points and for points on one line. Positions that are not finite
    (a damaged database) are left out.
    """
    points = keypoints[indices]
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 3:
        return 0.0
    return float(cv2.contourArea(cv2.convexHull(np.ascontiguousarray(points, np.float32))))


def edge_weights(
    inliers: NDArray[np.int64],
    hull_areas: NDArray[np.float64],
    image_areas: NDArray[np.float64],
    inlier_share: float = INLIER_SHARE,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Weigh edges by equations 1 to 3 of the paper.

    Args:
        inliers: (E) verified matches, at least 1.
        hull_areas: (E, 2) convex hulls CH of the matches in both images, square pixels.
        image_areas: (E, 2) areas A of both images, square pixels.
        inlier_share: R_ew, 0..1.

    Returns:
        (E) weights of equation 2, 3 and 1, each 0..1. Where the most inliers of any pair is 1,
        equation 2 is 0 / 0; every pair then has the most there is, so it weighs 1. Images of
        unknown size overlap by 0.

    Raises:
        InputError: `inlier_share` is out of range.
    """
    if not 0 <= inlier_share <= 1:
        raise InputError(f"The inlier share R_ew is {inlier_share}; it lies between 0 and 1.")
    most = int(inliers.max(initial=1))
    if most > 1:
        weight_inlier = np.log(np.maximum(inliers, 1)) / np.log(most)  # equation 2
    else:
        weight_inlier = np.ones(len(inliers))
    total = image_areas.sum(axis=1)
    overlap = np.divide(hull_areas.sum(axis=1), total, out=np.zeros(len(total)), where=total > 0)
    weight_overlap = np.clip(overlap, 0, 1)  # equation 3
    weights = inlier_share * weight_inlier + (1 - inlier_share) * weight_overlap  # equation 1
    return weight_inlier, weight_overlap, np.clip(weights, 0, 1)
