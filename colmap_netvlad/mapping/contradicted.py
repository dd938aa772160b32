"""Verified pairs of look-alike places, left out of the mapping: the database keeps them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap.copies import copy_with_pairs
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.lookalikes import Moves, find_lookalikes, read_moves
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.graph.verified import mapped_names, verified_by_name
from colmap_netvlad.mapping.summary import registered_names
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.files import scratch_folder


def moves_of(project: Project) -> Moves:
    """Return what the matches of each pair tell, which takes longer than to judge by it."""
    with open_database(project.database) as database:
        return read_moves(database)


@contextmanager
def mapping_database(
    project: Project, moves: Moves | None, continued: pycolmap.Reconstruction | None = None
) -> Iterator[tuple[Path, list[Pair]]]:
    """Yield the database to map from, and the pairs it lacks.

    Where contradicted pairs are to be dropped it is a copy without them, gone after the block:
    the project's database keeps every match.

    Args:
        moves: of its pairs (`moves_of`); None: nothing is dropped.
        continued: model to go on from. COLMAP needs a verified pair of each of its photos: one of
            which all pairs are contradicted keeps them.
    """
    dropped = [] if moves is None else contradicted_pairs(project, moves)
    if dropped and continued is not None:
        bare = registered_names([continued]) - mapped_names(project.database, but=dropped)
        dropped = [pair for pair in dropped if bare.isdisjoint(pair)]
    if not dropped:
        yield project.database, []
        return
    left_out = set(dropped)
    kept = [pair for pair in verified_by_name(project.database) if pair not in left_out]
    with scratch_folder(project.folder) as folder:
        copy = folder / project.database.name
        copy_with_pairs(project.database, copy, kept)
        yield copy, dropped


def contradicted_pairs(project: Project, moves: Moves | None = None) -> list[Pair]:
    """Return the verified pairs that the pairs around them or GPS contradict.

    Args:
        moves: of the project's pairs, where they were read before.

    Raises:
        InputError: the database cannot be read.
    """
    with open_flight(project) as flight:
        metres = flight.positions.metres
        positions = dict(zip(flight.names, metres, strict=True))
        found = find_lookalikes(flight.database, positions, moves)
    return [one.pair for one in found if one.contradicted]


def dropped_lines(dropped: list[Pair]) -> list[str]:
    """Return what was left out, for the reports of commands, or nothing."""
    if not dropped:
        return []
    pairs = "pair was" if len(dropped) == 1 else "pairs were"
    return [
        f"Look-alikes: {len(dropped):,} contradicted {pairs} left out of the mapping; the report "
        "shows them."
    ]
