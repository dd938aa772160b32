"""The training run: exact resume, bad input, what it leaves; on tiny rendered flights."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from colmap_netvlad.demo.render import FlightOptions, render_flight
from colmap_netvlad.models.aggregation import build_aggregation
from colmap_netvlad.models.backbones import build_trunk
from colmap_netvlad.models.checkpoint import load_model, load_network, read_metadata
from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.photos.files import photo_fingerprint
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training import history as history_module
from colmap_netvlad.training import run as run_module
from colmap_netvlad.training.augment import View
from colmap_netvlad.training.history import Epoch, draw_curves
from colmap_netvlad.training.inputs import KeptFeatures, Photos
from colmap_netvlad.training.options import BOUNDS, TrainOptions, read_recipe
from colmap_netvlad.training.run import Run, train
from colmap_netvlad.training.scenes import Scene, symmetric
from colmap_netvlad.training.stages import SplitNetwork, stages_of
from colmap_netvlad.training.validate import Score

LITE = "efficientnet-lite0-stage5"

# Tiny inputs: more threads only wait for each other.
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[Scene]:
    """Three flights over different ground; photos in sight of each other share points."""
    return [_flight(tmp_path_factory.mktemp(f"flight{seed}"), seed) for seed in (1, 2, 3)]


def _flight(folder: Path, seed: int) -> Scene:
    options = FlightOptions(rows=2, columns=4, width=128, height=96, seed=seed)
    flight = render_flight(folder, options)
    distances = np.linalg.norm(flight.centres[:, None, :2] - flight.centres[None, :, :2], axis=2)
    reach = 1.6 * np.min(distances[distances > 0])
    pairs = [
        (i, j, int(100 * (1.2 - distances[i, j] / reach)))
        for i in range(len(flight.names))
        for j in range(i + 1, len(flight.names))
        if distances[i, j] < reach
    ]
    count = len(flight.names)
    return Scene(
        name=f"flight{seed}",
        images=flight.images,
        names=tuple(flight.names),
        common_points=symmetric(pairs, count),
        matches=symmetric(pairs, count),
        sizes=np.tile(np.array([128, 96], np.int32), (count, 1)),
        model=np.zeros(count, np.int32),
        poses=np.zeros((count, 7)),
        points=1000,
        method="exhaustive",
        fingerprints=tuple(photo_fingerprint(flight.images / name) for name in flight.names),
    )


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of EfficientNet-Lite0 (all that the tests need of ImageNet)."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "lite.safetensors"
    save_file(build_trunk(LITE).state_dict(), path)
    return path


@pytest.fixture
def options(weights: Path) -> TrainOptions:
    return TrainOptions(
        trunk=LITE,
        weights=str(weights),
        clusters=4,
        width=96,
        height=64,
        positives=2,
        epsilon=10,
        epochs=2,
        iterations=3,
        checkpoint_every=1,
        learning_rate=1e-3,
        long_side=96,
        rotations=1,
        frozen="block4",
    )


@pytest.fixture(autouse=True)
def no_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than these trainings; one test draws."""
    monkeypatch.setattr(history_module, "draw_curves", lambda path, history: None)


Change = Callable[..., TrainOptions]
change: Change = dataclasses.replace


class Killed(BaseException):
    """Stands for a kill signal."""


def _die_after(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    original, done = Run._train_on, []

    def dying(self: Run, *arguments: object) -> float:
        if len(done) == steps:
            raise Killed
        done.append(1)
        return original(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Run, "_train_on", dying)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {
            "views": 2,
            "upright": 0.5,
            "mining": "flight",
            "negatives": "unmatched",
            "loss": "softmax",
            "keep_local": 0.5,
            "warm_up": 2,
            "assignment": 20.0,
        },
        {
            "loss": "correspondence",
            "aggregation": "netvlad-adapted",
            "mining": "flight",
            "pseudo_views": 4,
            "points": 30,
            "frozen": "block9",
        },
        {"mining": "global", "loss": "triplet"},
        {"aggregation": "gem", "pseudo_views": 4, "teacher": "start", "frozen": "block9"},
    ],
    ids=[
        "new views",
        "kept features of flights",
        "correspondences",
        "global mining",
        "pseudo-scenes and teacher",
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(
    settings: dict[str, object],
    flights: list[Scene],
    options: TrainOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = change(options, **settings)
    whole = train(flights[:2], flights[2:], options, tmp_path / "whole" / "run")
    with monkeypatch.context() as patch:
        _die_after(patch, 4)
        with pytest.raises(Killed):
            train(flights[:2], flights[2:], options, tmp_path / "killed" / "run")
    resumed = train(flights[:2], flights[2:], options, tmp_path / "killed" / "run")
    for name in ("initial", "best", "last"):
        one = (tmp_path / "whole" / "run" / f"{name}.safetensors").read_bytes()
        assert one == (tmp_path / "killed" / "run" / f"{name}.safetensors").read_bytes()
    first, second = (
        torch.load(tmp_path / which / "run" / "checkpoint.pt", weights_only=True)
        for which in ("whole", "killed")
    )
    for key, value in first["network"].items():
        assert torch.equal(value, second["network"][key]), key
    assert [e.as_dict() for e in whole.history] == [e.as_dict() for e in resumed.history]


def test_curves_are_drawn(tmp_path: Path) -> None:
    score = Score(0.5, 0.6, 0.7)
    epochs = [Epoch(0, 1e-5, float("nan"), {"a": score}), Epoch(1, 1e-5, 0.3, {"a": score})]
    draw_curves(tmp_path / "curves.png", epochs)
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_trains_validates_and_leaves_a_model_that_runs(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    options = change(options, views=2, epochs=3, iterations=8, same_flight=1)
    report = train(flights[:2], flights[2:], options, tmp_path / "run", metadata={"licence": "X"})
    assert [entry.epoch for entry in report.history] == [0, 1, 2, 3]
    best = max(report.history, key=lambda entry: entry.figure)
    card = read_metadata(report.best)
    assert card["epoch"] == best.epoch
    assert card["validation"] == ["flight3"]
    assert card["data"]["scenes"] == ["flight1", "flight2"]
    assert card["recipe"]["learning_rate"] == options.learning_rate and card["licence"] == "X"
    assert set(card["scores"]) == {"flight3"}
    assert card["recipe"]["weights"] == "lite.safetensors", "no folder of this machine"
    described = load_model(report.best, "cpu").describe(np.zeros((1, 3, 64, 96), np.uint8))
    assert described.shape == (1, 4 * 112)
    for name in ("history.json", "history.csv", "last.safetensors"):
        assert (tmp_path / "run" / name).stat().st_size > 0
    rows = (tmp_path / "run" / "history.csv").read_text().splitlines()
    assert len(rows) == 1 + 4 and rows[0].startswith("epoch,learning_rate,loss,flight3")
    assert read_metadata(tmp_path / "run" / "initial.safetensors")["epoch"] == 0


def test_training_lowers_the_loss(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    options = change(
        options,
        views=1,
        frozen="block10",
        mining="flight",
        loss="softmax",
        scenes_per_batch=3,
        flight_photos=8,
        epochs=3,
        iterations=8,
        learning_rate=1e-2,
        checkpoint_every=100,
    )
    history = train(flights, [], options, tmp_path / "run").history
    losses = [entry.loss for entry in history[1:]]
    assert losses[-1] < 0.8 * losses[0]


def test_frozen_stages_stay_and_the_others_move(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    train(flights[:2], [], change(options, epochs=1), tmp_path / "run")
    network = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["network"]
    start = load_file(options.weights or "")
    moved = {key for key in start if not torch.equal(start[key], network[f"trunk.{key}"])}
    assert moved, "the later stages were trained"
    assert all(int(key.split(".")[1]) >= 5 for key in moved)
    assert not any("running" in key for key in moved), "statistics of batch norms stay"


def test_correspondences_teach_the_local_features_and_the_centres_follow(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    options = change(
        options,
        loss="correspondence",
        aggregation="netvlad-adapted",
        mining="flight",
        pseudo_views=6,
        pseudo_share=1.0,
        scenes_per_batch=4,
        frozen="block10",
        views=2,
        epochs=3,
        iterations=10,
        noise=0.0,
    )
    report = train(flights[:2], flights[2:], options, tmp_path / "run")
    losses = [entry.loss for entry in report.history[1:]]
    assert losses[-1] < losses[0]
    first, last = (load_network(tmp_path / "run" / f"{n}.safetensors") for n in ("initial", "last"))
    assert not first.aggregation.adapt[-1].weight.any(), "it starts as NetVLAD"
    assert last.aggregation.adapt[-1].weight.any()
    assert not torch.equal(first.aggregation.centres, last.aggregation.centres)
    assert torch.equal(first.aggregation.mean, last.aggregation.mean)


def test_correspondences_need_to_know_where_points_are_and_take_no_teacher(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    options = change(options, loss="correspondence", aggregation="netvlad-adapted")
    blind = [dataclasses.replace(scene, observations=None) for scene in flights[:2]]
    with pytest.raises(InputError, match=f"{blind[0].name}.* annotate again"):
        train(blind, [], options, tmp_path / "run")
    with pytest.raises(InputError, match="leave `teacher` out"):
        train(flights[:2], [], change(options, teacher="start"), tmp_path / "run")


def test_a_network_to_start_from_settles_its_kind_whatever_the_settings_say(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    """Alpha of eq. 11, the card and the check of the loss follow the GeM, not `aggregation`."""
    gem = change(options, aggregation="gem", views=1)
    Run(flights[:2], [], gem, tmp_path / "gem")
    start = TrainOptions(
        start=str(tmp_path / "gem" / "initial.safetensors"),
        positives=2,
        epsilon=10,
        width=96,
        height=64,
    )
    run = Run(flights[:2], [], start, tmp_path / "run")
    assert run.options.for_losses().alpha == 0.9
    recipe = read_metadata(tmp_path / "run" / "initial.safetensors")["recipe"]
    assert (recipe["aggregation"], recipe["trunk"]) == ("gem", LITE)
    points = change(start, loss="correspondence", pseudo_views=4)
    with pytest.raises(InputError, match="of a NetVLAD, but the network's aggregation is gem"):
        Run(flights[:2], [], points, tmp_path / "points")


def test_a_run_begun_anew_is_taught_by_its_own_beginning(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    """The run before in the folder left its `initial.safetensors`."""
    options = change(options, teacher="start", aggregation="gem", epochs=1, iterations=1)
    train(flights[:2], [], options, tmp_path / "anew" / "run")
    (tmp_path / "anew" / "run" / "checkpoint.pt").unlink()
    for folder in ("anew", "fresh"):
        netvlad = change(options, aggregation="netvlad")
        run = Run(flights[:2], [], netvlad, tmp_path / folder / "run")
        assert run.teacher is not None
        assert run.teacher.similarities([(0, 0), (0, 1)]).shape == (2, 2)
    one, other = (tmp_path / folder / "run" for folder in ("anew", "fresh"))
    initial = (one / "initial.safetensors").read_bytes()
    assert initial == (other / "initial.safetensors").read_bytes()
    taught = [{path.name for path in (f / "cache").glob("teacher-*")} for f in (one, other)]
    assert taught[1] < taught[0], "both were taught by the same network"


@pytest.mark.parametrize("kept", [{}, {"views": 2, "upright": 0.5}], ids=["views", "kept views"])
def test_global_mining_describes_photos_whole_and_upright(
    kept: dict[str, object], flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    """Eq. 7 describes the photos, not views of them."""
    options = change(options, mining="global", loss="triplet", aggregation="gem", **kept)
    run = Run(flights[:2], [], options, tmp_path / "run")
    described = run._describe_all()[1].astype(np.float32)
    for image, found in enumerate(described):
        pixels = run.photos.render(1, image, View(np.eye(3))).transpose(2, 0, 1)
        with torch.inference_mode():
            upright = run.network(torch.from_numpy(pixels.copy())[None])[0].numpy()
        assert found @ upright > 0.999


def test_head_rate_is_a_factor_on_the_layers_learning_rate(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    run = Run(flights[:2], [], change(options, head_rate=2.0), tmp_path / "run")
    factor_of = {
        id(p): group["factor"] for group in run.optimizer.param_groups for p in group["params"]
    }
    assert factor_of.pop(id(run.network.network.aggregation.centres)) == 2.0
    assert factor_of.pop(id(run.network.network.aggregation.assignment)) == 2.0
    assert set(factor_of.values()) == {1.0}


@pytest.mark.parametrize("name", ["vgg16", "resnet50", LITE, "efficientnet-lite0-stage7"])
def test_the_stages_of_a_trunk_are_the_trunk(name: str) -> None:
    trunk = build_trunk(name).eval()
    pixels = torch.rand(1, 3, 64, 64)
    with torch.inference_mode():
        expected = trunk(pixels)
        for cut in list(stages_of(trunk))[::4]:
            network = GlobalDescriptor(trunk, build_aggregation(trunk.channels, {"kind": "max"}))
            split = SplitNetwork(network, cut)
            front = trunk.normalisation(pixels * 255)
            for layer in split.frozen_layers:
                front = layer(front)
            whole = trunk(trunk.normalisation(pixels * 255))
            assert torch.allclose(split.features(front), whole, atol=1e-4)
        x = pixels
        for stage in stages_of(trunk).values():
            x = stage(x)
        assert torch.allclose(x, expected, atol=1e-4)


def test_an_unknown_stage_is_named_with_those_there_are(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"no stage 'conv9'; it has stem, block0"):
        train(flights, [], change(options, frozen="conv9"), tmp_path / "run")


def test_nan_loss_stops_names_the_batch_and_keeps_the_checkpoint(
    flights: list[Scene],
    options: TrainOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, calls = run_module.LOSSES["ranked-list"], []

    def broken(*arguments: object) -> torch.Tensor:
        calls.append(1)
        loss = real(*arguments)  # type: ignore[arg-type]
        return loss * float("nan") if len(calls) == 3 else loss

    monkeypatch.setitem(run_module.LOSSES, "ranked-list", broken)
    with pytest.raises(InputError, match=r"not a number in batch 2 of epoch 0 \(flight\d/"):
        train(flights[:2], [], options, tmp_path / "run")
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert (saved["epoch"], saved["number"]) == (0, 2)
    assert all(torch.isfinite(value).all() for value in saved["network"].values())


def test_a_run_with_other_settings_or_scenes_is_not_continued(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    options = change(options, epochs=1, iterations=1)
    train(flights[:2], [], options, tmp_path / "run")
    with pytest.raises(InputError, match=r"other settings \(learning_rate\)"):
        train(flights[:2], [], change(options, learning_rate=1.0), tmp_path / "run")
    with pytest.raises(InputError, match="other scenes"):
        train(flights[1:], [], options, tmp_path / "run")
    more = train(flights[:2], [], change(options, epochs=2), tmp_path / "run")
    assert [entry.epoch for entry in more.history] == [0, 1, 2]
    (tmp_path / "run" / "checkpoint.pt").write_bytes(b"nothing")
    with pytest.raises(InputError, match="is not a checkpoint"):
        train(flights[:2], [], options, tmp_path / "run")


def test_validation_scenes_are_never_trained_on(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="Two scenes are named flight1"):
        train(flights[:2], flights[:1], options, tmp_path / "run")
    renamed = dataclasses.replace(flights[0], name="another")
    with pytest.raises(InputError, match="a photo must not be its own negative"):
        train(flights[:2], [renamed], options, tmp_path / "run")


def test_a_photo_that_is_gone_is_named(
    flights: list[Scene], options: TrainOptions, tmp_path: Path
) -> None:
    images = tmp_path / "images"
    shutil.copytree(flights[0].images, images)
    scene = dataclasses.replace(flights[0], images=images)
    (images / scene.names[3]).unlink()
    with pytest.raises(InputError, match=rf"{scene.names[3]} of scene flight1 is missing"):
        train([scene, flights[1]], [], change(options, views=1), tmp_path / "run")


def test_kept_features_go_on_where_a_killed_run_stopped(
    flights: list[Scene],
    options: TrainOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = change(options, views=2)
    photos = Photos(flights[:1], options)
    trunk = build_trunk(LITE)
    network = SplitNetwork(
        GlobalDescriptor(trunk, build_aggregation(112, {"kind": "gem"})), options.frozen
    )
    whole = KeptFeatures(photos, network, options, tmp_path / "whole")
    content = whole.path.read_bytes()
    part = tmp_path / "part" / whole.path.name
    part.parent.mkdir()
    part.write_bytes(content[: len(content) // 2 + 7])
    made: list[int] = []
    original = KeptFeatures._draw

    def counted(self: KeptFeatures, number: int) -> tuple[int, int, View]:
        made.append(number)
        return original(self, number)

    monkeypatch.setattr(KeptFeatures, "_draw", counted)
    KeptFeatures(photos, network, options, tmp_path / "part")
    assert part.read_bytes() == content
    assert made == list(range(8, 16))


def test_a_disk_too_small_for_the_features_is_one_sentence(
    flights: list[Scene],
    options: TrainOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError, match="make room, or lower `views`"):
        train(flights[:2], [], change(options, views=2), tmp_path / "run")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_sentence(
    flights: list[Scene],
    options: TrainOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """torch.save writes to a full device; the checkpoint before stays."""
    save = torch.save
    calls: list[int] = []

    def full(record: object, path: Path) -> None:
        calls.append(1)
        save(record, Path("/dev/full") if len(calls) == 3 else path)

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(InputError, match=r"Cannot write .*checkpoint\.pt"):
        train(flights[:2], [], options, tmp_path / "run")
    monkeypatch.undo()
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert saved["number"] == 1
    assert [path.name for path in (tmp_path / "run").glob("*checkpoint*")] == ["checkpoint.pt"]


def test_recipes_are_read_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text('loss = "triplet"\nlearning_rate = 1\nviews = 4\nfrozen = "conv5_2"\n')
    assert read_recipe(path) == {
        "loss": "triplet",
        "learning_rate": 1.0,
        "views": 4,
        "frozen": "conv5_2",
    }
    for text, said in (
        ("lr = 1", "lr, which is no setting"),
        ("views = 'many'", "views must be a int"),
        ("= 3", "is not TOML"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=said):
            read_recipe(path)
    with pytest.raises(InputError, match="does not exist"):
        read_recipe(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"loss": "softest"}, "`loss` is 'softest'; it is one of ranked-list"),
        ({"epochs": 0}, "`epochs` is 0; it must be at least 1"),
        ({"momentum": 1.5}, "`momentum` is 1.5; it must be at least 0 and less than 1"),
        ({"weight_decay": -1.0}, "`weight_decay` is -1.0; it must be at least 0"),
        ({"seed": -1}, "`seed` is -1; it must be at least 0 and at most 2147483647"),
        ({"flight_photos": 0, "mining": "flight"}, "`flight_photos` is 0"),
        ({"views": -1, "frozen": "conv5_2"}, "`views` is -1"),
        ({"width": 8, "height": 8}, "`width` is 8"),
        ({"rotation": -5.0}, "`rotation` is -5.0"),
        ({"illumination": -1.0}, "`illumination` is -1.0"),
        ({"warm_up": -5}, "`warm_up` is -5"),
        ({"head_rate": -1.0}, "`head_rate` is -1.0"),
        ({"hard_negatives": 0}, "`hard_negatives` is 0"),
        ({"same_flight": -1}, "`same_flight` is -1"),
        ({"upright": 3.0}, "`upright` is 3.0"),
        ({"keep_local": -1.0}, "`keep_local` is -1.0; it must be more than 0 and at most 1"),
        ({"alpha": -1.0}, "`alpha` is -1.0"),
        ({"learning_rate": float("inf")}, "`learning_rate` is inf; it must be finite and more"),
        ({"margin": float("nan")}, "`margin` is nan; it must be finite and at least 0"),
        ({"pseudo_views": 2}, "`pseudo_views` is 2; it must be 0 or more than `positives`"),
        ({"scenes_per_batch": 1}, "`scenes_per_batch` is 1, so that no anchor has a negative"),
        ({"scale_max": 0.1}, "below `scale_min`"),
        ({"rotations": 3}, "`rotations` is 3"),
        ({"views": 2}, "say with `frozen`"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        TrainOptions(**settings)  # type: ignore[arg-type]


def test_every_number_among_the_settings_has_a_range_that_holds_its_default() -> None:
    for item in dataclasses.fields(TrainOptions):
        kind = item.metadata.get("type", type(item.default))
        if kind in (int, float) and item.name != "rotations":  # which is 1 or 4
            assert set(item.metadata) & set(BOUNDS), item.name
    TrainOptions()


@pytest.mark.parametrize("name", ["netvlad-o", "netvlad-o-lite", "paper"])
def test_the_recipes_that_come_with_the_project_can_be_trained(name: str) -> None:
    recipes = Path(__file__).parent.parent / "scripts" / "recipes"
    TrainOptions(**read_recipe(recipes / f"{name}.toml"))


def test_the_defaults_are_the_numbers_of_the_papers_recipe() -> None:
    recipe = json.loads(json.dumps(TrainOptions().as_dict()))
    paper = {
        "trunk": "vgg16",
        "aggregation": "netvlad",
        "loss": "ranked-list",
        "mining": "nontrivial",
        "learning_rate": 1e-5,
        "decay": 0.1,
        "momentum": 0.9,
        "weight_decay": 5e-4,
        "scenes_per_batch": 5,
        "positives": 3,
        "width": 480,
        "height": 320,
        "epochs": 20,
        "iterations": 2000,
        "margin": 0.1,
        "same_flight": 0,
    }
    assert {key: recipe[key] for key in paper} == paper
    alphas = {
        kind: TrainOptions(aggregation=kind).for_losses().alpha
        for kind in ("netvlad", "gem", "max")
    }
    assert alphas == {"netvlad": 1.35, "gem": 0.9, "max": 0.9}
