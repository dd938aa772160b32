"""A training run: its network, its epochs, its checkpoints, what it leaves in its folder.

    <output>/initial.safetensors   the network before training
    <output>/best.safetensors      the network of the best validated epoch (float16)
    <output>/last.safetensors      the network after the last epoch
    <output>/checkpoint.pt         everything needed to go on where the run stopped
    <output>/history.json, .csv    a row an epoch: learning rate, loss, scores
    <output>/curves.png            the same as curves
    <output>/cache/                frozen features, teacher's descriptors (may be removed)

Nothing here draws from a global random generator: batches and views follow from the seed, the
epoch and the number of the batch. That is what makes a resumed run equal an uninterrupted one,
bit for bit on the same processor.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from colmap_netvlad.models.aggregation import NetVLAD, build_aggregation
from colmap_netvlad.models.backbones import load_trunk
from colmap_netvlad.models.checkpoint import load_model, load_network, save_checkpoint
from colmap_netvlad.models.describe import choose_device
from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path
from colmap_netvlad.training.augment import pseudo_scene
from colmap_netvlad.training.correspondences import correspondence_loss, draw_correspondences
from colmap_netvlad.training.history import Epoch, write_history
from colmap_netvlad.training.inputs import Drawn, Inputs, KeptFeatures, Photos
from colmap_netvlad.training.losses import LOSSES, keep_similarities
from colmap_netvlad.training.options import CORRESPONDENCE, TrainOptions
from colmap_netvlad.training.sampling import Batch, Query, Sampler
from colmap_netvlad.training.scenes import Scene, check_disjoint
from colmap_netvlad.training.stages import SplitNetwork
from colmap_netvlad.training.teacher import Teacher
from colmap_netvlad.training.validate import Validation
from colmap_netvlad.training.visibility import by_views

logger = logging.getLogger(__name__)

CHECKPOINT_VERSION = 1

INITIAL_FEATURES = 60_000
"""Local features that NetVLAD's centres are found among."""

MAY_CHANGE = frozenset({"epochs", "checkpoint_every"})
"""Settings that a resumed run may be given anew: they change no batch already trained."""


@dataclass
class TrainReport:
    """What a run came to.

    Attributes:
        history: one entry a validated epoch; the first is the network before training.
        best: checkpoint of the best epoch.
        left_out: sentences on training scenes that could not be used.
    """

    history: list[Epoch]
    best: Path
    left_out: list[str] = field(default_factory=list)


def train(
    scenes: Sequence[Scene],
    validation: Sequence[Scene],
    options: TrainOptions,
    output: Path,
    *,
    device: str | None = None,
    name: str | None = None,
    metadata: dict[str, Any] | None = None,
    cache: Path | None = None,
) -> TrainReport:
    """Train a network; a run that was killed goes on from its last checkpoint.

    Args:
        scenes: annotated training scenes.
        validation: annotated scenes that are never trained on; without them the last epoch is
            the best.
        output: the run's folder.
        device: cpu, cuda, ...; None: cuda where there is one, else cpu. On CUDA in mixed precision.
        name: what the model calls itself; default: the folder's name.
        metadata: more for the model's card (command, commit, licence).
        cache: folder of frozen features, which runs on the same photos may share; default:
            `<output>/cache`.

    Raises:
        InputError: a training scene is a validation scene as well or shares a photo with one,
            too few scenes, a run with other settings is in the folder, a photo is gone, the loss
            is not a number or not one for the network to start from, or the disk is full.
    """
    check_disjoint([*scenes, *validation])
    return Run(scenes, validation, options, output, Card(device, name, metadata, cache)).go()


def _check_points(scenes: Sequence[Scene], options: TrainOptions) -> None:
    """Raise InputError where a scene does not say which points its photos show, but has to.

    Pseudo-scenes know: views cut from one photo.
    """
    if options.loss != CORRESPONDENCE or options.pseudo_views:
        return
    unknown = [scene.name for scene in scenes if scene.observations is None]
    if unknown:
        raise InputError(
            f"The annotation of {', '.join(unknown)} does not say where its photos show which "
            "points, which the correspondence loss needs: annotate again, or set `pseudo_views`."
        )


def report_lines(report: TrainReport) -> list[str]:
    """Return what `train` prints: the model, and its scores beside those before training."""
    lines = [f"Model: {report.best}"]
    first, best = report.history[0], max(report.history, key=lambda entry: entry.figure)
    if best.scores:
        lines.append(f"Best epoch: {best.epoch}. mAP and accuracy at k = 10, 20, %:")
    for scene, score in best.scores.items():
        before = first.scores[scene]
        figures = " ".join(
            f"{100 * then:5.1f} -> {100 * now:5.1f} "
            for then, now in zip(astuple(before), astuple(score), strict=True)
        )
        lines.append(f"  {scene:24} {figures}".rstrip())
    return lines


@dataclass(frozen=True)
class Card:
    """Where a run computes and what its model says of itself; see `train`."""

    device: str | None = None
    name: str | None = None
    metadata: dict[str, Any] | None = None
    cache: Path | None = None


class Run:
    """A training run under way. Use `train`."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        validation: Sequence[Scene],
        options: TrainOptions,
        output: Path,
        card: Card | None = None,
    ) -> None:
        card = card or Card()
        self.output = output
        self.name = card.name or output.resolve().name
        self.metadata = card.metadata or {}
        self.device = choose_device(card.device)
        self.validation_scenes = [scene.name for scene in validation]
        self.real_scenes = list(scenes)
        _check_points(self.real_scenes, options)
        self.scenes = [*scenes, *_pseudo_scenes(scenes, options)]
        self.sampler = Sampler(self.scenes, options.for_sampling())
        self.photos = Photos(self.scenes, options)
        network = _build(options)
        self.options = options = _of_network(options, network)
        output.mkdir(parents=True, exist_ok=True)
        saved = self._load_checkpoint()
        self.network = SplitNetwork(network, options.frozen).to(self.device)
        self.network.train(False)
        cache = card.cache or output / "cache"
        self.validation = Validation(validation, options.long_side, options.rotations, cache)
        self.inputs: Inputs = (
            KeptFeatures(self.photos, self.network, options, cache)
            if options.views
            else self.photos
        )
        self.history: list[Epoch] = []
        self.epoch = self.number = 0
        self.mined: list[Batch] | None = None
        self.losses: list[float] = []
        if saved is None:
            self._initialise()
            self._save_model("initial")
        self.teacher = self._teacher(cache)
        self.optimizer = self._optimizer()
        if saved is not None:
            self._restore(saved)

    def go(self) -> TrainReport:
        """Train to the last epoch."""
        options = self.options
        if not self.history:
            self._end_of_epoch(loss=math.nan)
        total = options.epochs * options.iterations
        with progress.step("Training", total) as bar:
            bar.advance(min(total, self.epoch * options.iterations + self.number))
            while self.epoch < options.epochs:
                for batch, drawn in self._upcoming():
                    self.losses.append(self._train_on(batch, drawn))
                    self.number += 1
                    bar.advance()
                    if self.number % options.checkpoint_every == 0:
                        self._save_checkpoint()
                mean = float(np.nanmean(self.losses))
                self.epoch, self.number, self.mined, self.losses = self.epoch + 1, 0, None, []
                self._end_of_epoch(mean)
        return TrainReport(self.history, self.output / "best.safetensors", self.sampler.left_out)

    # A step.

    def _train_on(self, batch: Batch, drawn: Drawn) -> float:
        """Take one step of the optimiser and return the loss; NaN where no view has a positive."""
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate() * group["factor"]
        loss = self._loss(batch, drawn)
        if loss is None:
            return math.nan
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        parameters = self.network.trained().values()
        steepness = torch.nn.utils.get_total_norm(
            [p.grad for p in parameters if p.grad is not None]
        )
        if not (torch.isfinite(loss) and torch.isfinite(steepness)):
            raise InputError(self._nan_sentence(batch))
        self.optimizer.step()
        return loss.item()

    def _loss(self, batch: Batch, drawn: Drawn) -> Tensor | None:
        """Return the loss of a batch; None where its views have nothing in common."""
        rng = np.random.default_rng([self.options.seed, 2, self.epoch, self.number])
        if self.options.loss == CORRESPONDENCE:
            return self._correspondence_loss(batch, drawn, rng)
        return self._descriptor_loss(batch, drawn, rng)

    def _descriptor_loss(
        self, batch: Batch, drawn: Drawn, rng: np.random.Generator
    ) -> Tensor | None:
        options = self.options
        batch = by_views(batch, self.scenes, drawn.homographies, self.photos.size, options.epsilon)
        if not batch.queries:
            return None
        with self._mixed_precision():
            front = self.inputs.front(self.network, drawn.inputs.to(self.device))
            descriptors = self.network.rest(front, options.keep_local, rng).float()
        loss = LOSSES[options.loss](descriptors, batch.queries, options.for_losses())
        if self.teacher is not None:
            wanted = self.teacher.similarities(batch.samples).to(self.device)
            loss = loss + options.teacher_weight * keep_similarities(descriptors, wanted)
        return loss

    def _correspondence_loss(
        self, batch: Batch, drawn: Drawn, rng: np.random.Generator
    ) -> Tensor | None:
        """Return the mean over the scenes of a batch."""
        options, size = self.options, self.photos.size
        layer = self.network.network.aggregation
        assert isinstance(layer, NetVLAD)  # TrainOptions has seen to it
        with self._mixed_precision():
            front = self.inputs.front(self.network, drawn.inputs.to(self.device))
            features = self.network.features(front).float()
        spread = functional.normalize(features.detach(), dim=1).std(dim=(0, 2, 3)).mean()
        losses = []
        for found in draw_correspondences(
            batch, self.scenes, drawn.homographies, size, options.points, rng
        ):
            drawn_noise = rng.standard_normal((2 * len(found), features.shape[1]), np.float32)
            noise = options.noise * spread * torch.from_numpy(drawn_noise).to(self.device)
            losses.append(
                correspondence_loss(features, found, layer, size, options.temperature, noise)
            )
        return torch.stack(losses).mean() if losses else None

    def _mixed_precision(self) -> torch.autocast:
        """The network's precision on a GPU; losses are computed outside it, in float32."""
        return torch.autocast("cuda", torch.bfloat16, enabled=self.device.type == "cuda")

    def _nan_sentence(self, batch: Batch) -> str:
        photos = ", ".join(
            f"{self.scenes[scene].name}/{self.scenes[scene].names[image]}"
            for scene, image in batch.samples
        )
        return (
            f"The loss is not a number in batch {self.number} of epoch {self.epoch} ({photos}). "
            f"The last good checkpoint is {self.output / 'checkpoint.pt'}; lower `learning_rate`, "
            "or look at these photos."
        )

    def _upcoming(self) -> Iterator[tuple[Batch, Drawn]]:
        """Yield the rest of the epoch's batches; the next is prepared while one is trained on."""
        batches = self._batches()[self.number :]
        with ThreadPoolExecutor(1, thread_name_prefix="inputs") as pool:
            numbers = range(self.number, self.options.iterations)
            waiting = None
            for batch, number in zip(batches, numbers, strict=True):
                ahead = pool.submit(self.inputs.batch, batch, self.epoch, number)
                if waiting is not None:
                    yield waiting[0], waiting[1].result()
                waiting = batch, ahead
            if waiting is not None:
                yield waiting[0], waiting[1].result()

    def _batches(self) -> list[Batch]:
        if self.mined is not None:
            return self.mined
        descriptors = None
        if self.options.mining == "global":
            descriptors = self._describe_all()
        batches = self.sampler.batches(self.epoch, self.options.iterations, descriptors)
        if self.options.mining == "global":
            # A resumed run has other weights by now, so it cannot mine the same again.
            self.mined = batches
        return batches

    @torch.inference_mode()
    def _describe_all(self) -> list[np.ndarray]:
        """Describe all training photos as the network stands, for global mining (eq. 7)."""
        described = []
        with progress.step("Mining hard negatives", sum(map(len, self.scenes))) as bar:
            for number, scene in enumerate(self.scenes):
                rows = np.zeros((len(scene), self.network.network.dim), np.float16)
                for image in range(len(scene)):
                    inputs = self.inputs.for_mining(number, image)
                    front = self.inputs.front(self.network, inputs.to(self.device))
                    rows[image] = self.network.rest(front)[0].float().cpu().numpy()
                    bar.advance()
                described.append(rows)
        return described

    def _rate(self) -> float:
        """The learning rate l_i = l_0 exp(-0.1 i) (section 4.2), after a warm-up where asked."""
        options = self.options
        step = self.epoch * options.iterations + self.number
        rise = min(1.0, (step + 1) / options.warm_up) if options.warm_up else 1.0
        return rise * options.learning_rate * math.exp(-options.decay * self.epoch)

    # The end of an epoch.

    def _end_of_epoch(self, loss: float) -> None:
        options = self.options
        last = self.epoch == options.epochs
        if options.loss == CORRESPONDENCE and self.epoch:
            self._find_centres()  # the loss moves the features away from them
        if self.epoch % options.validate_every == 0 or last:
            scores = self.validation.scores(self.network) if self.validation.scenes else {}
            entry = Epoch(self.epoch, self._rate(), loss, scores)
            best = max((seen.figure for seen in self.history), default=-math.inf)
            self.history.append(entry)
            if entry.figure > best or not scores:
                self._save_model("best")
            logger.info(entry.line())
            write_history(self.output, self.history)
        if last:
            self._save_model("last")
        self._save_checkpoint()

    def _save_model(self, which: str) -> None:
        scores = {
            name: {key: round(100 * value, 2) for key, value in asdict(score).items()}
            for name, score in (self.history[-1].scores if self.history else {}).items()
        }
        card = {
            "name": self.name,
            "long_side": self.options.long_side,
            "rotations": self.options.rotations,
            "recipe": _portable(self.options.as_dict()),
            "epoch": self.epoch,
            "data": {
                "photos": sum(len(scene) for scene in self.real_scenes),
                "scenes": [scene.name for scene in self.real_scenes],
            },
            "validation": self.validation_scenes,
            "scores": scores,
            **self.metadata,
        }
        save_checkpoint(self.output / f"{which}.safetensors", self.network.network, card)

    # Beginning and going on.

    def _initialise(self) -> None:
        """Find NetVLAD's centres among local features of the training scenes (section 4.2)."""
        layer = self.network.network.aggregation
        if self.options.start is None and isinstance(layer, NetVLAD):
            self._find_centres()

    def _find_centres(self) -> None:
        layer = self.network.network.aggregation
        assert isinstance(layer, NetVLAD)
        drawn = _spread(self.real_scenes, limit=600, seed=self.options.seed)
        rng = np.random.default_rng([self.options.seed, 0])
        kept = []
        with progress.step("Local features for the centres", len(drawn)) as bar:
            for number, sample in enumerate(drawn):
                inputs = self.inputs.batch(Batch((sample,), ()), 0, number).inputs
                with torch.inference_mode():
                    front = self.inputs.front(self.network, inputs.to(self.device))
                    local = self.network.features(front)[0].flatten(1).T
                rows = rng.permutation(len(local))[: max(INITIAL_FEATURES // len(drawn), 1)]
                kept.append(local[torch.from_numpy(rows)].cpu().float().numpy())
                bar.advance()
        features = np.concatenate(kept)
        if len(features) < layer.clusters:
            raise InputError(
                f"{len(features)} local features cannot give {layer.clusters} centres; add photos "
                "or lower `clusters`."
            )
        layer.initialise(features, self.options.seed)
        if self.options.assignment is not None:
            layer.init_from_centres(layer.centres.detach().clone(), self.options.assignment)

    def _teacher(self, cache: Path) -> Teacher | None:
        options = self.options
        if options.teacher is None:
            return None
        own = options.teacher == "start"
        path = self.output / "initial.safetensors" if own else Path(options.teacher)
        return Teacher(load_model(path, str(self.device)), self.photos, cache)

    def _optimizer(self) -> torch.optim.Adam:
        options = self.options
        groups: dict[float, list[torch.nn.Parameter]] = {}
        for name, parameter in self.network.trained().items():
            factor = 1.0
            if not name.startswith("trunk."):
                factor = options.head_rate
            groups.setdefault(factor, []).append(parameter)
        return torch.optim.Adam(
            [{"params": group, "factor": factor} for factor, group in groups.items()],
            lr=options.learning_rate,
            betas=(options.momentum, 0.999),
            weight_decay=options.weight_decay,
        )

    def _save_checkpoint(self) -> None:
        record = {
            "version": CHECKPOINT_VERSION,
            "options": self.options.as_dict(),
            "scenes": self._scene_key(),
            "epoch": self.epoch,
            "number": self.number,
            "losses": self.losses,
            "mined": None if self.mined is None else [_plain(batch) for batch in self.mined],
            "history": [entry.as_dict() for entry in self.history],
            "network": self.network.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        with atomic_path(self.output / "checkpoint.pt") as temporary:
            try:
                torch.save(record, temporary)
            except RuntimeError as fault:  # torch's word for a full disk
                raise InputError(
                    f"Cannot write {self.output / 'checkpoint.pt'}: {fault}"
                ) from fault

    def _load_checkpoint(self) -> dict[str, Any] | None:
        path = self.output / "checkpoint.pt"
        if not path.is_file():
            return None
        try:
            saved: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
            version = saved["version"]
        except Exception as fault:  # torch raises a dozen kinds for files that are not its own
            raise InputError(
                f"{path} is not a checkpoint of a training run; remove it to start anew."
            ) from fault
        if version != CHECKPOINT_VERSION:
            raise InputError(
                f"{path} is of version {version}, this program continues version "
                f"{CHECKPOINT_VERSION}; give another `output`."
            )
        now = self.options.as_dict()
        changed = sorted(
            key for key in now if key not in MAY_CHANGE and saved["options"].get(key) != now[key]
        )
        if changed:
            raise InputError(
                f"{self.output} holds a run with other settings ({', '.join(changed)}); give "
                "another `output`, or remove its checkpoint.pt to start anew."
            )
        if saved["scenes"] != self._scene_key():
            raise InputError(
                f"{self.output} holds a run on other scenes; give another `output`, or remove its "
                "checkpoint.pt to start anew."
            )
        return saved

    def _restore(self, saved: dict[str, Any]) -> None:
        self.network.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(saved["optimizer"])
        self.epoch, self.number = saved["epoch"], saved["number"]
        self.losses = list(saved["losses"])
        self.history = [Epoch.from_dict(entry) for entry in saved["history"]]
        if saved["mined"] is not None:
            self.mined = [_batch(plain) for plain in saved["mined"]]

    def _scene_key(self) -> str:
        record = [(s.name, s.names, int(s.common_points.sum())) for s in self.scenes]
        text = repr((record, self.validation_scenes))
        return hashlib.sha256(text.encode()).hexdigest()


def _build(options: TrainOptions) -> GlobalDescriptor:
    """Make the network that training begins with, but for NetVLAD's centres."""
    if options.start is not None:
        network = load_network(options.start)
        network.axes = None  # they are of the features before (`scripts/make_axes.py`)
        return network
    trunk = load_trunk(options.trunk, Path(options.weights) if options.weights else None)
    kind = {"kind": options.aggregation}
    clusters = {"clusters": options.clusters} if "netvlad" in options.aggregation else {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)  # hidden layers of an aggregation start at random
        return GlobalDescriptor(trunk, build_aggregation(trunk.channels, kind | clusters))


def _of_network(options: TrainOptions, network: GlobalDescriptor) -> TrainOptions:
    """Return the settings as they are of a network: `start` settles what it is made of.

    Raises:
        InputError: the loss is not one for it.
    """
    layer = network.aggregation
    return replace(
        options,
        trunk=network.trunk.name,
        aggregation=layer.kind,
        clusters=layer.options().get("clusters", options.clusters),
    )


def _portable(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return settings whose files are named without their folders, fit to be published."""
    files = ("weights", "start", "teacher")
    return recipe | {key: Path(recipe[key]).name for key in files if recipe[key]}


def _pseudo_scenes(scenes: Sequence[Scene], options: TrainOptions) -> list[Scene]:
    if not options.pseudo_views:
        return []
    cut = options.for_pseudo_scenes()
    return [
        pseudo_scene(scene, image, (int(scene.sizes[image, 0]), int(scene.sizes[image, 1])), cut)
        for scene in scenes
        for image in range(len(scene))
    ]


def _spread(scenes: Sequence[Scene], limit: int, seed: int) -> list[tuple[int, int]]:
    """Choose up to `limit` photos at random from all scenes."""
    every = [(number, image) for number, s in enumerate(scenes) for image in range(len(s))]
    rng = np.random.default_rng([seed, 1])
    return [every[i] for i in sorted(rng.permutation(len(every))[:limit].tolist())]


def _plain(batch: Batch) -> list[Any]:
    queries = [[q.anchor, list(q.positives), list(q.negatives)] for q in batch.queries]
    return [[list(sample) for sample in batch.samples], queries]


def _batch(plain: list[Any]) -> Batch:
    samples, queries = plain
    return Batch(
        tuple((scene, image) for scene, image in samples),
        tuple(Query(a, tuple(positives), tuple(negatives)) for a, positives, negatives in queries),
    )
