"""Every setting of a training run, in one table: the command line and recipe files are made of it.

The defaults are the numbers of the paper's recipe (section 4.2); that photos are shown in views
turned, cut and lit at random is ours, and what else departs from the paper is listed in
docs/annotation-and-training.md. A recipe is a TOML file with these names:

    trunk = "vgg16"
    loss = "ranked-list"
    learning_rate = 1e-5
"""

from __future__ import annotations

import math
import operator
import tomllib
from collections.abc import Callable
from dataclasses import Field, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training.augment import Augmentation, PseudoOptions
from colmap_netvlad.training.losses import LOSSES, LossOptions
from colmap_netvlad.training.sampling import MINING, NEGATIVES, SamplingOptions

ALPHA = {"netvlad": 1.35, "netvlad-adapted": 1.35, "gem": 0.9, "max": 0.9}
"""Margin alpha of eq. 11 by aggregation (section 4.3.2)."""


CORRESPONDENCE = "correspondence"
"""The loss over local features (`training.correspondences`)."""


BOUNDS: dict[str, Callable[[float, float], bool]] = {
    "at_least": operator.ge,
    "more_than": operator.gt,
    "at_most": operator.le,
    "less_than": operator.lt,
}
"""How the range of a number is said in `setting`, and what it asks."""

LARGEST_SEED = 2**31 - 1
"""faiss takes no larger one."""


def setting(default: Any, help: str, **more: Any) -> Any:
    """Make a field with the text of `train --help`.

    `more` may hold `choices`, `type`, and the range of a number by the names of `BOUNDS`.
    """
    return field(default=default, metadata={"help": help, **more})


@dataclass(frozen=True)
class TrainOptions:
    """The settings of a training run; what each means stands beside it."""

    # The network.
    trunk: str = setting("vgg16", "Trunk: a name of the table of backbones.")
    weights: str | None = setting(
        None, "ImageNet weights of the trunk, a file.  [default: downloaded]", type=str
    )
    aggregation: str = setting("netvlad", "Aggregation layer.", choices=tuple(ALPHA))
    clusters: int = setting(64, "Centres of NetVLAD.", at_least=1)
    assignment: float | None = setting(
        None,
        "alpha of NetVLAD's assignment at the beginning.  [default: from the features]",
        type=float,
        more_than=0,
    )
    start: str | None = setting(
        None, "Checkpoint to start from, instead of trunk, weights and aggregation.", type=str
    )
    frozen: str | None = setting(
        None, "Last stage of the trunk that stays as it is (conv5_2, block7, layer3).", type=str
    )

    # The photos.
    width: int = setting(480, "Width of a training view, px.", at_least=16)
    height: int = setting(320, "Height of a training view, px.", at_least=16)
    views: int = setting(
        0,
        "Views of each photo whose frozen features are kept on disk; 0: new ones each time.",
        at_least=0,
    )
    upright: float = setting(
        0.0, "Share of views that are the photo itself, whole and upright.", at_least=0, at_most=1
    )
    rotation: float = setting(180.0, "Largest turn of a view, degrees.", at_least=0, at_most=180)
    flip: float = setting(0.5, "Probability of a mirrored view.", at_least=0, at_most=1)
    scale_min: float = setting(
        0.65, "Smallest share of a photo's longer side in a view.", more_than=0
    )
    scale_max: float = setting(
        1.25, "Largest share of a photo's longer side in a view.", more_than=0
    )
    perspective: float = setting(
        0.08, "Largest shift of a view's corner, share of its side.", at_least=0, less_than=0.5
    )
    illumination: float = setting(
        0.2, "Strength of changes of illumination.", at_least=0, at_most=1
    )
    pseudo_views: int = setting(
        0,
        "Cut this many views from each photo as a pseudo-scene of known overlap; 0: none.",
        at_least=0,
    )
    pseudo_share: float = setting(
        0.3, "Share of anchors from pseudo-scenes, where there are any.", at_least=0, at_most=1
    )

    # The batches.
    mining: str = setting(
        "nontrivial", "Sample mining: eq. 8, eq. 7, or many photos of few flights.", choices=MINING
    )
    scenes_per_batch: int = setting(
        5, "B, the anchors of a batch, each of another scene.", at_least=1
    )
    positives: int = setting(3, "M, the positives of an anchor.", at_least=1)
    epsilon: int = setting(
        15, "A positive shares more 3D points than this with its anchor.", at_least=0
    )
    negatives: str = setting(
        "apart",
        "What a negative of the same flight is: surely apart (no common points or neighbours), or"
        " unmatched (needs exhaustively matched scenes).",
        choices=NEGATIVES,
    )
    hard_negatives: int = setting(2, "Negatives of an anchor in global mining.", at_least=1)
    flight_photos: int = setting(32, "Photos of each scene in a flight batch.", at_least=2)
    same_flight: int = setting(
        0, "Further negatives of the anchor's flight, surely apart.", at_least=0
    )

    # The loss.
    loss: str = setting(
        "ranked-list",
        "Loss over the descriptors of a batch; or correspondence: over the local features of"
        " points that two views show.",
        choices=(*LOSSES, CORRESPONDENCE),
    )
    margin: float = setting(
        0.1, "m, between positive and negative (eq. 9 and 11).", at_least=0, at_most=2
    )
    alpha: float | None = setting(
        None,
        "Radius of eq. 11.  [default: 1.35 for netvlad, else 0.9]",
        type=float,
        more_than=0,
        at_most=2,
    )
    contrastive_margin: float = setting(
        0.7, "Distance at which a negative costs nothing.", more_than=0, at_most=2
    )
    temperature: float = setting(
        0.05, "Temperature of the softmax and correspondence losses.", more_than=0
    )
    points: int = setting(
        384, "Points of each flight in a batch of the correspondence loss.", at_least=2
    )
    noise: float = setting(
        0.3,
        "Noise on local features in the correspondence loss, in units of their spread.",
        at_least=0,
    )
    nontrivial: bool = setting(True, "Leave samples of zero loss out of the average.")
    teacher: str | None = setting(
        None,
        "Checkpoint whose similarities the network is to keep; `start` is its own beginning.",
        type=str,
    )
    teacher_weight: float = setting(
        1.0, "Weight of keeping the teacher's similarities.", at_least=0
    )

    # The optimisation.
    epochs: int = setting(20, "Epochs.", at_least=1)
    iterations: int = setting(2000, "Batches of an epoch.", at_least=1)
    learning_rate: float = setting(1e-5, "Learning rate l_0 of Adam.", more_than=0)
    decay: float = setting(0.1, "The learning rate of epoch i is l_0 exp(-decay i).", at_least=0)
    warm_up: int = setting(0, "Batches over which the learning rate rises to l_0.", at_least=0)
    head_rate: float = setting(
        1.0, "Factor on the learning rate of the aggregation layer.", at_least=0
    )
    momentum: float = setting(0.9, "Adam's first beta.", at_least=0, less_than=1)
    weight_decay: float = setting(5e-4, "Weight decay.", at_least=0)
    keep_local: float = setting(
        1.0, "Share of a view's local features that a step looks at.", more_than=0, at_most=1
    )
    seed: int = setting(0, "Seed of every random choice.", at_least=0, at_most=LARGEST_SEED)

    # The model that comes out, and its measure.
    long_side: int = setting(
        480, "Longer side of a photo when it is described later, px.", at_least=16
    )
    rotations: int = setting(4, "Quarter turns a descriptor is averaged over later.")
    validate_every: int = setting(1, "Epochs between validations.", at_least=1)
    checkpoint_every: int = setting(
        500, "Batches between checkpoints, beside each epoch's.", at_least=1
    )

    def __post_init__(self) -> None:
        for item in fields(self):
            choices = item.metadata.get("choices")
            value = getattr(self, item.name)
            if choices and value not in choices:
                raise InputError(f"`{item.name}` is {value!r}; it is one of {', '.join(choices)}.")
            _check_range(item, value)
        if self.scale_max < self.scale_min:
            raise InputError(f"`scale_max` {self.scale_max} is below `scale_min` {self.scale_min}.")
        if self.rotations not in (1, 4):
            raise InputError(f"`rotations` is {self.rotations}; it is 1 or 4.")
        if 0 < self.pseudo_views <= self.positives:
            raise InputError(
                f"`pseudo_views` is {self.pseudo_views}; it must be 0 or more than `positives`, "
                f"which is {self.positives}."
            )
        others = self.scenes_per_batch > 1 or self.mining != "nontrivial"
        if not others and not self.same_flight and self.loss != CORRESPONDENCE:
            raise InputError(
                "`scenes_per_batch` is 1, so that no anchor has a negative; it must be at least 2 "
                "in nontrivial mining without `same_flight` negatives."
            )
        if self.loss == CORRESPONDENCE and "netvlad" not in self.aggregation:
            raise InputError(
                "The correspondence loss teaches the local features of a NetVLAD, but the "
                f"network's aggregation is {self.aggregation}; choose another loss."
            )
        if self.loss == CORRESPONDENCE and self.teacher is not None:
            raise InputError(
                "A teacher says how alike photos are, of which the correspondence loss knows "
                "nothing; leave `teacher` out, or choose another loss."
            )
        if self.views and self.frozen is None:
            raise InputError(
                "`views` keeps frozen features on disk: say with `frozen` up to where the trunk "
                "stays."
            )

    def for_losses(self) -> LossOptions:
        """The margins of the losses."""
        alpha = ALPHA[self.aggregation] if self.alpha is None else self.alpha
        return LossOptions(
            margin=self.margin,
            alpha=alpha,
            contrastive_margin=self.contrastive_margin,
            temperature=self.temperature,
            nontrivial=self.nontrivial,
        )

    def for_sampling(self) -> SamplingOptions:
        """How batches are drawn."""
        return SamplingOptions(
            mining=self.mining,
            scenes=self.scenes_per_batch,
            positives=self.positives,
            epsilon=self.epsilon,
            hard_negatives=self.hard_negatives,
            negatives=self.negatives,
            flight_photos=self.flight_photos,
            same_flight=self.same_flight,
            pseudo_share=self.pseudo_share if self.pseudo_views else 0.0,
            seed=self.seed,
        )

    def for_views(self) -> Augmentation:
        """How views differ from their photos."""
        return Augmentation(
            rotation=self.rotation,
            flip=self.flip,
            scale=(self.scale_min, self.scale_max),
            perspective=self.perspective,
            illumination=self.illumination,
        )

    def for_pseudo_scenes(self) -> PseudoOptions:
        """How pseudo-scenes are cut."""
        return PseudoOptions(views=self.pseudo_views, seed=self.seed)

    def as_dict(self) -> dict[str, Any]:
        """Plain data for checkpoints and records."""
        return asdict(self)


def _check_range(item: Field[Any], value: float | None) -> None:
    bounds = {name: item.metadata[name] for name in BOUNDS if name in item.metadata}
    if value is None or not bounds:
        return
    words = [f"{name.replace('_', ' ')} {bound}" for name, bound in bounds.items()]
    finite = -math.inf < value < math.inf
    if not finite:
        words = ["finite", *words]
    if not finite or not all(BOUNDS[name](value, bound) for name, bound in bounds.items()):
        raise InputError(f"`{item.name}` is {value}; it must be {' and '.join(words)}.")


def read_recipe(path: Path) -> dict[str, Any]:
    """Read the settings of a recipe file.

    Raises:
        InputError: it is missing, not TOML, or has a name or a kind of value that
            `TrainOptions` does not know.
    """
    if not path.is_file():
        raise InputError(f"The recipe {path} does not exist.")
    try:
        record = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise InputError(f"The recipe {path} is not TOML: {fault}.") from fault
    known = {item.name: item for item in fields(TrainOptions)}
    for name, value in record.items():
        if name not in known:
            raise InputError(
                f"The recipe {path} has {name}, which is no setting of training; "
                "`colmap-netvlad train --help` lists them."
            )
        kind = known[name].metadata.get("type", type(known[name].default))
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            record[name] = value = float(value)
        if type(value) is not kind:
            raise InputError(f"In the recipe {path}, {name} must be a {kind.__name__}.")
    return record
