"""The figures of a comparison, and their file `compare.json`."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically
from colmap_netvlad.runtime.plain import plain

FORMAT = 2
"""Version of `compare.json`."""

EXHAUSTIVE = "exhaustive"
"""The method that asks for every pair: where it ran, its verified pairs are the truth."""

CHANCE = "random"
"""The method that draws by chance: the floor under all others."""

UNION = "union"
"""Without it, the verified pairs of all methods together stand for the truth."""


@dataclass(frozen=True)
class RetrievalFigures:
    """One method's pairs at one number of partners `k`.

    Attributes:
        pairs: distinct image pairs, N(RP) of eq. 19.
        correct: those with more than 15 verified matches, N(MP); the view graph's connections.
        accuracy: eq. 19, 0..1; None where nothing was retrieved.
        recall: share of the reference's pairs, 0..1; None where the reference is empty.
        components: connected components of the view graph, single images included.
        largest_component: images in the largest of them.
        articulation_images, bridges: images and connections whose loss splits a component.
    """

    k: int
    pairs: int
    correct: int
    accuracy: float | None
    recall: float | None
    components: int
    largest_component: int
    articulation_images: int
    bridges: int


@dataclass(frozen=True)
class ModelFigures:
    """The reconstruction from one method's pairs.

    Attributes:
        k: partners an image that it was made from.
        models: how many separate models the mapper made; 0 where nothing registered.
        registered, points, observations, mean_reprojection_error (px), mean_track_length: of the
            largest model; 0 or None where there is none.
        in_any_model: images in the largest or any other of its models; None where it was made
            before this was counted.
        seconds: mapping, s.
        failed: the mapper's fault, where it did not finish.
        seconds_match: of the pairs it was made from, as `MethodResult.seconds_match`, s.
    """

    k: int
    models: int = 0
    registered: int = 0
    points: int = 0
    observations: int = 0
    mean_reprojection_error: float | None = None
    mean_track_length: float | None = None
    in_any_model: int | None = None
    seconds: float = 0.0
    failed: str | None = None
    seconds_match: float | None = None


@dataclass(frozen=True)
class MethodResult:
    """All figures of one method.

    Attributes:
        name, summary: of the table of methods.
        failed: why the method gave no ranking, or None.
        notes: what the method says about itself (which vocabulary tree, photos left out, ...).
        seconds_describe, seconds_search: T_fe and T_nns of eq. 20, s; None where it failed.
        timed_earlier: a time was measured in an earlier run, whose descriptors were reused.
        seconds_match: matching and verifying this method's own pairs at the largest k, s: the
            sum of what each of them took when it was matched for all methods, all processors
            at work.
        match_measured: share of these pairs whose time was measured, 0..1; the others (their
            run was killed before it could write the time down) count as the mean of the rest.
        mean_average_precision: of its lists down to `Comparison.precision_depth`, 0..1; None for
            a method that does not rank.
        only_here: correct pairs that no other method (exhaustive and random apart) retrieved.
        at_k: retrieval figures, ascending in k.
        model: the reconstruction, or None where there was to be none.
    """

    name: str
    summary: str
    failed: str | None = None
    notes: tuple[str, ...] = ()
    seconds_describe: float | None = None
    seconds_search: float | None = None
    timed_earlier: bool = False
    seconds_match: float | None = None
    match_measured: float = 1.0
    mean_average_precision: float | None = None
    only_here: int = 0
    at_k: tuple[RetrievalFigures, ...] = ()
    model: ModelFigures | None = None

    @property
    def best_k(self) -> RetrievalFigures | None:
        """The figures at the largest k."""
        return self.at_k[-1] if self.at_k else None

    @property
    def ranks(self) -> bool:
        """Whether it orders partners (the exhaustive method asks for all of them)."""
        return self.name != EXHAUSTIVE

    @property
    def competes(self) -> bool:
        """Whether it can be best: chance is the floor, and the exhaustive method the ceiling."""
        return self.name not in (EXHAUSTIVE, CHANCE)


@dataclass(frozen=True)
class Comparison:
    """The same project under several methods: everything in `compare.json`.

    Attributes:
        project: name of the database file.
        images: images in the database.
        images_without_features: of these, how many have no local features.
        keypoints: local features in all.
        ks: numbers of partners compared, ascending.
        seed: seed of every method, of verification and of mapping.
        reference: "exhaustive" or "union": which pairs recall and average precision are against.
        reference_pairs: how many these are.
        precision_depth: partners of an image that average precision looks at: all others where
            matching was exhaustive, else the largest k, down to which every pair was matched.
        pairs_matched: distinct pairs of all methods, each matched once.
        pairs_requested: the sum of all methods' pairs, matched one by one without sharing.
        seconds_matched: what matching the distinct pairs took, s.
        matcher: who matched all pairs, the reference's too: a name in `matchers.MATCHERS`, and
            whether thoroughly.
        versions: of the programs that the figures depend on, and the processor.
        methods: in the order they were asked for.
    """

    project: str
    images: int
    images_without_features: int
    keypoints: int
    ks: tuple[int, ...]
    seed: int
    reference: str
    reference_pairs: int
    precision_depth: int
    pairs_matched: int
    pairs_requested: int
    seconds_matched: float
    versions: dict[str, str] = field(default_factory=dict)
    methods: tuple[MethodResult, ...] = ()
    matcher: str = "colmap"

    @property
    def k(self) -> int:
        """The largest number of partners: the summary's and the matching times'."""
        return self.ks[-1]

    @property
    def model_k(self) -> int | None:
        """The number of partners that the models were made from; None where there is no model."""
        return next((method.model.k for method in self.methods if method.model), None)

    @property
    def incomplete(self) -> list[str]:
        """One sentence for each method that did not finish."""
        sentences = []
        for method in self.methods:
            if method.failed:
                sentences.append(f"{method.name}: {method.failed}")
            elif method.model and method.model.failed:
                sentences.append(f"{method.name}: mapping failed: {method.model.failed}")
        return sentences


def write_json(path: Path, comparison: Comparison) -> None:
    """Write `compare.json`; figures that do not exist are null.

    Raises:
        InputError: the file cannot be written.
    """
    content = {"format": FORMAT, **plain(comparison)}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    write_atomically(path, text + "\n")


def read_json(path: Path) -> Comparison:
    """Read `compare.json`.

    Raises:
        InputError: the file is not there, not one, or of another version.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist; `colmap-netvlad compare` makes it.")
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        version = content.pop("format")
        if version != FORMAT:
            raise InputError(
                f"{path} has format {version}, this version of colmap-netvlad reads {FORMAT}; "
                "run `colmap-netvlad compare` again."
            )
        methods = tuple(_method(row) for row in content.pop("methods"))
        return Comparison(**{**content, "ks": tuple(content["ks"])}, methods=methods)
    except (ValueError, KeyError, TypeError, AttributeError) as fault:
        raise InputError(f"{path} is not a comparison: {fault!r}.") from fault


def _method(row: dict[str, Any]) -> MethodResult:
    model = row.pop("model")
    return MethodResult(
        **{**row, "notes": tuple(row["notes"])}
        | {
            "at_k": tuple(RetrievalFigures(**figures) for figures in row["at_k"]),
            "model": None if model is None else ModelFigures(**model),
        }
    )
