"""Rankings, matches and models -> the figures of a comparison and what is behind them."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import networkx as nx
import pycolmap

from colmap_netvlad import metrics
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.comparison import pool
from colmap_netvlad.comparison.evidence import Evidence
from colmap_netvlad.comparison.finds import single_finds
from colmap_netvlad.comparison.models import read_plan
from colmap_netvlad.comparison.result import (
    EXHAUSTIVE,
    UNION,
    Comparison,
    MethodResult,
    ModelFigures,
    RetrievalFigures,
)
from colmap_netvlad.comparison.workspace import Workspace
from colmap_netvlad.flight import Flight
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.graph.verified import correct_pairs, verified_by_name
from colmap_netvlad.matching.options import MATCHER_DEFAULT
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.runtime.version import VERSION

FULL_RANKING = 1000
"""Up to this many images every method ranks all others, so that average precision is the
textbook's; search is exact there. With a small `--rerank` the first k need not be those of
`pairs --k`: neighbours vote for as many partners as are asked for."""


@dataclass
class Candidate:
    """One method under comparison: what it is called, and what is known of it so far."""

    text: str
    name: str
    summary: str
    ranking: Ranking | None = None
    timed_earlier: bool = False
    failed: str | None = None
    model: ModelFigures | None = None

    @property
    def ranks(self) -> bool:
        return self.name != EXHAUSTIVE


def gather_evidence(
    flight: Flight,
    workspace: Workspace,
    candidates: Sequence[Candidate],
    pairs: Mapping[str, set[Pair]],
) -> Evidence:
    """Read from the workspace what the page shows beside the figures.

    Args:
        pairs: by method, its pairs at the largest k.
    """
    everything = verified_by_name(workspace.union)
    if EXHAUSTIVE in pairs:
        verified = everything
    else:
        # Pairs only the cost of exhaustive matching was measured on belong to no method.
        wanted = set().union(*pairs.values())
        verified = {pair: count for pair, count in everything.items() if pair in wanted}
    plans = {
        c.name: read_plan(workspace.model_folder(c.name))
        for c in candidates
        if c.model and not c.model.failed
    }
    return Evidence(
        names=flight.names,
        images=flight.project.images,
        partners={c.name: c.ranking.partners for c in candidates if c.ranking and c.ranks},
        pairs=pairs,
        verified=verified,
        truth=correct_pairs(verified),
        positions=flight.positions.metres,
        plans={name: plan for name, plan in plans.items() if plan is not None},
    )


def compute_figures(
    flight: Flight,
    workspace: Workspace,
    candidates: Sequence[Candidate],
    pairs: Mapping[int, Mapping[str, set[Pair]]],
    evidence: Evidence,
    seed: int,
) -> Comparison:
    """Return all figures.

    Args:
        pairs: by k and method, its distinct pairs.
    """
    ks = tuple(sorted(pairs))
    widest = pairs[ks[-1]]
    seconds = workspace.pair_seconds()
    reference = EXHAUSTIVE if EXHAUSTIVE in widest else UNION
    full = reference == EXHAUSTIVE and len(flight.names) <= FULL_RANKING
    depth = len(flight.names) - 1 if full else ks[-1]
    found = {name: len(finds) for name, finds in single_finds(evidence).items()}
    methods = []
    for candidate in candidates:
        result = MethodResult(candidate.name, candidate.summary, failed=candidate.failed)
        ranking = candidate.ranking
        if ranking is not None:
            seconds_match, share = pool.seconds_of(widest[candidate.name], seconds)
            model = candidate.model
            if model is not None:
                made_from = pairs[model.k][candidate.name]
                model = replace(model, seconds_match=pool.seconds_of(made_from, seconds)[0])
            precision = metrics.mean_average_precision(ranking, evidence.truth, depth)
            result = replace(
                result,
                notes=(
                    *ranking.notes,
                    *_some(ranking.left_out, "left out"),
                    *_some(ranking.unseen, "ranked without the photo"),
                ),
                seconds_describe=ranking.seconds_describe if candidate.ranks else None,
                seconds_search=ranking.seconds_search if candidate.ranks else None,
                timed_earlier=candidate.timed_earlier,
                seconds_match=seconds_match,
                match_measured=share,
                mean_average_precision=_number(precision) if candidate.ranks else None,
                only_here=found.get(candidate.name, 0),
                at_k=tuple(retrieval_figures(pairs[k][candidate.name], k, evidence) for k in ks),
                model=model,
            )
        methods.append(result)
    return Comparison(
        project=flight.project.database.name,
        images=len(flight.names),
        images_without_features=len(flight.images) - len(flight.keypoints),
        keypoints=sum(flight.keypoints.values()),
        ks=ks,
        seed=seed,
        reference=reference,
        reference_pairs=len(evidence.truth),
        precision_depth=depth,
        pairs_matched=len(set().union(*widest.values())),
        pairs_requested=sum(map(len, widest.values())),
        seconds_matched=pool.seconds_of(set().union(*widest.values()), seconds)[0] or 0.0,
        versions=_versions(),
        methods=tuple(methods),
        matcher=workspace.matcher() or MATCHER_DEFAULT,
    )


def retrieval_figures(pairs: set[Pair], k: int, evidence: Evidence) -> RetrievalFigures:
    """Return what a method's pairs at `k` are worth."""
    graph = evidence.view_graph(pairs)
    sizes = [len(component) for component in nx.connected_components(graph)]
    return RetrievalFigures(
        k=k,
        pairs=len(pairs),
        correct=graph.number_of_edges(),
        accuracy=_number(metrics.accuracy(pairs, evidence.verified)),
        recall=_number(metrics.recall(pairs, evidence.truth)),
        components=len(sizes),
        largest_component=max(sizes),
        articulation_images=len(set(nx.articulation_points(graph))),
        bridges=sum(1 for _ in nx.bridges(graph)),
    )


def _some(images: Sequence[tuple[str, str]], what: str) -> list[str]:
    if not images:
        return []
    name, reason = images[0]
    return [f"{len(images)} image{'s' if len(images) > 1 else ''} {what} (first: {name}: {reason})"]


def _versions() -> dict[str, str]:
    return {
        "colmap-netvlad": VERSION,
        "pycolmap": pycolmap.__version__,
        "Processor": f"{platform.machine()}, {usable_processors()} cores",
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
