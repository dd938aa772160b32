"""Made-up comparisons of any size, for tests of the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_netvlad.comparison.evidence import Evidence, Plan
from colmap_netvlad.comparison.figures import retrieval_figures
from colmap_netvlad.comparison.finds import single_finds
from colmap_netvlad.comparison.result import Comparison, MethodResult, ModelFigures
from colmap_netvlad.graph.pair import as_pair
from colmap_netvlad.graph.verified import correct_pairs

NOISE = {"netvlad-o": 6.0, "bow": 14.0, "vlad": 25.0}
"""How far a method's idea of a photo's place is off, m; lines are 20 m apart."""


def made_up(
    images: int = 60,
    ks: tuple[int, ...] = (5, 10),
    photos: Path | None = None,
    names: tuple[str, ...] | None = None,
) -> tuple[Comparison, Evidence]:
    """Return a comparison of three methods on a flight over a square, and what is behind it.

    A photo's true partners are within 60 m; each method knows the places with its own noise.
    """
    generator = np.random.default_rng(0)
    names = names or tuple(f"DJI_{i:04d}.JPG" for i in range(images))
    side = int(np.ceil(np.sqrt(images)))
    place = 20.0 * np.array([(i % side, i // side, 4.0) for i in range(images)])
    partners, pairs_at = {}, {}
    for method, noise in NOISE.items():
        seen = place[:, :2] + generator.normal(0, noise, (images, 2))
        partners[method] = _nearest(seen, ks[-1])
        pairs_at[method] = {
            k: {
                as_pair(names[i], names[j])
                for i, row in enumerate(partners[method][:, :k].tolist())
                for j in row
            }
            for k in ks
        }
    index = {name: i for i, name in enumerate(names)}
    verified = {}
    for pair in sorted(set().union(*(at[ks[-1]] for at in pairs_at.values()))):
        apart = float(np.linalg.norm(place[index[pair[0]]] - place[index[pair[1]]]))
        verified[pair] = int(2000 * np.exp(-apart / 18)) if apart < 60 else 0
    truth = correct_pairs(verified)
    points = np.column_stack(
        [generator.uniform(-30, 20 * side + 30, (4000, 2)), generator.normal(0, 3, 4000)]
    )
    colours = generator.integers(40, 220, (4000, 3)).astype(np.uint8)
    plans = {
        method: Plan(names[: images - lost], place[: images - lost], points, colours)
        for lost, method in enumerate(NOISE)
    }
    evidence = Evidence(
        names, photos, partners, {m: at[ks[-1]] for m, at in pairs_at.items()}, verified, truth,
        place + generator.normal(0, 1, place.shape), plans,
    )  # fmt: skip
    found = single_finds(evidence)
    methods = tuple(
        MethodResult(
            method,
            f"{method}, made up.",
            seconds_describe=3.0 * (lost + 1),
            seconds_search=0.2 * (lost + 1),
            seconds_match=0.05 * len(pairs_at[method][ks[-1]]),
            mean_average_precision=0.9 - 0.1 * lost,
            only_here=len(found[method]),
            at_k=tuple(retrieval_figures(pairs_at[method][k], k, evidence) for k in ks),
            model=ModelFigures(
                ks[-1],
                1,
                images - lost,
                4000,
                12000,
                0.7,
                3.0,
                40.0,
                seconds_match=0.05 * len(pairs_at[method][ks[-1]]),
            ),
        )
        for lost, method in enumerate(NOISE)
    )
    comparison = Comparison(
        "project.db", images, 0, images * 5000, ks, 0, "union", len(truth), ks[-1],
        len(verified), sum(len(at[ks[-1]]) for at in pairs_at.values()), 0.05 * len(verified),
        {"pycolmap": "4.2.1"}, methods,
    )  # fmt: skip
    return comparison, evidence


def with_method(comparison: Comparison, method: MethodResult) -> Comparison:
    """Return the comparison with one method more."""
    return replace(comparison, methods=(*comparison.methods, method))


def _nearest(seen: np.ndarray, k: int) -> np.ndarray:
    from scipy.spatial import cKDTree

    found = cKDTree(seen).query(seen, k=k + 1)[1]
    return np.array([[j for j in row if j != i][:k] for i, row in enumerate(found)], np.int32)
