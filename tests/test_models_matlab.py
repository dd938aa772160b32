"""The loader of the published MATLAB weights, on a small file of the same layout."""

import numpy as np
import pytest
import torch
from scipy.io import savemat

from colmap_netvlad.models import netvlad_matlab
from colmap_netvlad.models.checkpoint import load_model
from colmap_netvlad.runtime.errors import InputError

CLUSTERS, DIM = 3, 5
CONVOLUTIONS = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256)}
CONVOLUTIONS |= {12: (256, 256), 14: (256, 256), 17: (256, 512)}
CONVOLUTIONS |= dict.fromkeys((19, 21, 24, 26, 28), (512, 512))
MEAN = (123.0, 117.0, 104.0)


@pytest.fixture(scope="module")
def struct():
    """`net` of the published layout with K = 3 and 5 whitened dimensions."""
    random = np.random.default_rng(0)

    def values(*shape):
        return (random.normal(size=shape) / np.sqrt(np.prod(shape[:-1]))).astype(np.float32)

    def layer(*weights):
        cells = np.empty(len(weights), object)
        cells[:] = weights
        return {"weights": cells}

    layers = np.empty(34, object)
    layers[:] = [{"weights": np.empty(0, object)} for _ in layers]
    for i, (inputs, outputs) in CONVOLUTIONS.items():
        layers[i] = layer(values(3, 3, inputs, outputs), values(outputs))
    layers[30] = layer(10 * values(512, CLUSTERS), values(512, CLUSTERS))
    layers[33] = layer(values(1, 1, 512 * CLUSTERS, DIM), values(DIM))
    mean = np.broadcast_to(np.float32(MEAN), (4, 4, 3))
    return {"layers": layers, "meta": {"normalization": {"averageImage": mean}}}


@pytest.fixture(scope="module")
def matfile(struct, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "Pitts30K_struct.mat"
    savemat(path, {"net": struct})
    return path


def test_network_equals_the_published_one_computed_step_by_step(struct, matfile):
    photo = torch.rand(1, 3, 48, 64) * 255
    functional = torch.nn.functional

    x = photo - torch.tensor(MEAN).view(1, 3, 1, 1)
    for i in range(29):
        if i in CONVOLUTIONS:
            kernel, bias = (torch.from_numpy(w) for w in struct["layers"][i]["weights"])
            x = functional.conv2d(x, kernel.permute(3, 2, 0, 1), bias, padding=1)
        elif i in (4, 9, 16, 23):
            x = functional.max_pool2d(x, 2)
        else:
            x = functional.relu(x)
    x = functional.normalize(x.flatten(2), dim=1)[0]  # D x N
    assignment, negated = (torch.from_numpy(w) for w in struct["layers"][30]["weights"])
    weights = torch.softmax(assignment.T @ x, dim=0)  # K x N
    vlad = torch.stack(
        [
            sum(weights[k, n] * (x[:, n] + negated[:, k]) for n in range(x.shape[1]))
            for k in range(CLUSTERS)
        ],
        dim=1,
    )  # D x K, flattened with K fastest as the published whitening expects
    vlad = functional.normalize(functional.normalize(vlad, dim=0).flatten(), dim=0)
    matrix, bias = (torch.from_numpy(w) for w in struct["layers"][33]["weights"])
    expected = functional.normalize(matrix[0, 0].T @ vlad + bias, dim=0)

    with torch.inference_mode():
        found = netvlad_matlab.load(matfile)(photo)[0]
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


def test_published_file_by_path_is_a_model(matfile):
    model = load_model(matfile, "cpu")
    assert (model.name, model.dim, model.rotations) == ("netvlad", DIM, 1)
    photo = np.zeros((1, 3, 32, 48), np.uint8)
    assert model.describe(photo).shape == (1, DIM)


def test_published_file_in_torch_hubs_cache_is_found_by_name(matfile, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    cache = tmp_path / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    (cache / matfile.name).symlink_to(matfile)
    assert load_model("netvlad", "cpu").dim == DIM


def test_a_file_that_is_no_matlab_file_is_refused(tmp_path):
    path = tmp_path / "x.mat"
    path.write_text("nothing of the kind, but long enough to be looked at" * 20)
    with pytest.raises(InputError, match="not a MATLAB file"):
        load_model(path)


def test_another_matlab_file_is_refused(tmp_path):
    path = tmp_path / "x.mat"
    savemat(path, {"a": 1})
    with pytest.raises(InputError, match="no variable net"):
        load_model(path)
    savemat(path, {"net": {"layers": 1}})
    with pytest.raises(InputError, match="not laid out"):
        load_model(path)


def test_a_truncated_matlab_file_is_refused(matfile, tmp_path):
    path = tmp_path / "x.mat"
    path.write_bytes(matfile.read_bytes()[:5000])
    with pytest.raises(InputError, match=r"x\.mat"):
        load_model(path)
