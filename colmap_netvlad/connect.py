"""Connected, or said so: pairs that could join the components of a graph.

Several disconnected models are what users hate most. Where the verified view graph falls apart,
the best untested candidates across its components get a small extra budget.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

IndexPair = tuple[int, int]

TRIES_PER_LINK = 5
"""Candidates tried between the same two components in one go."""


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


def connecting_pairs(
    similarity: sparse.csr_array,
    component: NDArray[np.int64],
    tested: Collection[IndexPair],
    names: Sequence[str],
    budget: int,
) -> list[IndexPair]:
    """Return at most `budget` untested candidates between components, the best first.

    Between any two components at most `TRIES_PER_LINK`, so that one hopeless pair of components
    does not use up what others need.

    Args:
        similarity: (N, N) symmetric sparse similarity of the candidates.
        component: (N,) from `components`.
        tested: pairs that were matched already, lower index first.
    """
    entries = similarity.tocoo()
    across = (component[entries.row] != component[entries.col]) & (entries.row < entries.col)
    candidates = sorted(
        zip(
            -entries.data[across].round(9),
            (
                (int(i), int(j))
                for i, j in zip(entries.row[across], entries.col[across], strict=True)
            ),
            strict=True,
        ),
        key=lambda item: (item[0], sorted((names[item[1][0]], names[item[1][1]]))),
    )
    known = set(tested)
    tries: Counter[frozenset[int]] = Counter()
    chosen: list[IndexPair] = []
    for _, (i, j) in candidates:
        if len(chosen) == budget:
            break
        link = frozenset((int(component[i]), int(component[j])))
        if (i, j) not in known and tries[link] < TRIES_PER_LINK:
            tries[link] += 1
            chosen.append((i, j))
    return chosen
