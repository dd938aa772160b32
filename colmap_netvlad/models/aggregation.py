"""From local features to one vector: NetVLAD, GeM and max pooling (paper, section 3.3)."""

from __future__ import annotations

import math
from typing import Any

import faiss
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

ASSIGNMENT_RATIO = 100.0
"""How many times more weight the nearest centre gets than the second, at initialisation.

Arandjelovic et al. choose alpha so; on average over the features it starts from.
"""


class Aggregation(nn.Module):
    """A layer from a feature map (B, D, h, w) to one vector (B, dim), computed in float32.

    Attributes:
        kind: its row in `AGGREGATIONS`.
        dim: length of the vector.
    """

    kind: str
    dim: int

    def options(self) -> dict[str, Any]:
        """What a checkpoint needs to build the layer again, beside the channels."""
        return {"kind": self.kind}

    def local(self, features: Tensor) -> Tensor:
        """Features (B, D, N) to what is compared place by place: the same, L2-normalised."""
        return functional.normalize(features.float(), dim=1)

    def with_local(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Features (B, D, h, w) to vectors (B, dim) and local features (B, D, h w)."""
        return self(features), self.local(features.flatten(2))


class NetVLAD(Aggregation):
    """NetVLAD (eq. 14 and 16) with b_k = 0, intra-normalisation and L2 normalisation.

    Features are L2-normalised first, which eq. 16's simpler assignment presupposes.

    Attributes:
        centres: c_k, (K, D).
        assignment: w_k, (K, D), started at alpha c_k / |c_k|.
    """

    kind = "netvlad"

    def __init__(self, channels: int, clusters: int = 64) -> None:
        super().__init__()
        self.clusters = clusters
        self.dim = clusters * channels
        self.centres = nn.Parameter(torch.zeros(clusters, channels))
        self.assignment = nn.Parameter(torch.zeros(clusters, channels))

    def options(self) -> dict[str, Any]:
        """See `Aggregation`."""
        return {"kind": self.kind, "clusters": self.clusters}

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, D, h, w) to descriptors (B, K D), cluster by cluster."""
        return self.with_local(features)[0]

    def with_local(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """See `Aggregation`; what is assigned and summed are the local features."""
        # Float32 throughout, whatever the trunk's precision: it is little work, and sums over
        # a thousand features do not survive half precision.
        with torch.autocast(features.device.type, enabled=False):
            x = self.local(features.flatten(2))  # (B, D, N)
            assigned = torch.softmax(self.assignment.float() @ x, dim=1)  # (B, K, N), eq. 16
            # Eq. 14 as sum_i a_ik x_i - c_k sum_i a_ik: nothing of size B x K x N x D.
            mass = assigned.sum(dim=2, keepdim=True)  # (B, K, 1)
            residuals = assigned @ x.transpose(1, 2) - mass * self.centres.float()  # (B, K, D)
            residuals = functional.normalize(residuals, dim=2)
            return functional.normalize(residuals.flatten(1), dim=1), x

    @torch.no_grad()
    def init_from_centres(self, centres: Tensor, alpha: float) -> None:
        """Set c_k and w_k = alpha c_k / |c_k| (text under eq. 16).

        Args:
            centres: (K, D).
            alpha: hardness of the assignment, larger is harder.
        """
        self.centres.copy_(centres)
        self.assignment.copy_(alpha * functional.normalize(centres, dim=1))

    def initialise(self, features: np.ndarray, seed: int = 0) -> float:
        """Start from k-means over local features, so that the assignment follows eq. 16.

        Args:
            features: float32 (M, D), any length; at least K rows. They are L2-normalised here.
            seed: of k-means.

        Returns:
            alpha: the hardness at which the nearest centre gets `ASSIGNMENT_RATIO` times the
            weight of the second, on average.
        """
        features = np.array(features, np.float32)
        faiss.normalize_L2(features)
        kmeans = faiss.Kmeans(
            features.shape[1],
            self.clusters,
            niter=50,
            nredo=3,
            seed=seed,
            min_points_per_centroid=1,
            max_points_per_centroid=2000,
        )
        kmeans.train(features)
        centres = torch.from_numpy(np.array(kmeans.centroids))
        directions = functional.normalize(centres, dim=1)
        best = (torch.from_numpy(features) @ directions.T).topk(2, dim=1).values
        gap = float((best[:, 0] - best[:, 1]).mean())
        alpha = math.log(ASSIGNMENT_RATIO) / max(gap, 1e-6)
        self.init_from_centres(centres, alpha)
        return alpha


class AdaptedNetVLAD(NetVLAD):
    """NetVLAD behind a small network that adapts every local feature by itself.

    y = normalise(x + g(z)), where x is the L2-normalised feature and z = (x - mean) / spread; g
    has two hidden layers and starts at zero, so that the layer starts as NetVLAD. Correspondences
    teach it (`training.correspondences`): features of one point of the ground come together
    whatever way the camera turned, features of others part.

    Attributes:
        mean, spread: of the features it started from, (D,) and ().
        adapt: g, (..., D) to (..., D).
    """

    kind = "netvlad-adapted"

    def __init__(self, channels: int, clusters: int = 64, hidden: int = 512) -> None:
        super().__init__(channels, clusters)
        self.hidden = hidden
        self.mean: Tensor
        self.spread: Tensor
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("spread", torch.ones(()))
        last = nn.Linear(hidden, channels)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.adapt = nn.Sequential(
            nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU(), last
        )

    def options(self) -> dict[str, Any]:
        """See `Aggregation`."""
        return {**super().options(), "hidden": self.hidden}

    def local(self, features: Tensor) -> Tensor:
        """Features (B, D, N) to adapted ones (B, D, N), L2-normalised."""
        x = functional.normalize(features.float(), dim=1).transpose(1, 2)  # (B, N, D)
        spread = self.spread.float()
        adapted = x / spread + self.adapt((x - self.mean.float()) / spread)
        return functional.normalize(adapted, dim=2).transpose(1, 2)

    def initialise(self, features: np.ndarray, seed: int = 0) -> float:
        """Start as `NetVLAD.initialise`, from adapted features; their mean and spread are kept."""
        x = functional.normalize(torch.from_numpy(np.array(features, np.float32)), dim=1)
        with torch.no_grad():
            if not self.mean.any():
                self.mean.copy_(x.mean(dim=0))
                self.spread.copy_(x.std(dim=0).mean())
            adapted = self.local(x.to(self.mean.device).T[None])[0].T
        return super().initialise(adapted.cpu().numpy(), seed)


class GeM(Aggregation):
    """Generalised mean (eq. 17), one learnable power p_k per feature map, started at 3."""

    kind = "gem"
    smallest = 1e-6  # negative features count as (almost) nothing, as after a ReLU

    def __init__(self, channels: int, power: float = 3.0) -> None:
        super().__init__()
        self.dim = channels
        self.power = nn.Parameter(torch.full((channels,), power))

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, D, h, w) to descriptors (B, D), L2-normalised."""
        with torch.autocast(features.device.type, enabled=False):
            x = features.float().clamp(min=self.smallest).flatten(2)  # (B, D, N)
            power = self.power.float()[:, None]
            # The largest value is taken out before the power: no overflow at any p.
            largest = x.amax(dim=2, keepdim=True)
            mean = (x / largest).pow(power).mean(dim=2, keepdim=True)
            return functional.normalize((largest * mean.pow(1 / power)).flatten(1), dim=1)


class MaxPool(Aggregation):
    """The largest value of every feature map (eq. 18), as in MIRorR."""

    kind = "max"

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.dim = channels

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, D, h, w) to descriptors (B, D), L2-normalised."""
        return functional.normalize(features.float().flatten(2).amax(dim=2), dim=1)


AGGREGATIONS: dict[str, type[Aggregation]] = {
    layer.kind: layer for layer in (NetVLAD, AdaptedNetVLAD, GeM, MaxPool)
}


def build_aggregation(channels: int, options: dict[str, Any]) -> Aggregation:
    """Make the layer that `Aggregation.options` describes."""
    arguments = {key: value for key, value in options.items() if key != "kind"}
    return AGGREGATIONS[options["kind"]](channels, **arguments)
