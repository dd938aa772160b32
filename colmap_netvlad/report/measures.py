"""The measures of a comparison as one table: the terminal, the page and the CSV show the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from colmap_netvlad.comparison.result import (
    Comparison,
    MethodResult,
    ModelFigures,
    RetrievalFigures,
)
from colmap_netvlad.report.numbers import count, percent, seconds

NOT_RUNNING = (
    "exhaustive and random are not in the running, nor in times methods whose model lacks images"
)

COMPLETE = 0.99
"""A model is as complete as the fullest with this share of its registered images."""

MISSING = "–"
"""Stands where a method has no such figure."""


RETRIEVAL, TIME, MODEL = "Retrieval", "Time", "Model"


@dataclass(frozen=True)
class Measure:
    """One row of the summary.

    Attributes:
        key: column of `compare.csv`.
        title: as it is shown.
        better: +1 where more is better, -1 where less is, 0 where neither is.
        value: the figure of a method, or None.
        text: how a figure is written.
        help: one sentence of what it is.
        group: heading it stands under.
    """

    key: str
    title: str
    better: int
    value: Callable[[MethodResult], float | None]
    text: Callable[[float], str]
    help: str
    group: str

    def show(self, method: MethodResult) -> str:
        """Return the method's figure as text."""
        value = self.value(method)
        return MISSING if value is None else self.text(value)

    def best(self, methods: Sequence[MethodResult]) -> set[str]:
        """Return the names of the methods that are best, as far as the shown digits tell.

        The exhaustive reference and the floor of chance are not in the running, and with a time
        no method whose model lacks images that another's has; where all are equal none is best.
        """
        running = [m for m in methods if m.competes and not m.failed]
        if self.group == TIME:
            running = as_complete(running)
        values = {m.name: self.value(m) for m in running}
        known = {name: value for name, value in values.items() if value is not None}
        if not self.better or len(known) < 2:
            return set()
        top = self.text(max(known.values(), key=lambda value: self.better * value))
        best = {name for name, value in known.items() if self.text(value) == top}
        return best if len(best) < len(known) else set()


def as_complete(methods: Sequence[MethodResult]) -> list[MethodResult]:
    """Return the methods whose model has as many images as the fullest, or all without models."""
    registered = [m.model.registered if m.model else 0 for m in methods]
    least = COMPLETE * max(registered, default=0)
    return [m for m, count in zip(methods, registered, strict=True) if count >= least]


def _at_k(read: Callable[[RetrievalFigures], float | None]) -> Callable[..., float | None]:
    return lambda method: read(method.best_k) if method.best_k else None


def _of_model(read: Callable[[ModelFigures], float | None]) -> Callable[..., float | None]:
    return lambda method: read(method.model) if method.model and not method.model.failed else None


def _efficiency(method: MethodResult) -> float | None:
    if method.seconds_describe is None or method.seconds_search is None:
        return None
    return method.seconds_describe + method.seconds_search


def _total(method: MethodResult) -> float | None:
    retrieval = _efficiency(method) if method.ranks else 0.0
    matching = _of_model(lambda m: m.seconds_match)(method)
    spent = (retrieval, matching, _of_model(lambda m: m.seconds)(method))
    return None if None in spent else sum(part for part in spent if part is not None)


def _pairs_per_image(method: MethodResult) -> float | None:
    model = method.model
    if not model or not model.registered:
        return None
    pairs = next((figures.pairs for figures in method.at_k if figures.k == model.k), None)
    return None if pairs is None else pairs / model.registered


MEASURES: tuple[Measure, ...] = (
    Measure("pairs", "Image pairs", 0, _at_k(lambda f: f.pairs), count,
            "Distinct pairs retrieved: the union of every image's k partners.", RETRIEVAL),
    Measure("correct", "Correct pairs", +1, _at_k(lambda f: f.correct), count,
            "Pairs with more than 15 verified matches: the view graph's connections.", RETRIEVAL),
    Measure("accuracy", "Accuracy", +1, _at_k(lambda f: f.accuracy), percent,
            "Correct pairs over retrieved pairs (paper, eq. 19).", RETRIEVAL),
    Measure("recall", "Recall", +1, _at_k(lambda f: f.recall), percent,
            "Share of the reference's pairs that was retrieved.", RETRIEVAL),
    Measure("mean_average_precision", "Mean average precision", +1,
            lambda m: m.mean_average_precision, percent,
            "Average precision of an image's ranked partners, mean over images.", RETRIEVAL),
    Measure("components", "View graph components", -1, _at_k(lambda f: f.components), count,
            "Connected parts of the view graph; 1 is a flight that holds together.", RETRIEVAL),
    Measure("articulation_images", "Articulation images", -1,
            _at_k(lambda f: f.articulation_images), count,
            "Images whose loss splits the view graph.", RETRIEVAL),
    Measure("bridges", "Bridges", -1, _at_k(lambda f: f.bridges), count,
            "Connections whose loss splits the view graph.", RETRIEVAL),
    Measure("seconds_describe", "Describing (T_fe)", -1, lambda m: m.seconds_describe, seconds,
            "Global description of all images; local features are there already.", TIME),
    Measure("seconds_search", "Searching (T_nns)", -1, lambda m: m.seconds_search, seconds,
            "Nearest neighbours, and comparing candidates place by place.", TIME),
    Measure("seconds_retrieval", "Retrieval in all", -1, _efficiency, seconds,
            "T_fe + T_nns (paper, eq. 20).", TIME),
    Measure("seconds_match", "Matching", -1, lambda m: m.seconds_match, seconds,
            "Matching and verifying the method's own pairs.", TIME),
    Measure("seconds_map", "Mapping", -1, _of_model(lambda m: m.seconds), seconds,
            "Incremental mapping.", TIME),
    Measure("seconds_total", "Total", -1, _total, seconds,
            "Retrieval, matching the model's pairs, and mapping.", TIME),
    Measure("registered", "Registered images", +1, _of_model(lambda m: m.registered), count,
            "Images in the largest model.", MODEL),
    Measure("in_any_model", "Images in all models", +1, _of_model(lambda m: m.in_any_model), count,
            "Images in the largest model or a smaller one beside it.", MODEL),
    Measure("models", "Separate models", -1, _of_model(lambda m: m.models or None), count,
            "Models the mapper ended with; 1 is best.", MODEL),
    Measure("points", "3D points", +1, _of_model(lambda m: m.points), count,
            "Points of the largest model.", MODEL),
    Measure("mean_track_length", "Mean track length", +1,
            _of_model(lambda m: m.mean_track_length), lambda v: f"{v:.2f}",
            "Images that see a 3D point, on average.", MODEL),
    Measure("mean_reprojection_error", "Mean reprojection error", -1,
            _of_model(lambda m: m.mean_reprojection_error), lambda v: f"{v:.3f} px",
            "Distance between projected points and keypoints.", MODEL),
    Measure("pairs_per_image", "Pairs per registered image", -1, _pairs_per_image,
            lambda v: f"{v:.1f}", "Pairs matched for each image of the model: the price.", MODEL),
)  # fmt: skip


OF_MODEL = {m.key for m in MEASURES if m.group == MODEL} | {"seconds_map", "seconds_total"}
"""Measures that belong to the number of partners the model was made from (`ModelFigures.k`)."""


def shown(comparison: Comparison) -> list[Measure]:
    """Return the measures that some method of the comparison has a figure for."""
    return [
        measure
        for measure in MEASURES
        if any(measure.value(method) is not None for method in comparison.methods)
    ]
