"""The table of retrieval methods: a function from a project to a ranking under each name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.flight import read_positions
from colmap_netvlad.photos.positions import Positions
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.gps import near_first
from colmap_netvlad.retrieval.methods import (
    Method,
    deep,
    find_method,
)
from colmap_netvlad.retrieval.methods.hybrid import fusion_depth
from colmap_netvlad.retrieval.options import GPS_MODES, RetrievalOptions, check_k
from colmap_netvlad.retrieval.rerank import rerank
from colmap_netvlad.runtime.errors import InputError


def rank(project: Project, name: str | Path, options: RetrievalOptions | None = None) -> Ranking:
    """Rank the images of a project by a method of the table, or by `options.model` if given.

    A `k` above the number of other images is lowered to it; the ranking's notes say so.

    Raises:
        InputError: no such method, `k` below 1, fewer than two images, or what the method needs
            is not there.
    """
    options = options or RetrievalOptions()
    if options.rerank < 0:
        raise InputError(f"`rerank` is {options.rerank}; it is a number of candidates, 0 for none.")
    # `hybrid` is told its deep model by --model; for the others a model is the method.
    method = find_method(name if str(name) == "hybrid" else options.model or name)
    count = len(image_names(project.database))
    k = check_k(options.k, count)
    compared = min(options.rerank, count - 1) if method.model else 0
    depth = max(k, compared)
    positions = _positions(project, method, options)
    if positions is None:
        ranking = method.rank(project, replace(options, k=depth))
    else:
        deeper = method.rank(project, replace(options, k=fusion_depth(depth)))
        ranking = near_first(deeper, positions, depth)
    if compared:
        model = deep.model_fingerprint(deep.checkpoint_file(options.model or method.model or ""))
        with Store(project.cache) as store:
            ranking = rerank(ranking, store, model, k, compared)
        note = f"{compared} candidates of each image compared place by place"
        ranking = replace(ranking, notes=(*ranking.notes, note))
    if k < options.k:
        note = f"k lowered from {options.k} to {k}: the project has {count} images"
        ranking = replace(ranking, notes=(*ranking.notes, note))
    return ranking


def _positions(project: Project, method: Method, options: RetrievalOptions) -> Positions | None:
    """Return the positions that are to re-weight a method's candidates, or None.

    Raises:
        InputError: no such mode, or positions are required and there are no useful ones.
    """
    mode = options.gps or ("auto" if method.gps else "off")
    if mode not in GPS_MODES:
        raise InputError(f"`gps` is {mode}; choose {', '.join(GPS_MODES)}.")
    if mode == "off" or "positions" in method.needs:
        return None
    positions = read_positions(project)
    if mode == "require" and not positions.useful:
        why = f" {positions.notes[-1]}" if positions.notes else ""
        raise InputError(
            f"Positions are required, but neither {project.database} nor the photos' EXIF have "
            f"any that tell photos apart.{why} Use `gps` auto or off."
        )
    return positions if positions.useful or positions.notes else None
