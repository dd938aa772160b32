"""Arandjelovic's published NetVLAD weights, as exported to one MATLAB struct.

Layout of `Pitts30K_struct.mat` and `TokyoTM_struct.mat` (`net.layers[i].weights`):

- i = 0, 2, ... up to 28, at torchvision's indices: convolutions, S x S x IN x OUT, and biases;
- i = 30: assignment w_k, D x K, and centres c_k, D x K, stored negated;
- i = 33: whitening, 1 x 1 x D K x 4096, and bias; its input runs over the centres fastest;
- `net.meta.normalization.averageImage`: the mean pixel, RGB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from colmap_netvlad.models.aggregation import NetVLAD
from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.models.trunk import Normalisation
from colmap_netvlad.models.vgg import VGG16
from colmap_netvlad.models.whitening import Whitening
from colmap_netvlad.runtime.errors import InputError

VLAD_LAYER, WHITENING_LAYER = 30, 33

CARD: dict[str, Any] = {
    "name": "netvlad",
    "long_side": 640,  # street views were 640 x 480
    "rotations": 1,
    "licence": "weights of Arandjelovic et al., CVPR 2016",
}
"""What a checkpoint's metadata would say."""


def load(path: Path) -> GlobalDescriptor:
    """Read the published struct.

    Raises:
        InputError: not a MATLAB file, or not of this layout.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        net = loadmat(path, struct_as_record=False, squeeze_me=True)["net"]
    except (OSError, ValueError, MatReadError, NotImplementedError) as fault:
        raise InputError(f"{path} is not a MATLAB file that can be read ({fault}).") from fault
    except KeyError as fault:
        raise InputError(f"{path} holds no variable net: not NetVLAD's weights.") from fault
    try:
        return _network(net)
    except (AttributeError, IndexError, ValueError, RuntimeError) as fault:
        raise InputError(f"{path} is not laid out as NetVLAD's weights ({fault}).") from fault


def _network(net: Any) -> GlobalDescriptor:
    mean = tuple(float(value) for value in np.asarray(net.meta.normalization.averageImage)[0, 0])
    trunk = VGG16(Normalisation("rgb", mean, (1.0, 1.0, 1.0)))  # type: ignore[arg-type]
    for layer, stored in zip(trunk.features, net.layers, strict=False):
        if isinstance(layer, nn.Conv2d):
            kernel, bias = stored.weights
            layer.weight = _parameter(kernel.transpose(3, 2, 0, 1), layer.weight)
            layer.bias = _parameter(bias, layer.bias)

    assignment, negated_centres = net.layers[VLAD_LAYER].weights  # both D x K
    aggregation = NetVLAD(trunk.channels, assignment.shape[1])
    aggregation.assignment = _parameter(assignment.T, aggregation.assignment)
    aggregation.centres = _parameter(-negated_centres.T, aggregation.centres)

    matrix, bias = net.layers[WHITENING_LAYER].weights  # D K x dim, dim
    whitening = Whitening(aggregation.dim, matrix.shape[-1])
    # Its input runs over D first and then K; ours the other way round.
    matrix = matrix.reshape(trunk.channels, aggregation.clusters, whitening.dim)
    matrix = matrix.transpose(2, 1, 0).reshape(whitening.dim, -1)
    whitening.weight = _parameter(matrix, whitening.weight)
    whitening.bias = _parameter(bias, whitening.bias)
    return GlobalDescriptor(trunk, aggregation, whitening)


def _parameter(values: np.ndarray, like: Tensor | None) -> nn.Parameter:
    tensor = torch.from_numpy(np.ascontiguousarray(values, np.float32))
    if like is not None and tensor.shape != like.shape:
        raise ValueError(f"{tuple(tensor.shape)} where {tuple(like.shape)} is expected")
    return nn.Parameter(tensor)
