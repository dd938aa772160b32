"""A comparison as one HTML page that needs nothing beside it: no network, no files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import networkx as nx
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from colmap_netvlad.comparison.evidence import Evidence
from colmap_netvlad.comparison.figures import FULL_RANKING
from colmap_netvlad.comparison.finds import single_finds
from colmap_netvlad.comparison.result import Comparison
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.report import plots
from colmap_netvlad.report.comparison import notes_of, partners_words, reference_sentence
from colmap_netvlad.report.examples import FINDS, PARTNERS, choose_examples, hardest_images
from colmap_netvlad.report.layout import Layout, align, lay_out
from colmap_netvlad.report.measures import (
    NOT_RUNNING,
    TIME,
    as_complete,
    shown,
)
from colmap_netvlad.report.numbers import count, percent, seconds
from colmap_netvlad.report.pages import pages
from colmap_netvlad.report.thumbnails import Thumbnails, data_uri


@dataclass(frozen=True)
class Figure:
    """A map in the page: what it shows, in words too."""

    method: str
    image: str
    alt: str
    caption: str


WEAK_POINTS = 12
"""Articulation images and bridges that the page lists of each method."""


@dataclass(frozen=True)
class WeakPoints:
    """Where the view graph of a method splits if one image or one connection is lost."""

    method: str
    images: list[str]
    bridges: list[Pair]


def render_page(comparison: Comparison, evidence: Evidence) -> str:
    """Return the page's HTML.

    What is drawn is capped (edges, points, queries, finds, images), so that a flight of 5,000
    images gives a page of the size that one of 200 gives.
    """
    layout = lay_out(evidence)
    finds = single_finds(evidence)
    environment = pages()
    environment.filters.update(count=count, percent=percent, duration=seconds)
    return environment.get_template("comparison.html").render(
        comparison=comparison,
        headlines=_headlines(comparison),
        reference=reference_sentence(comparison),
        partners=partners_words(comparison),
        apart=NOT_RUNNING,
        measures=shown(comparison),
        curves=_curves(comparison),
        legend=[(name, Markup(svg)) for name, svg in plots.legend(comparison)],
        bars=Markup(plots.time_bars(comparison)),
        layout=layout,
        not_placed=int((~layout.placed).sum()),
        graphs=_view_graphs(comparison, evidence, layout),
        weak=_weak_points(comparison, evidence),
        most_weak=WEAK_POINTS,
        plans=_model_plans(comparison, evidence, layout),
        examples=choose_examples(evidence),
        partners_shown=PARTNERS,
        finds={name: (len(found), found[:FINDS]) for name, found in finds.items()},
        hardest=hardest_images(evidence),
        full_ranking=comparison.images <= FULL_RANKING,
        thumbnail=Thumbnails(evidence.images),
        notes={method.name: notes_of(method) for method in comparison.methods},
    )


def _headlines(comparison: Comparison) -> list[str]:
    """The three things a reader wants first: the fullest model, the best pairs, the least time."""
    measures = {measure.key: measure for measure in shown(comparison)}
    sentences = []
    for key, phrase in (
        ("registered", "Most registered images"),
        ("accuracy", "Most of its pairs correct"),
        ("recall", "Most of the true pairs found"),
        ("seconds_total", "Least time in all"),
        ("seconds_retrieval", "Fastest retrieval"),
    ):
        if key not in measures:
            continue
        best = measures[key].best(comparison.methods)
        named = [m for m in comparison.methods if m.name in best]
        if named:
            value = measures[key].show(named[0])
            of = f" of {comparison.images:,}" if key == "registered" else ""
            of += _only_complete(comparison) if measures[key].group == TIME else ""
            sentences.append(f"{phrase}: {_and(m.name for m in named)} ({value}{of}).")
    registered = {m.name: m.model.registered for m in comparison.methods if m.model and m.competes}
    if len(registered) > 1 and len(set(registered.values())) == 1:
        equal = next(iter(registered.values()))
        sentences.insert(0, f"All methods register {equal:,} of {comparison.images:,} images.")
    return sentences


def _only_complete(comparison: Comparison) -> str:
    """Say that a time is compared among the methods with the fullest models only, where it is."""
    running = [m for m in comparison.methods if m.competes and not m.failed]
    return "" if len(as_complete(running)) == len(running) else ", of those with the fullest models"


def _curves(comparison: Comparison) -> list[tuple[str, Markup]]:
    if len(comparison.ks) < 2:
        return []
    charts = (
        ("Accuracy over k", "accuracy", "accuracy"),
        ("Recall over k", "recall", "recall"),
    )
    return [(title, Markup(plots.curve(comparison, key, axis))) for title, key, axis in charts]


def _view_graphs(comparison: Comparison, evidence: Evidence, layout: Layout) -> list[Figure]:
    index = {name: i for i, name in enumerate(evidence.names)}
    strongest = max(evidence.verified.values(), default=0)
    figures = []
    for method in comparison.methods:
        if method.best_k is None:
            continue
        edges, matches = _edges(evidence.pairs[method.name], evidence.verified, index)
        picture = plots.view_graph(layout.xyz[:, :2], edges, matches, strongest, layout.metric)
        alone = len(evidence.names) - len(np.unique(edges))
        words = (
            f"{method.best_k.correct:,} connections, "
            f"{_number(method.best_k.components, 'component')}"
        )
        words += f", {_number(alone, 'image')} without any" if alone else ""
        if len(matches) > plots.DRAWN_EDGES:
            words += f" (the {plots.DRAWN_EDGES:,} strongest are drawn)"
        alt = f"View graph of {method.name} on the ground plan: {words}."
        figures.append(Figure(method.name, data_uri("image/png", picture), alt, words))
    return figures


def _weak_points(comparison: Comparison, evidence: Evidence) -> list[WeakPoints]:
    weak = []
    for method in comparison.methods:
        figures = method.best_k
        if figures and (figures.articulation_images or figures.bridges):
            graph = evidence.view_graph(evidence.pairs[method.name])
            images = sorted(set(nx.articulation_points(graph)))
            weak.append(
                WeakPoints(
                    method.name, images, sorted(as_pair(*edge) for edge in nx.bridges(graph))
                )
            )
    return weak


def _model_plans(comparison: Comparison, evidence: Evidence, layout: Layout) -> list[Figure]:
    aligned = {name: align(plan, layout) for name, plan in evidence.plans.items()}
    if not aligned:
        return []
    window = plots.plan_window([plan.centres for plan in aligned.values()])
    figures = []
    for method in comparison.methods:
        plan = aligned.get(method.name)
        if plan is None or method.model is None:
            continue
        picture = plots.model_plan(plan.centres, plan.points, plan.colours, window, layout.metric)
        words = (
            f"{method.model.registered:,} of {comparison.images:,} images, "
            f"{method.model.points:,} points"
        )
        if method.model.models > 1:
            words += f" (the largest of {method.model.models} models"
            if method.model.in_any_model is not None:
                words += f", which have {method.model.in_any_model:,} images together"
            words += ")"
        alt = f"Cameras and points of the model of {method.name}, seen from above: {words}."
        figures.append(Figure(method.name, data_uri("image/png", picture), alt, words))
    return figures


def _edges(
    pairs: Iterable[Pair], verified: Mapping[Pair, int], index: Mapping[str, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    correct = sorted(
        (index[a], index[b], verified[a, b])
        for a, b in pairs
        if verified.get((a, b), 0) > CORRECT_MATCHES
    )
    table = np.array(correct, np.int64).reshape(-1, 3)
    return table[:, :2], table[:, 2]


def _number(value: int, noun: str) -> str:
    return f"{value:,} {noun}{'' if value == 1 else 's'}"


def _and(names: Iterable[str]) -> str:
    listed = list(names)
    return listed[0] if len(listed) == 1 else f"{', '.join(listed[:-1])} and {listed[-1]}"
