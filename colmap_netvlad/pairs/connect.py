"""Connected, or said so: pairs that could join the components of a graph.

Several disconnected models are what users hate most. Where the pairs, or later the verified view
graph, fall apart, the best untested candidates across components get a small extra budget, and
what stays apart is listed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.graph.pair import IndexPair
from colmap_netvlad.runtime.sequences import MOST_LISTED, listed

TRIES_PER_LINK = 5
"""Candidates tried between the same two components in one go."""

CONNECTING_SHARE = 0.05
"""Extra budget for pairs between components, as a share of the budget."""


def connecting_budget(pairs: int) -> int:
    """Return how many pairs between components may come on top of `pairs`: at least one link's."""
    return max(TRIES_PER_LINK, round(CONNECTING_SHARE * pairs))


def apart_lines(groups: Sequence[Sequence[str]]) -> list[str]:
    """Return lines with the images of each component but the largest.

    Args:
        groups: image names of each component, the largest first.
    """
    several = [group for group in groups[1:] if len(group) > 1]
    single = [group[0] for group in groups[1:] if len(group) == 1]
    lines = [f"{len(group)} images: {listed(group)}" for group in several[:MOST_LISTED]]
    if len(several) > MOST_LISTED:
        lines.append(f"and {len(several) - MOST_LISTED} smaller components")
    if single:
        lines.append(f"{len(single)} alone: {listed(single)}")
    return lines


def connecting_pairs(
    similarity: sparse.csr_array,
    component: NDArray[np.int64],
    tested: Collection[IndexPair],
    names: Sequence[str],
    budget: int,
) -> list[IndexPair]:
    """Return at most `budget` untested candidates between components.

    The best between any two components come first, then their second best, up to
    `TRIES_PER_LINK`, so that one hopeless pair of components does not use up what others need.

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
    chosen: list[tuple[int, IndexPair]] = []
    for _, (i, j) in candidates:
        link = frozenset((int(component[i]), int(component[j])))
        if (i, j) not in known and tries[link] < TRIES_PER_LINK:
            chosen.append((tries[link], (i, j)))
            tries[link] += 1
    chosen.sort(key=lambda item: item[0])
    return [pair for _, pair in chosen[:budget]]
