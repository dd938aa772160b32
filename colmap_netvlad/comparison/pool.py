"""Every distinct pair of all methods, matched once; what it cost, by method."""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.comparison.workspace import Workspace
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.sequences import blocks

CHUNK = 256
"""Pairs for each processor whose matching is timed together."""

SAMPLE = 24
"""Pairs on which the cost of exhaustive matching is measured."""


def match_once(
    workspace: Workspace, wanted: Mapping[str, Collection[Pair]], options: MatchOptions
) -> int:
    """Match in `union.db` every pair that some method wants, those matched before left out.

    Pairs are matched in groups wanted by the same methods, so that a group's time is the time of
    just these methods' pairs: wrong pairs are quicker than right ones, and a method that asks
    for them is not charged for the others'.

    Returns:
        How many pairs were matched now.
    """
    done = matched(workspace)
    askers: dict[Pair, list[str]] = {}
    for method, pairs in wanted.items():
        for pair in pairs:
            if pair not in done:
                askers.setdefault(pair, []).append(method)
    groups: dict[tuple[str, ...], list[Pair]] = {}
    for pair in sorted(askers):
        groups.setdefault(tuple(askers[pair]), []).append(pair)
    with progress.step("Matching distinct pairs", len(askers)) as bar:
        for methods in sorted(groups):
            for chunk in _chunks(groups[methods], options):
                _match_timed(workspace, chunk, options)
                bar.advance(len(chunk))
    return len(askers)


def matched(workspace: Workspace) -> set[Pair]:
    """Return the pairs matched so far, verified or not."""
    with open_database(workspace.union) as opened:
        names = {row.image_id: row.name for row in opened.images()}
        return {as_pair(names[a], names[b]) for a, b in opened.matched_pairs()}


def seconds_of(
    pairs: AbstractSet[Pair], seconds: Mapping[Pair, float]
) -> tuple[float | None, float]:
    """Return what matching these pairs took, s, and the share of them that was timed.

    Pairs whose time was lost with a killed run count as the mean of the others.
    """
    known = [seconds[pair] for pair in sorted(pairs) if pair in seconds]
    if not pairs:
        return 0.0, 1.0
    if not known:
        return None, 0.0
    share = len(known) / len(pairs)
    return math.fsum(known) / share, share


def measure_cost(workspace: Workspace, names: Sequence[str], options: MatchOptions) -> float:
    """Return the seconds a pair takes, measured on random pairs (which then count as matched)."""
    generator = random.Random(options.seed)
    possible = len(names) * (len(names) - 1) // 2
    sample: set[Pair] = set()
    while len(sample) < min(SAMPLE, possible):
        a, b = generator.sample(range(len(names)), 2)
        sample.add(as_pair(names[a], names[b]))
    left = sorted(sample - matched(workspace))
    if left:
        _match_timed(workspace, left, options)
    seconds = workspace.pair_seconds()
    timed = [seconds[pair] for pair in sorted(sample) if pair in seconds]
    return math.fsum(timed) / len(timed) if timed else 0.0


def _match_timed(workspace: Workspace, pairs: Sequence[Pair], options: MatchOptions) -> None:
    # Of a few pairs, for which one process works, as if they had been among many.
    report = match_pairs(workspace.union, pairs, options)
    workspace.add_seconds(pairs, report.even_seconds)


def _chunks(pairs: Sequence[Pair], options: MatchOptions) -> Iterator[Sequence[Pair]]:
    size = CHUNK * (options.processes or workers.capacity().processors)
    return (pairs[part] for part in blocks(len(pairs), size))
