"""From local features to one vector: NetVLAD, GeM and max pooling (paper, section 3.3)."""

from __future__ import annotations

import math
import types
from collections.abc import Mapping
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
        rates: factors on the learning rate, by parameter; 1 where absent.
    """

    kind: str
    dim: int
    rates: Mapping[str, float] = types.MappingProxyType({})

    def options(self) -> dict[str, Any]:
        """What a checkpoint needs to build the layer again, beside the channels."""
        return {"kind": self.kind}


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
        # Float32 throughout, whatever the trunk's precision: it is little work, and sums over
        # a thousand features do not survive half precision.
        with torch.autocast(features.device.type, enabled=False):
            x = functional.normalize(features.float().flatten(2), dim=1)  # (B, D, N)
            assigned = torch.softmax(self.assignment.float() @ x, dim=1)  # (B, K, N), eq. 16
            # Eq. 14 as sum_i a_ik x_i - c_k sum_i a_ik: nothing of size B x K x N x D.
            mass = assigned.sum(dim=2, keepdim=True)  # (B, K, 1)
            residuals = assigned @ x.transpose(1, 2) - mass * self.centres.float()  # (B, K, D)
            residuals = functional.normalize(residuals, dim=2)
            return functional.normalize(residuals.flatten(1), dim=1)

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


class TunedNetVLAD(NetVLAD):
    """NetVLAD that a few hundred photos can tune, on a trunk that stays frozen.

    Beside the paper's: a linear map of the L2-normalised features in front, started at the
    identity; the bias b_k of eq. 16; and a weight of each cluster after intra-normalisation.
    Scales, hardness and weights are learned as logarithms.

    Attributes:
        projection, offset, scale_log: x -> exp(scale) (projection x) + offset, (D, D), (D,), (D,).
        hardness_log: log alpha; `assignment` holds the directions c_k / |c_k|.
        assignment_bias: b_k, (K,).
        weight_log: (K,).
    """

    kind = "netvlad-tuned"
    rates = types.MappingProxyType(
        {
            "centres": 2.0,
            "assignment": 2.0,
            "assignment_bias": 10.0,
            "hardness_log": 30.0,
            "weight_log": 30.0,
            "scale_log": 30.0,
        }
    )

    def __init__(self, channels: int, clusters: int = 64) -> None:
        super().__init__(channels, clusters)
        self.projection = nn.Parameter(torch.eye(channels))
        self.offset = nn.Parameter(torch.zeros(channels))
        self.scale_log = nn.Parameter(torch.zeros(channels))
        self.hardness_log = nn.Parameter(torch.zeros(()))
        self.assignment_bias = nn.Parameter(torch.zeros(clusters))
        self.weight_log = nn.Parameter(torch.zeros(clusters))

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, D, h, w) to descriptors (B, K D), cluster by cluster."""
        with torch.autocast(features.device.type, enabled=False):
            x = functional.normalize(features.float().flatten(2), dim=1)  # (B, D, N)
            scale = self.scale_log.float().exp()[:, None]
            x = functional.normalize(
                (scale * self.projection.float()) @ x + self.offset.float()[:, None], dim=1
            )
            hardness = self.hardness_log.float().exp()
            logits = hardness * (self.assignment.float() @ x)
            assigned = torch.softmax(logits + self.assignment_bias.float()[:, None], dim=1)
            mass = assigned.sum(dim=2, keepdim=True)  # (B, K, 1)
            residuals = assigned @ x.transpose(1, 2) - mass * self.centres.float()  # (B, K, D)
            residuals = functional.normalize(residuals, dim=2)
            residuals = residuals * self.weight_log.float().exp()[:, None]
            return functional.normalize(residuals.flatten(1), dim=1)

    @torch.no_grad()
    def init_from_centres(self, centres: Tensor, alpha: float) -> None:
        """Set c_k, the directions of w_k, and alpha; the rest stays as it does nothing."""
        super().init_from_centres(centres, 1.0)
        self.hardness_log.fill_(math.log(alpha))


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
    layer.kind: layer for layer in (NetVLAD, TunedNetVLAD, GeM, MaxPool)
}


def build_aggregation(channels: int, options: dict[str, Any]) -> Aggregation:
    """Make the layer that `Aggregation.options` describes."""
    arguments = {key: value for key, value in options.items() if key != "kind"}
    return AGGREGATIONS[options["kind"]](channels, **arguments)
