"""Correct pairs that one method alone retrieved."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from colmap_netvlad.comparison.evidence import Evidence
from colmap_netvlad.comparison.result import CHANCE, EXHAUSTIVE
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES


@dataclass(frozen=True)
class Find:
    """A correct pair that one method alone retrieved."""

    pair: Pair
    matches: int


def single_finds(evidence: Evidence) -> dict[str, list[Find]]:
    """Return by method the correct pairs that no other method retrieved, strongest first.

    The exhaustive reference and the floor of chance do not count.
    """
    methods = [name for name in evidence.pairs if name not in (EXHAUSTIVE, CHANCE)]
    asked = Counter(pair for method in methods for pair in evidence.pairs[method])
    return {
        method: sorted(
            (
                Find(pair, evidence.verified[pair])
                for pair in evidence.pairs[method]
                if asked[pair] == 1 and evidence.verified.get(pair, 0) > CORRECT_MATCHES
            ),
            key=lambda find: (-find.matches, find.pair),
        )
        for method in methods
    }
