"""PCA-whitening: a shorter descriptor whose axes carry equal weight."""

from __future__ import annotations

import faiss
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from colmap_netvlad.runtime.errors import InputError


class Whitening(nn.Module):
    """A linear map to `dim` numbers, then L2 normalisation."""

    def __init__(self, inputs: int, dim: int) -> None:
        super().__init__()
        self.inputs = inputs
        self.dim = dim
        self.weight = nn.Parameter(torch.zeros(dim, inputs))
        self.bias = nn.Parameter(torch.zeros(dim))

    def forward(self, descriptors: Tensor) -> Tensor:
        """(B, inputs) to (B, dim), L2-normalised."""
        with torch.autocast(descriptors.device.type, enabled=False):
            whitened = functional.linear(
                descriptors.float(), self.weight.float(), self.bias.float()
            )
            return functional.normalize(whitened, dim=1)

    @classmethod
    def fit(cls, descriptors: np.ndarray, dim: int) -> Whitening:
        """PCA-whitening learned on descriptors.

        Args:
            descriptors: float32 (M, inputs) with more than `dim` rows.
            dim: how many principal axes are kept.

        Raises:
            InputError: there are too few descriptors for `dim` axes.
        """
        count, inputs = descriptors.shape
        if not 0 < dim < min(count, inputs + 1):
            raise InputError(
                f"{count} descriptors of {inputs} numbers cannot be whitened to {dim}: "
                f"give more photos or ask for at most {min(count - 1, inputs)} dimensions."
            )
        pca = faiss.PCAMatrix(inputs, dim, -0.5)
        pca.epsilon = 1e-9  # axes without variance stay finite
        pca.train(np.ascontiguousarray(descriptors, np.float32))
        layer = cls(inputs, dim)
        with torch.no_grad():
            # faiss divides by the root of the sum of squares, not of the variance
            scale = (count - 1) ** 0.5
            matrix = faiss.vector_to_array(pca.A).reshape(dim, inputs)
            layer.weight.copy_(scale * torch.from_numpy(matrix))
            layer.bias.copy_(scale * torch.from_numpy(faiss.vector_to_array(pca.b)))
        return layer
