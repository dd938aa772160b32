"""Trunks: key names, shapes, the published weights, input normalisation."""

import os
import urllib.error

import pytest
import torch
from safetensors.torch import save_file

from colmap_netvlad.models import backbones
from colmap_netvlad.models.backbones import (
    BACKBONES,
    LITE0_TIMM,
    VGG16_TORCHVISION,
    build_trunk,
    load_trunk,
    timm_lite_key,
)
from colmap_netvlad.models.trunk import KERAS_BGR, TORCHVISION_RGB, fold_batch_norm
from colmap_netvlad.runtime.errors import InputError

SHAPES = {
    "vgg16": (512, 4, 6),
    "resnet50": (2048, 2, 3),
    "efficientnet-lite0-stage7": (320, 2, 3),
    "efficientnet-lite0-stage5": (112, 4, 6),
}


@pytest.mark.parametrize("name", BACKBONES)
def test_trunk_makes_features_of_the_size_it_says(name):
    trunk = build_trunk(name).eval()
    with torch.inference_mode():
        features = trunk(torch.rand(1, 3, 64, 96))
    assert tuple(features.shape[1:]) == SHAPES[name]
    assert trunk.name == name
    assert trunk.channels == features.shape[1]
    assert trunk.stride == 64 // features.shape[2]


def test_vgg_has_torchvisions_keys_and_no_last_relu():
    trunk = build_trunk("vgg16")
    convolutions = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    assert set(trunk.state_dict()) == {
        f"features.{i}.{part}" for i in convolutions for part in ("weight", "bias")
    }
    with torch.inference_mode():
        assert trunk(torch.rand(1, 3, 32, 32)).min() < 0


def test_resnet_has_torchvisions_keys():
    keys = build_trunk("resnet50").state_dict()
    assert len(keys) == 318  # torchvision's 320 less fc.weight and fc.bias
    assert keys["layer1.0.downsample.0.weight"].shape == (256, 64, 1, 1)
    assert keys["layer4.2.conv2.weight"].shape == (512, 512, 3, 3)
    assert keys["layer3.5.bn3.running_var"].shape == (1024,)


@pytest.mark.parametrize("name", ["resnet50", "efficientnet-lite0-stage7"])
def test_folding_batch_norms_changes_nothing_but_the_work(name):
    torch.manual_seed(0)
    trunk = build_trunk(name)
    for module in trunk.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.uniform_(module.running_mean, -0.2, 0.2)
            torch.nn.init.uniform_(module.running_var, 0.5, 1.5)
    trunk.eval()
    pixels = torch.rand(1, 3, 32, 64)
    with torch.inference_mode():
        before = trunk(pixels)
        fold_batch_norm(trunk)
        assert not any(isinstance(m, torch.nn.BatchNorm2d) for m in trunk.modules())
        torch.testing.assert_close(trunk(pixels), before, rtol=1e-3, atol=1e-4 * before.abs().max())


def test_stride_2_convolutions_are_padded_as_tensorflow_does():
    """One row more at the bottom and right: an impulse at (1, 1) is the centre of output 0."""
    stem = build_trunk("efficientnet-lite0-stage5")._conv_stem
    with torch.no_grad():
        stem.weight.zero_()
        stem.weight[0, 0, 1, 1] = 1
    pixels = torch.zeros(1, 3, 8, 8)
    pixels[0, 0, 1, 1] = 1
    output = stem(pixels)[0, 0]
    assert tuple(output.shape) == (4, 4)
    assert output[0, 0] == 1


def test_normalisation_turns_rgb_into_keras_bgr():
    pixels = torch.tensor([200.0, 150.0, 100.0]).view(1, 3, 1, 1)
    found = KERAS_BGR(pixels).flatten().tolist()
    assert found == pytest.approx([100 - 103.939, 150 - 116.779, 200 - 123.68], abs=1e-4)


def test_normalisation_of_torchvision_is_the_one_of_0_to_1():
    pixels = torch.full((1, 3, 1, 1), 127.5)
    found = TORCHVISION_RGB(pixels).flatten().tolist()
    means, stds = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    assert found == pytest.approx(
        [(0.5 - m) / s for m, s in zip(means, stds, strict=True)], abs=1e-4
    )


def test_local_safetensors_bring_their_normalisation(tmp_path):
    trunk = build_trunk("vgg16")
    path = tmp_path / "trunk.safetensors"
    state = {key: value.half() for key, value in trunk.state_dict().items()}
    save_file(state, path, {"input": "BGR 0..255 minus (103.939,116.779,123.68)"})
    loaded = load_trunk("vgg16", path)
    assert loaded.normalisation == KERAS_BGR
    torch.testing.assert_close(
        loaded.features[28].weight, trunk.features[28].weight, atol=1e-3, rtol=1e-2
    )


def test_a_classifier_in_the_file_is_left_out(tmp_path):
    trunk = build_trunk("vgg16")
    path = tmp_path / "vgg16.pth"
    torch.save({**trunk.state_dict(), "classifier.6.bias": torch.zeros(1000)}, path)
    loaded = load_trunk("vgg16", path)
    assert torch.equal(loaded.features[28].weight, trunk.features[28].weight)


def timm_names():
    """timm's keys of EfficientNet-Lite0, written from its module tree."""
    layers = {
        "stem": ("conv_stem", "bn1"),
        "separable": ("conv_dw", "bn1", "conv_pw", "bn2"),
        "inverted": ("conv_pw", "bn1", "conv_dw", "bn2", "conv_pwl", "bn3"),
    }
    prefixes = [("", layers["stem"])]
    for stage, blocks in enumerate((1, 2, 2, 3, 3, 4, 1)):
        for block in range(blocks):
            kind = "separable" if stage == 0 else "inverted"
            prefixes.append((f"blocks.{stage}.{block}.", layers[kind]))
    for prefix, names in prefixes:
        for name in names:
            parts = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
            for part in parts if name.startswith("bn") else ("weight",):
                yield f"{prefix}{name}.{part}"


def test_timms_keys_cover_ours():
    ours = set(build_trunk("efficientnet-lite0-stage7").state_dict())
    assert {timm_lite_key(key) for key in timm_names()} == ours


def test_a_file_of_another_network_is_refused(tmp_path):
    path = tmp_path / "resnet.safetensors"
    save_file({"conv1.weight": torch.zeros(64, 3, 7, 7)}, path)
    with pytest.raises(InputError, match=r"holds no weights of vgg16: features.0.weight"):
        load_trunk("vgg16", path)


def test_a_weight_of_another_shape_is_refused(tmp_path):
    state = build_trunk("vgg16").state_dict()
    state["features.0.weight"] = torch.zeros(64, 1, 3, 3)
    path = tmp_path / "grey.safetensors"
    save_file(state, path)
    with pytest.raises(InputError, match=r"features\.0\.weight is"):
        load_trunk("vgg16", path)


@pytest.mark.parametrize("name", ["x.safetensors", "x.pth"])
@pytest.mark.parametrize("content", [None, b"", b"no weights at all, only text in a file"])
def test_a_file_that_is_none_is_refused(name, content, tmp_path):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="Cannot read the weights"):
        load_trunk("vgg16", path)


def test_unknown_backbone_lists_those_there_are():
    with pytest.raises(InputError, match="resnet50"):
        build_trunk("vgg19")


def test_without_internet_one_sentence_says_what_to_fetch_and_where_to_put_it(
    tmp_path, monkeypatch
):
    def fail(*args, **kwargs):
        raise urllib.error.URLError("Name or service not known")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", fail)
    with pytest.raises(InputError) as fault:
        load_trunk("vgg16")
    assert VGG16_TORCHVISION.url in fault.value.message
    assert str(tmp_path / "hub" / "checkpoints" / "vgg16-397923af.pth") in fault.value.message
    assert "\n" not in fault.value.message


def test_a_download_with_a_wrong_checksum_is_refused(tmp_path, monkeypatch):
    """A real transfer through torch hub, from a file URL."""
    source = tmp_path / "vgg16-397923af.pth"
    torch.save(build_trunk("vgg16").state_dict(), source)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "home"))
    damaged = backbones.PublishedWeights(
        source.as_uri(), TORCHVISION_RGB, backbones.same_key, "none"
    )
    with pytest.raises(InputError, match="damaged"):
        damaged.state()
    assert not damaged.file.exists()


def test_published_weights_already_in_torch_hubs_cache_are_used(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    LITE0_TIMM.file.parent.mkdir(parents=True)
    trunk = build_trunk("efficientnet-lite0-stage7")
    by_our_key = trunk.state_dict()
    torch.save({key: by_our_key[timm_lite_key(key)] for key in timm_names()}, LITE0_TIMM.file)
    loaded = load_trunk("efficientnet-lite0-stage5")
    assert torch.equal(
        loaded._blocks[10]._project_conv.weight, trunk._blocks[10]._project_conv.weight
    )
    assert loaded.normalisation == LITE0_TIMM.normalisation
    assert os.environ["TORCH_HOME"] in str(LITE0_TIMM.file)
