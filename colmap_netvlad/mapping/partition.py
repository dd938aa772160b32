"""Cut a view graph into clusters that are reconstructed on their own and overlap enough to merge.

Normalised cut: J. Shi and J. Malik, Normalized cuts and image segmentation, PAMI 2000; here
by recursive bisection. Positions of `ViewGraph.names` stand for images throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from colmap_netvlad.graph.viewgraph import ViewGraph
from colmap_netvlad.runtime.errors import InputError

MIN_SIDE = 1 / 3
"""A bisection leaves each side at least this share of the images: balanced clusters."""

DENSE_IMAGES = 300
"""Up to here all eigenvectors of a dense matrix are cheaper than a sparse solver."""

SHIFT = -1e-4
"""Shift of the inverted Laplacian: below its zero eigenvalue, so that it can be factored."""

Positions = NDArray[np.int64]


@dataclass(frozen=True)
class Cluster:
    """Images that are reconstructed together.

    Attributes:
        core: the images that the cut gave this cluster; cores are disjoint.
        images: the core and the images it shares with neighbours, in the database's order.
    """

    core: tuple[str, ...]
    images: tuple[str, ...]


def partition(graph: ViewGraph, max_size: int) -> list[Cluster]:
    """Cut a view graph into overlapping clusters.

    Args:
        max_size: images of a cluster before it is expanded for overlap, at least 3. Two
            neighbours of sizes a and b then share about 4 sqrt(min(a, b)) images: the row of
            images on either side of their border, since a flight covers an area.

    Returns:
        clusters, largest first, that together have every image with an edge. Components are
        never joined; one that is small enough stays whole.

    Raises:
        InputError: `max_size` is too small for a model.
    """
    if max_size < 3:
        raise InputError(f"Clusters of {max_size} images cannot be reconstructed; use 3 or more.")
    weights = graph.adjacency()
    degree = graph.degrees()
    parts = [part for part in cut(weights, max_size) if degree[part].any()]
    shared = expand(weights, parts)
    names = graph.names
    clusters = [
        Cluster(tuple(names[i] for i in part), tuple(names[i] for i in sorted({*part, *more})))
        for part, more in zip(parts, shared, strict=True)
    ]
    clusters.sort(key=lambda cluster: (-len(cluster.images), cluster.images))
    return [
        cluster
        for i, cluster in enumerate(clusters)
        if not any(set(cluster.images) <= set(larger.images) for larger in clusters[:i])
    ]


def cut(weights: sparse.csr_array, max_size: int) -> list[list[int]]:
    """Bisect components by normalised cuts until none has more than `max_size` images.

    Returns:
        disjoint sorted lists of positions that cover all images, in the order of their first.
    """
    waiting = _components(weights, np.arange(weights.shape[0]))
    done: list[list[int]] = []
    while waiting:
        part = waiting.pop()
        if len(part) <= max_size:
            done.append(sorted(part.tolist()))
        else:
            waiting.extend(bisect(weights, part))
    return sorted(done)


def bisect(weights: sparse.csr_array, part: Positions) -> tuple[Positions, Positions]:
    """Split images in two by the smallest normalised cut along the Fiedler vector.

    All thresholds that leave either side a third of the images are tried, then single images
    change sides while that lowers the cut: the relaxation is not exact, least of all for few
    images. Pieces that the split tears off their side go to the other one, where that keeps the
    balance.
    """
    inner = weights[part][:, part].tocsr()
    order = np.argsort(fiedler_vector(inner), kind="stable")
    smallest = max(1, math.floor(len(part) * MIN_SIDE))
    costs = normalised_cuts(inner, order)[smallest - 1 : len(part) - smallest]
    left = np.zeros(len(part), bool)
    left[order[: smallest + int(np.argmin(costs))]] = True
    left = _polish(inner, left, smallest)
    mended = _reattach(inner, left)
    if smallest <= mended.sum() <= len(part) - smallest:
        left = mended
    return part[left], part[~left]


def fiedler_vector(weights: sparse.csr_array) -> NDArray[np.float64]:
    """Return the second eigenvector of (D - W) x = l D x: the relaxed normalised cut.

    The sign is fixed, so that the same graph gives the same vector. Works for any graph with
    at least two nodes; a node without edges counts as one of negligible degree.
    """
    n = weights.shape[0]
    degree = np.maximum(np.asarray(weights.sum(axis=1)).ravel(), 1e-9)
    scale = 1 / np.sqrt(degree)
    half = sparse.diags_array(scale)
    laplacian = sparse.eye_array(n) - half @ weights @ half
    if n <= DENSE_IMAGES:
        vector = linalg.eigh(laplacian.toarray(), subset_by_index=(1, 1))[1][:, 0]
    else:
        start = np.random.default_rng(0).standard_normal(n)
        values, vectors = sparse.linalg.eigsh(laplacian.tocsc(), k=2, sigma=SHIFT, v0=start)
        vector = vectors[:, np.argmax(values)]
    vector = vector * scale
    return vector * (np.sign(vector[np.argmax(np.abs(vector))]) or 1.0)


def normalised_cuts(weights: sparse.csr_array, order: Positions) -> NDArray[np.float64]:
    """Return Ncut = cut / assoc(left) + cut / assoc(right) of every split of an order.

    Args:
        order: (N) a permutation of the images.

    Returns:
        (N - 1) values 0..2; element k splits after the first k + 1 images. A side without any
        weight counts as the worst, 2.
    """
    n = len(order)
    place = np.empty(n, np.int64)
    place[order] = np.arange(n)
    edges = sparse.triu(weights, k=1).tocoo()
    ends = np.sort(np.stack([place[edges.row], place[edges.col]]), axis=0)
    change = np.zeros(n)
    np.add.at(change, ends[0], edges.data)
    np.add.at(change, ends[1], -edges.data)
    crossing = np.maximum(np.cumsum(change)[:-1], 0)
    degree = np.asarray(weights.sum(axis=1)).ravel()[order]
    left = np.cumsum(degree)[:-1]
    right = degree.sum() - left
    with np.errstate(divide="ignore", invalid="ignore"):
        value = crossing / left + crossing / right
    return np.where((left > 0) & (right > 0), value, 2.0)


def _polish(weights: sparse.csr_array, left: NDArray[np.bool_], smallest: int) -> NDArray[np.bool_]:
    """Move the image to the other side that lowers Ncut most, until none does.

    Neither side becomes smaller than `smallest`.
    """
    left = left.copy()
    degree = np.asarray(weights.sum(axis=1)).ravel()
    while True:
        to_left = np.asarray(weights @ left.astype(np.float64)).ravel()
        to_own = np.where(left, to_left, degree - to_left)
        crossing = float((degree - to_left)[left].sum())
        inside = float(degree[left].sum())
        moved_crossing = crossing + 2 * to_own - degree
        moved_inside = np.where(left, inside - degree, inside + degree)
        with np.errstate(divide="ignore", invalid="ignore"):
            now = crossing / inside + crossing / (degree.sum() - inside)
            moved = moved_crossing / moved_inside + moved_crossing / (degree.sum() - moved_inside)
        count = int(left.sum())
        room = np.where(left, count > smallest, len(left) - count > smallest)
        moved = np.where(room & np.isfinite(moved), moved, np.inf)
        best = int(np.argmin(moved))
        if not moved[best] < now - 1e-12:
            return left
        left[best] = not left[best]


def expand(weights: sparse.csr_array, parts: list[list[int]]) -> list[set[int]]:
    """Give neighbouring clusters images of each other.

    Each of two neighbours gets the images of the other that are tied to it the most, about
    2 sqrt(size of the smaller). Neighbours with the greatest cut come first; a cluster grows by
    at most half, except for a neighbour that nothing else joins it to.

    Returns:
        for each part, the images it gets.
    """
    cluster = np.full(weights.shape[0], -1)
    for number, part in enumerate(parts):
        cluster[part] = number
    edges = weights.tocoo()
    a, b = cluster[edges.row], cluster[edges.col]
    crossing = (a != b) & (a >= 0) & (b >= 0)
    tie: dict[tuple[int, int], dict[int, float]] = {}
    rows = (a[crossing], b[crossing], edges.col[crossing], edges.data[crossing])
    for to, of, image, weight in zip(*(row.tolist() for row in rows), strict=True):
        ties = tie.setdefault((to, of), {})
        ties[image] = ties.get(image, 0.0) + weight
    strength = {pair: sum(ties.values()) for pair, ties in tie.items() if pair[0] < pair[1]}
    shared: list[set[int]] = [set() for _ in parts]
    joined = nx.utils.UnionFind(range(len(parts)))
    for x, y in sorted(strength, key=lambda pair: (-strength[pair], pair)):
        count = math.ceil(2 * math.sqrt(min(len(parts[x]), len(parts[y]))))
        full = any(len(shared[side]) + count > len(parts[side]) / 2 for side in (x, y))
        if full and joined[x] == joined[y]:
            continue
        joined.union(x, y)
        for to, of in ((x, y), (y, x)):
            ties = tie[to, of]
            shared[to].update(sorted(ties, key=lambda image: (-ties[image], image))[:count])
    return shared


def _components(weights: sparse.csr_array, part: Positions) -> list[Positions]:
    _, label = sparse.csgraph.connected_components(weights[part][:, part], directed=False)
    return [part[label == number] for number in range(int(label.max(initial=-1)) + 1)]


def _reattach(weights: sparse.csr_array, left: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Move all but the largest connected piece of either side to the other side."""
    mended = left.copy()
    for side in (left, ~left):
        pieces = _components(weights, np.flatnonzero(side))
        for piece in sorted(pieces, key=len, reverse=True)[1:]:
            mended[piece] = ~mended[piece]
    return mended
