"""What a database's verified pairs say."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.graph.components import component_names
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.project import Project


def verified_components(database: Path) -> list[list[str]]:
    """Return the components of a database's verified view graph, the largest first.

    Raises:
        InputError: the database cannot be read.
    """
    return component_names(image_names(database), correct_pairs(verified_by_name(database)))


def verified_by_name(database: Path) -> dict[Pair, int]:
    """Return the verified (inlier) matches of every pair tried in a COLMAP database.

    Pairs that were tried and failed have 0.

    Raises:
        InputError: the database cannot be read.
    """
    with open_database(database) as opened:
        names = {row.image_id: row.name for row in opened.images()}
        counts = opened.verified_matches()
    return {as_pair(names[a], names[b]): count for (a, b), count in counts.items()}


def with_matches(database: Path) -> Path:
    """Return the copy that `--copy` made of a database, where that alone has verified pairs.

    Raises:
        InputError: either cannot be read.
    """
    copy = Project(database, None).copy
    if copy.is_file() and not verified_by_name(database) and verified_by_name(copy):
        return copy
    return database


def mapped_names(database: Path, but: Collection[Pair] = ()) -> set[str]:
    """Return the images that COLMAP's mapper takes up: those with a verified pair, or of whose rig
    frame another has one.

    Args:
        but: pairs that do not count.

    Raises:
        InputError: the database cannot be read.
    """
    with open_database(database) as opened:
        names = {row.image_id: row.name for row in opened.images()}
        left_out = set(but)
        joined = {
            image_id
            for pair in opened.mapped_pairs()
            if as_pair(names[pair[0]], names[pair[1]]) not in left_out
            for image_id in pair
        }
        return {names[image_id] for image_id in opened.with_frames(joined) & names.keys()}


CORRECT_MATCHES = 15
"""A pair is correct with MORE verified matches than this (section 4.1.2)."""


def correct_pairs(verified: Mapping[Pair, int], more_than: int = CORRECT_MATCHES) -> set[Pair]:
    """Return the pairs with more than `more_than` verified matches."""
    return {as_pair(*pair) for pair, count in verified.items() if count > more_than}
