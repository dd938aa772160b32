"""Connected components of image pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from colmap_netvlad.graph.pair import IndexPair, Pair


def component_names(names: Sequence[str], pairs: Iterable[Pair]) -> list[list[str]]:
    """Return the image names of each connected component, the largest first."""
    index = {name: i for i, name in enumerate(names)}
    labels = components(len(names), ((index[a], index[b]) for a, b in pairs))
    groups: list[list[str]] = [[] for _ in range(int(labels.max(initial=-1)) + 1)]
    for name, label in zip(names, labels.tolist(), strict=True):
        groups[label].append(name)
    return groups


def components(num_images: int, pairs: Iterable[IndexPair]) -> NDArray[np.int64]:
    """Return (N,) the component of each image, 0 for the largest, then by size."""
    edges = np.array(list(pairs), dtype=np.int64).reshape(-1, 2)
    graph = sparse.csr_array(
        (np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(num_images, num_images)
    )
    _, labels = connected_components(graph, directed=False)
    size = np.bincount(labels)
    first = np.full(len(size), num_images)
    np.minimum.at(first, labels, np.arange(num_images))
    order = np.lexsort((first, -size))
    rank = np.empty(len(size), dtype=np.int64)
    rank[order] = np.arange(len(size))
    by_size: NDArray[np.int64] = rank[labels]
    return by_size
