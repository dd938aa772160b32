"""Which photos a comparison shows: instructive queries, single finds, hard images.

Everything is chosen by fixed rules, ties by the database's order, so that the same comparison
shows the same photos.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import NO_PARTNER
from colmap_netvlad.comparison.evidence import Evidence
from colmap_netvlad.comparison.result import CHANCE
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES

QUERIES = 3
"""Queries shown."""

PARTNERS = 8
"""Partners shown of each query and method."""

FINDS = 3
"""Pairs shown that only this method found."""

HARDEST = 12
"""Hardest images listed."""


@dataclass(frozen=True)
class Partner:
    """One retrieved photo. `matches` is None where the pair was not matched."""

    name: str
    rank: int
    matches: int | None

    @property
    def correct(self) -> bool:
        """Whether it has more than 15 verified matches with the query."""
        return (self.matches or 0) > CORRECT_MATCHES


@dataclass(frozen=True)
class Example:
    """One query: why it is shown, and each method's best partners."""

    query: str
    reason: str
    rows: tuple[tuple[str, tuple[Partner, ...]], ...]


@dataclass(frozen=True)
class HardImage:
    """An image with few verified partners.

    Attributes:
        partners: correct partners in the reference.
        found: (method, its correct partners among the method's pairs, whether its model has the
            image, or None where there is no model).
    """

    name: str
    partners: int
    found: tuple[tuple[str, int, bool | None], ...]


def choose_examples(evidence: Evidence, queries: int = QUERIES) -> list[Example]:
    """Choose the queries on which the methods differ most in correct partners.

    A query that is a true partner of one already chosen is passed over, as it would show the
    same place again. Chance is shown but has no say. With one method, or where all agree, the
    queries with the fewest correct partners come first.
    """
    methods = [name for name in evidence.partners if name != CHANCE] or list(evidence.partners)
    if not methods or not evidence.truth:
        return []
    hits = np.array([_hits(evidence, method) for method in methods])  # (methods, N)
    spread, fewest = hits.max(axis=0) - hits.min(axis=0), hits.min(axis=0)
    true_partners = _partners_of(evidence.truth)
    order = sorted(
        (i for i, name in enumerate(evidence.names) if name in true_partners),
        key=lambda i: (-spread[i], fewest[i], i),
    )
    chosen: list[int] = []
    for i in order:
        seen = {evidence.names[j] for j in chosen}
        if not seen & true_partners[evidence.names[i]]:
            chosen.append(i)
        if len(chosen) == queries:
            break
    return [
        Example(evidence.names[i], _reason(methods, hits[:, i], spread[i]), _rows(evidence, i))
        for i in chosen
    ]


def hardest_images(evidence: Evidence, count: int = HARDEST) -> list[HardImage]:
    """Return the images with the fewest correct partners in the reference."""
    degree = Counter(name for pair in evidence.truth for name in pair)
    hardest = sorted(evidence.names, key=lambda name: degree[name])[:count]
    wanted = set(hardest)
    correct = {
        method: Counter(
            name
            for pair in pairs
            if evidence.verified.get(pair, 0) > CORRECT_MATCHES
            for name in pair
            if name in wanted
        )
        for method, pairs in evidence.pairs.items()
    }
    registered = {method: set(plan.names) for method, plan in evidence.plans.items()}
    return [
        HardImage(
            name,
            degree[name],
            tuple(
                (method, found[name], name in registered[method] if method in registered else None)
                for method, found in correct.items()
            ),
        )
        for name in hardest
    ]


def _hits(evidence: Evidence, method: str) -> NDArray[np.int64]:
    """Correct partners among the first `PARTNERS` of each image's list."""
    names = evidence.names
    lists = evidence.partners[method][:, :PARTNERS].tolist()
    return np.array(
        [
            sum(j != NO_PARTNER and as_pair(names[i], names[j]) in evidence.truth for j in row)
            for i, row in enumerate(lists)
        ]
    )


def _rows(evidence: Evidence, query: int) -> tuple[tuple[str, tuple[Partner, ...]], ...]:
    names = evidence.names
    rows = []
    for method, partners in evidence.partners.items():
        listed = [j for j in partners[query, :PARTNERS].tolist() if j != NO_PARTNER]
        found = tuple(
            Partner(names[j], rank, evidence.verified.get(as_pair(names[query], names[j])))
            for rank, j in enumerate(listed, start=1)
        )
        rows.append((method, found))
    return tuple(rows)


def _reason(methods: list[str], hits: NDArray[np.int64], spread: int) -> str:
    best, worst = int(hits.argmax()), int(hits.argmin())
    if len(methods) == 1 or not spread:
        return f"{hits[worst]} of the first {PARTNERS} partners are correct."
    return (
        f"{methods[best]} has {hits[best]} correct partners among the first {PARTNERS}, "
        f"{methods[worst]} has {hits[worst]}."
    )


def _partners_of(pairs: set[Pair]) -> dict[str, set[str]]:
    partners: dict[str, set[str]] = {}
    for a, b in pairs:
        partners.setdefault(a, set()).add(b)
        partners.setdefault(b, set()).add(a)
    return partners
