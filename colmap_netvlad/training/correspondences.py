"""Teaching local features by correspondences: the same point of the ground in two views.

A few hundred photos are memorised by a loss over global descriptors; but each photo observes
hundreds of 3D points, and every track says which places of which photos look at the same point,
turned, tilted and lit differently. Of the local features of a flight, the two of one point are to
be the most alike. What tells places of one flight apart that look alike, and what stays the same
when the camera turns, is what NetVLAD's sums need.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from colmap_netvlad.models.aggregation import NetVLAD
from colmap_netvlad.training.augment import Size
from colmap_netvlad.training.sampling import Batch
from colmap_netvlad.training.scenes import Scene
from colmap_netvlad.training.visibility import points_in_views

TOO_NEAR = 0.08
"""Places of one view nearer than this (of its longer side) are not told apart: about one cell of
the feature map and a half."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of one scene, each seen in two views of a batch.

    Attributes:
        rows: (2, n) rows of the batch.
        at: (2, n, 2) places in these views: origin in the centre, unit the longer side.
    """

    rows: NDArray[np.intp]
    at: NDArray[np.float64]

    def __len__(self) -> int:
        return self.rows.shape[1]


def draw_correspondences(
    batch: Batch,
    scenes: Sequence[Scene],
    homographies: NDArray[np.float64],
    size: Size,
    count: int,
    rng: np.random.Generator,
) -> Iterator[Correspondences]:
    """Draw up to `count` correspondences from each scene of a batch that has any.

    Args:
        homographies: (N, 3, 3) from photo to view of each sample.
        size: of the views.
        count: points drawn of each scene; each in two of the views that show it.
    """
    for views in points_in_views(batch, scenes, homographies, size):
        drawn = _two_of_each(np.concatenate([view.points for view in views]), count, rng)
        if drawn.shape[1] > 1:
            rows = np.repeat([view.row for view in views], [len(view.points) for view in views])
            places = np.concatenate([view.at for view in views])
            yield Correspondences(rows[drawn], places[drawn])


def correspondence_loss(
    features: Tensor,
    found: Correspondences,
    layer: NetVLAD,
    size: Size,
    temperature: float,
    noise: Tensor | None = None,
) -> Tensor:
    """InfoNCE over the correspondences of one scene, both ways.

    Of each point's feature in one view, minus the logarithm of the share that its feature in the
    other view has among those of all points: softmax of cosine similarities over `temperature`.
    Points that lie too near to each other in a view are left out of each other's sums. Source:
    van den Oord et al. 2018, eq. 4.

    Args:
        features: (N, D, h, w) of the views of the batch.
        found: correspondences between them.
        layer: adapts features (`NetVLAD.local`).
        size: of the views.
        noise: (2 n, D) added to the L2-normalised features.
    """
    local = sample(functional.normalize(features.float(), dim=1), found, size)  # (2 n, D)
    if noise is not None:
        local = local + noise
    one, other = layer.local(local.T[None])[0].T.chunk(2)  # (n, D) each
    scores = one @ other.T / temperature
    near = torch.from_numpy(too_near(found)).to(scores.device)
    scores = scores.masked_fill(near, -torch.inf)
    wanted = torch.arange(len(scores), device=scores.device)
    return 0.5 * (
        functional.cross_entropy(scores, wanted) + functional.cross_entropy(scores.T, wanted)
    )


def sample(maps: Tensor, found: Correspondences, size: Size) -> Tensor:
    """Features at the places of correspondences, bilinear: (2 n, D), first views first."""
    half = np.asarray(size, np.float64) / max(size) / 2
    rows, at = found.rows.reshape(-1), found.at.reshape(-1, 2) / half  # -1..1 over the view
    sampled = maps.new_zeros(len(rows), maps.shape[1])
    for row in np.unique(rows):
        here = np.flatnonzero(rows == row)
        grid = torch.from_numpy(at[here]).to(maps)[None, None]
        values = functional.grid_sample(
            maps[row][None], grid, padding_mode="border", align_corners=False
        )
        sampled = sampled.index_copy(0, torch.from_numpy(here).to(maps.device), values[0, :, 0].T)
    return sampled


def too_near(found: Correspondences) -> NDArray[np.bool_]:
    """Return (n, n) which two points lie too near in a view to be told apart; diagonal False."""
    near = np.zeros((len(found),) * 2, bool)
    for one in (0, 1):
        for other in (0, 1):
            same = found.rows[one][:, None] == found.rows[other][None]
            apart = np.linalg.norm(found.at[one][:, None] - found.at[other][None], axis=2)
            near |= same & (apart < TOO_NEAR)
    near |= near.T
    np.fill_diagonal(near, False)
    return near


def _two_of_each(
    points: NDArray[np.integer], count: int, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Draw up to `count` points that occur twice or more, and two occurrences of each: (2, n)."""
    order = rng.permutation(len(points))
    order = order[np.argsort(points[order], kind="stable")]  # by point, at random within
    first = np.flatnonzero(np.diff(points[order], prepend=-1))
    often = np.diff(first, append=len(order)) > 1
    chosen = first[often]
    chosen = chosen[rng.permutation(len(chosen))[:count]]
    return np.stack([order[chosen], order[chosen + 1]])
