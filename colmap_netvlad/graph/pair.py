"""Three ways to name an image pair: by names, by places in a list of names, by COLMAP's ids."""

from __future__ import annotations

Pair = tuple[str, str]
"""Two image names in alphabetical order: the key of a pair in every set and table."""

IndexPair = tuple[int, int]
"""Two places in a list of image names, lower first."""

IdPair = tuple[int, int]
"""Two image ids of a COLMAP database, lower first."""


def as_pair(name1: str, name2: str) -> Pair:
    """Return the pair of two images, the same whatever their order."""
    return (name1, name2) if name1 <= name2 else (name2, name1)
