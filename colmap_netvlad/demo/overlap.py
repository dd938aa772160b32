"""Which photos of a rendered flight truly show the same ground, by geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from colmap_netvlad.demo.render import SEEN_FILE, RenderedFlight
from colmap_netvlad.runtime.errors import InputError

TRUE_OVERLAP = 0.2
"""Least share of either photo's ground that the other shows too, for a pair to be a true one."""


def true_overlaps(flight: RenderedFlight) -> sparse.csr_array:
    """Return (N, N) symmetric: the share of its ground that a photo has in common with another.

    Of the shares of both photos the smaller one, 0..1; ground hidden by a house or a tree counts
    as seen. Zero of a photo with itself.

    Raises:
        InputError: the photos were rendered by a version that did not keep what they show.
    """
    seen = _places_seen(flight.images.parent / SEEN_FILE)
    middles = seen.mean(axis=1)
    reach = 2 * float(np.linalg.norm(seen - middles[:, None], axis=2).max())
    pairs = cKDTree(middles[:, :2]).query_pairs(reach, output_type="ndarray")
    shares = np.minimum(
        _shares(flight, seen, pairs[:, 0], pairs[:, 1]),
        _shares(flight, seen, pairs[:, 1], pairs[:, 0]),
    )
    count = len(flight.names)
    upper = sparse.csr_array((shares, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    upper.eliminate_zeros()
    return (upper + upper.T).tocsr()


def true_pairs(flight: RenderedFlight, least: float = TRUE_OVERLAP) -> list[tuple[str, str]]:
    """Return the names of the pairs that overlap by at least `least`, in order.

    Raises:
        InputError: as `true_overlaps`.
    """
    overlaps = sparse.triu(true_overlaps(flight)).tocoo()
    chosen = overlaps.data >= least
    pairs = zip(overlaps.row[chosen].tolist(), overlaps.col[chosen].tolist(), strict=True)
    return [(flight.names[i], flight.names[j]) for i, j in sorted(pairs)]


def _places_seen(file: Path) -> NDArray[np.float32]:
    if not file.is_file():
        raise InputError(
            f"{file} is missing, which says what each photo shows; render the flight again."
        )
    places: NDArray[np.float32] = np.load(file, allow_pickle=False)
    return places


def _shares(
    flight: RenderedFlight,
    seen: NDArray[np.float32],
    one: NDArray[np.intp],
    other: NDArray[np.intp],
) -> NDArray[np.float64]:
    """Return (M,) the share of what each photo `one` shows that lies in the frame of `other`."""
    shares = np.zeros(len(one))
    half = np.array([flight.width, flight.height]) / 2
    for photo in np.unique(other):
        mine = np.flatnonzero(other == photo)
        local = (seen[one[mine]] - flight.centres[photo]) @ flight.rotations[photo].T
        at = local[..., :2] * flight.focal / local[..., 2:]
        inside = (np.abs(at) < half).all(axis=-1) & (local[..., 2] > 0)
        shares[mine] = inside.mean(axis=1)
    return shares
