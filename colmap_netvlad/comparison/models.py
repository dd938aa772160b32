"""One method's pairs -> a database of its own -> its model, its figures, its plan."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path

import numpy as np

from colmap_netvlad.colmap.copies import copy_with_pairs
from colmap_netvlad.comparison.evidence import Plan
from colmap_netvlad.comparison.result import ModelFigures
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.summary import registered_names, summarize
from colmap_netvlad.runtime.files import atomic_path, write_atomically

FIGURES = "figures.json"
"""Written last: a folder that has it is complete."""

PLAN_POINTS = 20_000
"""Points of a model kept for its plan: more cannot be told apart in a figure of a page."""


def reconstruct_once(
    union: Path,
    images: Path | None,
    folder: Path,
    pairs: Collection[Pair],
    k: int,
    options: MappingOptions,
) -> ModelFigures:
    """Map from the method's own pairs alone, or return the figures of an earlier, equal run.

    Args:
        union: the database in which all methods' pairs are matched.
        images: the photos, for the colours of points; None leaves them black.
        folder: gets `sparse/0`, ..., `figures.json` and `plan.npz`.
        pairs: the method's pairs.
        k: partners an image they come from, for the figures.
    """
    kept = kept_figures(folder, pairs, k, options)
    if kept is not None:
        return kept
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    database = folder / "database.db"
    copy_with_pairs(union, database, pairs)
    start = time.perf_counter()
    models = map_incremental(database, images, folder / "sparse", options)
    seconds = time.perf_counter() - start
    database.unlink()
    figures = ModelFigures(k, seconds=seconds)
    if models:
        largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
        summary = summarize(largest)
        figures = ModelFigures(
            k,
            models=len(models),
            registered=summary.registered,
            points=summary.points,
            observations=summary.observations,
            mean_reprojection_error=summary.mean_reprojection_error if summary.points else None,
            mean_track_length=summary.mean_track_length if summary.points else None,
            in_any_model=len(registered_names(models)),
            seconds=seconds,
        )
        _save_plan(folder / "plan.npz", largest)
    content = {**asdict(figures), "digest": _digest(pairs, k, options)}
    write_atomically(folder / FIGURES, json.dumps(content, indent=1))
    return figures


def kept_figures(
    folder: Path, pairs: Collection[Pair], k: int, options: MappingOptions
) -> ModelFigures | None:
    """Return the figures of an earlier run with the same pairs and options, or None."""
    if not (folder / FIGURES).is_file():
        return None
    kept = json.loads((folder / FIGURES).read_text(encoding="utf-8"))
    same = kept.pop("digest", None) == _digest(pairs, k, options)
    return ModelFigures(**kept) if same else None


def read_plan(folder: Path) -> Plan | None:
    """Return the plan of the model in a method's folder, or None where there is none."""
    path = folder / "plan.npz"
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as kept:
        names = tuple(kept["names"].tolist())
        return Plan(names, kept["centres"], kept["points"], kept["colours"])


def _save_plan(path: Path, model: object) -> None:
    registered = [image for image in model.images.values() if image.has_pose]  # type: ignore[attr-defined]
    registered.sort(key=lambda image: image.name)
    points = [point for _, point in sorted(model.points3D.items())]  # type: ignore[attr-defined]
    points = points[:: max(1, -(-len(points) // PLAN_POINTS))]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            names=np.array([image.name for image in registered], dtype=np.str_),
            centres=np.array([image.projection_center() for image in registered]).reshape(-1, 3),
            points=np.array([point.xyz for point in points]).reshape(-1, 3),
            colours=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        )


def _digest(pairs: Collection[Pair], k: int, options: MappingOptions) -> str:
    text = "\n".join([f"{k} {options!r}", *(f"{a}\t{b}" for a, b in sorted(pairs))])
    return hashlib.sha256(text.encode("utf-8")).hexdigest()
