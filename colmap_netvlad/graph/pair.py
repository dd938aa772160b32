"""Three ways to name an image pair: by names, by places in a list of names, by COLMAP's ids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Pair = tuple[str, str]
"""Two image names in alphabetical order: the key of a pair in every set and table."""

IndexPair = tuple[int, int]
"""Two places in a list of image names, lower first."""

IdPair = tuple[int, int]
"""Two image ids of a COLMAP database, lower first."""


def places_by_name(names: Sequence[str]) -> NDArray[np.int64]:
    """Return (N,) each image's place in the alphabetical order of the names: it breaks ties, so
    that no choice depends on the order of the images."""
    places = np.empty(len(names), dtype=np.int64)
    places[np.argsort(np.array(names, dtype=object), kind="stable")] = np.arange(len(names))
    return places


def as_pair(name1: str, name2: str) -> Pair:
    """Return the pair of two images, the same whatever their order."""
    return (name1, name2) if name1 <= name2 else (name2, name1)
