"""The aggregation layers against slow, literal transcriptions of the paper's equations."""

import math

import numpy as np
import pytest
import torch

from colmap_netvlad.models.aggregation import (
    ASSIGNMENT_RATIO,
    AdaptedNetVLAD,
    GeM,
    MaxPool,
    NetVLAD,
    build_aggregation,
)
from colmap_netvlad.models.whitening import Whitening
from colmap_netvlad.runtime.errors import InputError


def unit(x):
    return x / math.sqrt(sum(float(v) ** 2 for v in x))


def netvlad_by_the_letter(features, centres, weights):
    """Eq. 14 with the assignment of eq. 16, one sum at a time. features (D, h, w)."""
    local = [unit(x) for x in features.reshape(features.shape[0], -1).T]
    rows = []
    for k, centre in enumerate(centres):
        row = np.zeros(len(centre))
        for x in local:
            scores = [math.exp(float(w @ x) + 0.0) for w in weights]  # b_k = 0
            row += scores[k] / sum(scores) * (x - centre)
        rows.append(unit(row))  # intra-normalisation
    return unit(np.concatenate(rows))


@pytest.fixture
def random():
    return np.random.default_rng(0)


def filled_netvlad(random, clusters=5, channels=7):
    layer = NetVLAD(channels, clusters)
    with torch.no_grad():
        layer.centres.copy_(torch.from_numpy(random.normal(size=(clusters, channels))))
        layer.assignment.copy_(torch.from_numpy(3 * random.normal(size=(clusters, channels))))
    return layer


def test_netvlad_equals_equations_14_and_16(random):
    layer = filled_netvlad(random)
    features = random.normal(size=(2, 7, 3, 4)).astype(np.float32)
    found = layer(torch.from_numpy(features)).detach().numpy()
    assert found.shape == (2, 35)
    for descriptor, photo in zip(found, features, strict=True):
        expected = netvlad_by_the_letter(
            photo, layer.centres.detach().numpy(), layer.assignment.detach().numpy()
        )
        np.testing.assert_allclose(descriptor, expected, atol=1e-6)


def test_simple_assignment_equals_equation_15_where_centres_have_equal_length(random):
    """Eq. 16 is eq. 15 with w = 2 alpha c: with |c| = 1, b is the same for all k and cancels."""
    centres = torch.nn.functional.normalize(torch.randn(5, 7), dim=1)
    layer = NetVLAD(7, 5)
    alpha = 3.0
    layer.init_from_centres(centres, 2 * alpha)
    x = torch.nn.functional.normalize(torch.randn(7, 11), dim=0)
    by_distance = torch.softmax(-alpha * torch.cdist(x.T, centres) ** 2, dim=1)
    by_product = torch.softmax(x.T @ layer.assignment.detach().T, dim=1)
    torch.testing.assert_close(by_product, by_distance)


def test_netvlad_starts_from_k_means_with_the_ratio_of_assignments_asked_for(random):
    blobs = 4 * np.eye(6, 12) + 0.0
    features = np.repeat(blobs, 50, axis=0) + random.normal(scale=0.5, size=(300, 12))
    layer = NetVLAD(12, 6)
    alpha = layer.initialise(features, seed=3)
    directions = layer.centres.detach() / layer.centres.detach().norm(dim=1, keepdim=True)
    torch.testing.assert_close(layer.assignment.detach(), alpha * directions)
    # every blob found its own centre
    assert sorted((torch.from_numpy(blobs).float() @ directions.T).argmax(1).tolist()) == [
        0,
        1,
        2,
        3,
        4,
        5,
    ]
    x = torch.nn.functional.normalize(torch.from_numpy(features).float(), dim=1)
    best = torch.log_softmax(x @ layer.assignment.detach().T, dim=1).topk(2, dim=1).values
    assert math.exp((best[:, 0] - best[:, 1]).mean()) == pytest.approx(ASSIGNMENT_RATIO, rel=1e-3)


def test_netvlad_starts_the_same_twice(random):
    features = random.normal(size=(200, 12)).astype(np.float32)
    first, second = NetVLAD(12, 6), NetVLAD(12, 6)
    first.initialise(features, seed=1)
    second.initialise(features, seed=1)
    assert torch.equal(first.centres, second.centres)


def test_adapted_netvlad_starts_as_netvlad(random):
    features = random.normal(1, 1, size=(400, 7)).astype(np.float32)
    plain, adapted = NetVLAD(7, 5), AdaptedNetVLAD(7, 5)
    assert plain.initialise(features) == pytest.approx(adapted.initialise(features), rel=1e-3)
    photos = torch.from_numpy(random.normal(1, 1, size=(2, 7, 3, 4)).astype(np.float32))
    with torch.no_grad():
        torch.testing.assert_close(plain(photos), adapted(photos), atol=1e-3, rtol=0)


def test_adapted_netvlad_keeps_its_scale_when_its_centres_are_found_again(random):
    layer = AdaptedNetVLAD(7, 5)
    layer.initialise(random.normal(1, 1, size=(400, 7)))
    mean, spread = layer.mean.clone(), layer.spread.clone()
    layer.initialise(random.normal(-3, 2, size=(400, 7)))
    assert torch.equal(mean, layer.mean) and torch.equal(spread, layer.spread)


def test_gem_equals_equation_17(random):
    features = random.uniform(0.1, 2, size=(2, 4, 3, 3)).astype(np.float32)
    layer = GeM(4)
    assert layer.power.tolist() == [3.0] * 4
    powers = [1.0, 2.5, 3.0, 8.0]
    with torch.no_grad():
        layer.power.copy_(torch.tensor(powers))
    found = layer(torch.from_numpy(features)).detach().numpy()
    for descriptor, photo in zip(found, features, strict=True):
        pooled = [
            (sum(float(x) ** p for x in plane.ravel()) / plane.size) ** (1 / p)
            for plane, p in zip(photo, powers, strict=True)
        ]
        np.testing.assert_allclose(descriptor, unit(np.array(pooled)), atol=1e-6)


def test_gem_takes_negative_features_as_nothing():
    features = torch.tensor([[[[-5.0, 2.0]], [[-5.0, -7.0]]]])
    descriptor = GeM(2)(features)
    torch.testing.assert_close(descriptor, torch.tensor([[1.0, 0.0]]), atol=1e-5, rtol=0)


def test_max_pooling_equals_equation_18(random):
    features = random.normal(size=(2, 4, 3, 3)).astype(np.float32)
    found = MaxPool(4)(torch.from_numpy(features)).numpy()
    for descriptor, photo in zip(found, features, strict=True):
        np.testing.assert_allclose(descriptor, unit(np.array([p.max() for p in photo])), atol=1e-6)


@pytest.mark.parametrize("kind", ["netvlad", "gem", "max"])
def test_gradients_flow_through_every_aggregation(kind, random):
    options = {"kind": kind, "clusters": 5} if kind == "netvlad" else {"kind": kind}
    layer = filled_netvlad(random) if kind == "netvlad" else build_aggregation(7, options)
    layer.double()
    features = torch.rand(2, 7, 2, 3, dtype=torch.double, requires_grad=True)
    weights = torch.rand(2, layer.dim)
    (layer(features) * weights).sum().backward()
    assert features.grad.abs().sum() > 0
    for name, parameter in layer.named_parameters():
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("scale", [1e-4, 1.0, 3e4])
@pytest.mark.parametrize("kind", ["netvlad", "gem", "max"])
def test_aggregations_are_stable_in_half_precision(kind, scale, random):
    layer = filled_netvlad(random) if kind == "netvlad" else build_aggregation(7, {"kind": kind})
    features = scale * torch.from_numpy(random.uniform(0.1, 1, size=(1, 7, 30, 40)))
    with torch.no_grad():
        half, full = layer(features.half()), layer(features.float())
    assert half.dtype == torch.float32
    assert torch.isfinite(half).all()
    assert float((half * full).sum()) > 0.999


def test_whitening_makes_axes_of_equal_weight(random):
    spread = random.normal(size=(400, 6)) * np.array([9, 5, 3, 2, 1, 0.1]) + 4
    layer = Whitening.fit(spread.astype(np.float32), 4)
    with torch.no_grad():
        raw = torch.from_numpy(spread).float() @ layer.weight.T + layer.bias
    np.testing.assert_allclose(np.cov(raw.numpy().T), np.eye(4), atol=0.05)
    np.testing.assert_allclose(raw.mean(0), np.zeros(4), atol=1e-3)
    lengths = layer(torch.from_numpy(spread).float()).norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(400))


def test_whitening_works_with_fewer_descriptors_than_numbers_in_each(random):
    few = random.normal(size=(20, 64)).astype(np.float32)
    layer = Whitening.fit(few, 8)
    raw = (torch.from_numpy(few) @ layer.weight.T + layer.bias).detach().numpy()
    np.testing.assert_allclose(np.cov(raw.T), np.eye(8), atol=0.05)


@pytest.mark.parametrize("dim", [0, 20, 65])
def test_whitening_refuses_more_axes_than_the_descriptors_span(dim, random):
    with pytest.raises(InputError, match="cannot be whitened"):
        Whitening.fit(random.normal(size=(20, 64)).astype(np.float32), dim)
