"""Checkpoints and running them: round trips, rotations, bad files, devices, named models."""

import json
import struct

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from colmap_netvlad.models import catalogue, describe
from colmap_netvlad.models.aggregation import NetVLAD, build_aggregation
from colmap_netvlad.models.backbones import build_trunk
from colmap_netvlad.models.catalogue import CATALOGUE
from colmap_netvlad.models.checkpoint import (
    METADATA_KEY,
    load_model,
    load_network,
    read_metadata,
    save_checkpoint,
)
from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.models.whitening import Whitening
from colmap_netvlad.runtime.errors import InputError

CARD = {"name": "tiny", "long_side": 64, "rotations": 1, "licence": "none"}


@pytest.fixture(scope="module")
def network():
    """A real network with untrained weights, small in aggregation and input."""
    torch.manual_seed(0)
    trunk = build_trunk("efficientnet-lite0-stage5")
    aggregation = NetVLAD(trunk.channels, 4)
    aggregation.init_from_centres(torch.randn(4, trunk.channels), 10.0)
    return GlobalDescriptor(trunk, aggregation).eval()


@pytest.fixture
def checkpoint(network, tmp_path):
    path = tmp_path / "tiny.safetensors"
    save_checkpoint(path, network, CARD)
    return path


@pytest.fixture
def photos():
    return np.random.default_rng(0).integers(0, 256, (3, 3, 48, 64), np.uint8)


def edit(path, change):
    """Write the checkpoint again with another card."""
    state = load_file(path)
    card = read_metadata(path)
    change(card)
    save_file(state, path, {METADATA_KEY: json.dumps(card)})


def test_checkpoint_brings_back_network_and_card(checkpoint, network, photos):
    model = load_model(checkpoint, "cpu")
    assert (model.name, model.dim, model.long_side, model.rotations) == ("tiny", 448, 64, 1)
    assert len(model.fingerprint) == 64
    assert model.metadata["licence"] == "none"
    found = model.describe(photos)
    assert found.dtype == np.float32
    with torch.inference_mode():
        expected = network(torch.from_numpy(photos).float()).numpy()
    assert (found * expected).sum(axis=1).min() > 0.995  # float16 on disk, bfloat16 in the trunk
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_full_precision_checkpoint_is_exact(network, tmp_path):
    path = tmp_path / "full.safetensors"
    save_checkpoint(path, network, CARD, half=False)
    for key, value in load_network(path).state_dict().items():
        assert torch.equal(value, network.state_dict()[key]), key


def test_half_checkpoint_keeps_batch_norm_statistics_exact(checkpoint, network):
    loaded = load_network(checkpoint).state_dict()
    assert load_file(checkpoint)["trunk._conv_stem.weight"].dtype == torch.float16
    for key, value in network.state_dict().items():
        if "running" in key:
            assert torch.equal(loaded[key], value), key


@pytest.mark.parametrize("kind", ["gem", "max"])
def test_every_aggregation_and_a_whitening_survive_the_round_trip(
    kind, tmp_path, photos, monkeypatch
):
    trunk = build_trunk("efficientnet-lite0-stage5")
    aggregation = build_aggregation(trunk.channels, {"kind": kind})
    whitening = Whitening.fit(
        np.random.default_rng(0).normal(size=(200, aggregation.dim)).astype(np.float32), 16
    )
    network = GlobalDescriptor(trunk, aggregation, whitening).eval()
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, network, CARD, half=False)
    monkeypatch.setattr(describe, "has_bfloat16_hardware", lambda: False)
    model = load_model(path, "cpu")
    assert model.dim == 16
    with torch.inference_mode():
        expected = network(torch.from_numpy(photos).float()).numpy()
    np.testing.assert_allclose(model.describe(photos), expected, atol=1e-3)


def test_the_same_network_makes_the_same_file(network, tmp_path):
    first, second = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    save_checkpoint(first, network, CARD)
    save_checkpoint(second, network, CARD)
    assert first.read_bytes() == second.read_bytes()
    assert load_model(first, "cpu").fingerprint == load_model(second, "cpu").fingerprint


def test_four_rotations_make_the_descriptor_independent_of_quarter_turns(checkpoint, photos):
    edit(checkpoint, lambda card: card.update(rotations=4))
    model = load_model(checkpoint, "cpu")
    upright = model.describe(photos)
    for turns in (1, 2, 3):
        turned = model.describe(np.rot90(photos, turns, axes=(2, 3)))
        np.testing.assert_allclose(turned, upright, atol=1e-4)


def test_one_rotation_does_not(checkpoint, photos):
    model = load_model(checkpoint, "cpu")
    turned = model.describe(np.rot90(photos, axes=(2, 3)))
    assert np.abs(turned - model.describe(photos)).max() > 1e-3


def test_a_descriptor_does_not_depend_on_the_batch_it_is_in(checkpoint, photos):
    edit(checkpoint, lambda card: card.update(rotations=4))
    model = load_model(checkpoint, "cpu")
    together = model.describe(photos)
    alone = np.concatenate([model.describe(photo[None]) for photo in photos])
    assert np.array_equal(together, alone)


def test_nor_on_how_many_processors_there_are(checkpoint, photos, monkeypatch):
    model = load_model(checkpoint, "cpu")
    found = []
    for processors in (1, 2, 5):
        monkeypatch.setattr(describe, "usable_processors", lambda count=processors: count)
        threads = torch.get_num_threads()
        found.append(model.describe_with_cells(photos))
        assert torch.get_num_threads() == threads, "others multiply in as many as before"
    for descriptors, cells in found[1:]:
        np.testing.assert_array_equal(descriptors, found[0][0])
        np.testing.assert_array_equal(cells, found[0][1])


def test_no_photos_make_no_descriptors(checkpoint):
    assert load_model(checkpoint, "cpu").describe(np.zeros((0, 3, 8, 8), np.uint8)).shape == (
        0,
        448,
    )


@pytest.mark.parametrize("name", ["vgg16", "efficientnet-lite0-stage5"])
@pytest.mark.parametrize("size", [(1, 1), (3, 40), (17, 33)])
def test_photos_smaller_than_one_feature_have_a_descriptor(name, size):
    trunk = build_trunk(name)
    network = GlobalDescriptor(trunk, build_aggregation(trunk.channels, {"kind": "gem"})).eval()
    with torch.inference_mode():
        descriptor = network(torch.rand(1, 3, *size) * 255)
    assert torch.isfinite(descriptor).all()


def test_a_loaded_network_can_be_trained_further(checkpoint, photos):
    network = load_network(checkpoint)
    network(torch.from_numpy(photos).float()).square().sum(dim=1).mean().backward()
    network.zero_grad()
    (network(torch.from_numpy(photos).float())[:, 0].sum()).backward()
    assert network.trunk._conv_stem.weight.grad.abs().sum() > 0
    assert network.aggregation.centres.grad.abs().sum() > 0


def test_running_a_model_leaves_the_network_trainable(network, photos):
    model = describe.DescriptorModel(network, name="x", fingerprint="0", long_side=64, device="cpu")
    model.describe(photos)
    assert all(parameter.requires_grad for parameter in network.parameters())
    assert any(isinstance(m, torch.nn.BatchNorm2d) for m in network.modules())


# Bad files


def test_a_text_file_is_no_checkpoint(tmp_path):
    path = tmp_path / "notes.safetensors"
    path.write_text("this is no checkpoint, it is a note about one")
    with pytest.raises(InputError, match="is not a colmap-netvlad checkpoint"):
        load_model(path)


def test_an_empty_file_is_no_checkpoint(tmp_path):
    path = tmp_path / "empty.safetensors"
    path.touch()
    with pytest.raises(InputError, match="is not a colmap-netvlad checkpoint"):
        load_model(path)


def test_a_folder_or_nothing_lists_the_models_there_are(tmp_path):
    for missing in (tmp_path, tmp_path / "missing.safetensors", "netvlad-typo"):
        with pytest.raises(InputError, match="netvlad-o, "):
            load_model(missing)


@pytest.mark.parametrize("share", [0.5, 0.999])
def test_a_truncated_checkpoint_is_named_so(checkpoint, share):
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InputError, match="is truncated"):
        load_model(checkpoint)


def test_a_checkpoint_cut_in_its_header_is_refused(checkpoint):
    content = checkpoint.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    checkpoint.write_bytes(content[: length // 2])
    with pytest.raises(InputError, match=r"is truncated|is not a colmap-netvlad checkpoint"):
        load_model(checkpoint)


def test_other_safetensors_are_no_checkpoint(tmp_path):
    path = tmp_path / "other.safetensors"
    save_file({"weight": torch.zeros(3)}, path)
    with pytest.raises(InputError, match="without its metadata"):
        load_model(path)


def test_another_format_version_is_refused(checkpoint):
    edit(checkpoint, lambda card: card.update(format_version=2))
    with pytest.raises(InputError, match="format version 2"):
        load_model(checkpoint)


@pytest.mark.parametrize("key", ["backbone", "rotations", "long_side"])
def test_a_card_without_what_is_needed_is_refused(checkpoint, key):
    edit(checkpoint, lambda card: card.pop(key))
    with pytest.raises(InputError, match=f"lacks {key}"):
        load_model(checkpoint)


@pytest.mark.parametrize(
    "change",
    [
        lambda card: card.update(backbone="vit"),
        lambda card: card.update(aggregation={"kind": "transformer"}),
        lambda card: card.update(aggregation={"kind": "gem", "heads": 3}),
    ],
)
def test_a_network_this_version_does_not_know_is_refused(checkpoint, change):
    edit(checkpoint, change)
    with pytest.raises(InputError, match=r"does not know|No backbone"):
        load_model(checkpoint)


def test_missing_weights_are_refused(checkpoint):
    state, card = load_file(checkpoint), read_metadata(checkpoint)
    del state["aggregation.centres"]
    save_file(state, checkpoint, {METADATA_KEY: json.dumps(card)})
    with pytest.raises(InputError, match=r"incomplete: aggregation\.centres is missing"):
        load_model(checkpoint)


def test_weights_that_contradict_the_card_are_refused(checkpoint):
    edit(checkpoint, lambda card: card["aggregation"].update(clusters=8))
    with pytest.raises(InputError, match="contradicts itself"):
        load_model(checkpoint)


# Devices


def test_cuda_asked_for_and_absent_is_said(checkpoint, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(InputError, match="cuda is not available"):
        load_model(checkpoint, "cuda")


@pytest.mark.parametrize("name", ["gpu", "cuda:x", "meta"])
def test_a_device_that_does_not_exist_is_said(checkpoint, name):
    with pytest.raises(InputError, match=r"is no device|is not available"):
        load_model(checkpoint, name)


def test_cuda_is_chosen_where_it_is(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert describe.choose_device().type == "cuda"
    assert describe.choose_precision(torch.device("cuda")) == torch.float16


def test_bfloat16_only_where_the_processor_gains_from_it(monkeypatch):
    cpu = torch.device("cpu")
    monkeypatch.setattr(describe, "has_bfloat16_hardware", lambda: True)
    assert describe.choose_precision(cpu) == torch.bfloat16
    monkeypatch.setattr(describe, "has_bfloat16_hardware", lambda: False)
    assert describe.choose_precision(cpu) == torch.float32


# Named models


@pytest.mark.parametrize("name", [entry.name for entry in CATALOGUE.values() if entry.url is None])
def test_shipped_models_run_and_carry_their_licence(name):
    entry = CATALOGUE[name]
    assert entry.file().stat().st_size < 40e6
    card = read_metadata(entry.file())
    assert card["name"] == name
    assert card["licence"]
    assert not {"sheffield_cross", "sarawak_palm", "corpus_christi"} & set(card["data"]["scenes"])
    assert " /" not in card["command"]
    photo = np.random.default_rng(0).integers(0, 256, (1, 3, 48, 64), np.uint8)
    descriptor = load_model(name, "cpu").describe(photo)
    assert descriptor.shape == (1, card["dim"])
    assert np.isfinite(descriptor).all()


def test_weights_not_shipped_say_where_to_get_and_where_to_put_them(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(InputError) as fault:
        load_model("netvlad")
    assert "Pitts30K_struct.mat" in fault.value.message
    assert str(tmp_path / "hub" / "checkpoints") in fault.value.message
    assert "`model`" in fault.value.message


@pytest.mark.parametrize("variable", ["TORCH_HOME", "XDG_CACHE_HOME", None])
def test_the_cache_is_torch_hubs(variable, tmp_path, monkeypatch):
    for name in ("TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, str(tmp_path))
    assert str(catalogue.hub_folder()) == f"{torch.hub.get_dir()}/checkpoints"


def test_local_features_turn_with_the_photo(checkpoint, photos):
    edit(checkpoint, lambda card: card.update(rotations=4))
    model = load_model(checkpoint, "cpu")
    descriptors, upright = model.describe_with_cells(photos)
    np.testing.assert_array_equal(descriptors, model.describe(photos))
    assert np.allclose(np.linalg.norm(upright, axis=1), 1, atol=1e-5)
    for turns in (1, 2, 3):
        _, turned = model.describe_with_cells(np.rot90(photos, turns, axes=(2, 3)))
        expected = np.rot90(upright, turns, axes=(2, 3))
        np.testing.assert_allclose(turned, expected, atol=1e-3)


def test_cells_along_principal_axes_keep_cosines_and_the_descriptor(network, photos, tmp_path):
    channels = network.trunk.channels
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(channels, channels)))[0]
    found = {}
    for count in (None, channels, 16):
        axes = None if count is None else torch.from_numpy(turn[:count].astype(np.float32))
        path = tmp_path / f"{count}.safetensors"
        copy = GlobalDescriptor(network.trunk, network.aggregation, axes=axes).eval()
        save_checkpoint(path, copy, CARD, half=False)
        found[count] = load_model(path, "cpu").describe_with_cells(photos)
    (whole, cells), (turned, all_axes), (few, shorter) = found.values()
    np.testing.assert_array_equal(whole, turned)
    np.testing.assert_array_equal(whole, few)
    cosines = [np.einsum("bchw,bcij->bhwij", c, c) for c in (cells, all_axes)]
    np.testing.assert_allclose(*cosines, atol=1e-4)
    assert shorter.shape[1] == 16
    expected = np.einsum("ac,bchw->bahw", turn[:16], cells)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(shorter, expected, atol=1e-4)


def test_places_without_texture_have_no_local_feature(checkpoint, photos):
    model = load_model(checkpoint, "cpu")
    masked = photos.copy()
    masked[:, :, :, : photos.shape[3] // 2] = 77
    _, local = model.describe_with_cells(masked)
    length = np.linalg.norm(local, axis=1)
    width = local.shape[3]
    assert (length[:, :, : width // 2] == 0).all()
    assert np.allclose(length[:, :, width // 2 + 1 :], 1, atol=1e-5)
