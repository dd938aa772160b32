"""Project -> ranking: a method's candidates, re-weighted by positions, compared place by place."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.flight import Flight, open_flight
from colmap_netvlad.photos.masks import check_masks
from colmap_netvlad.photos.positions import Positions
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.bands import for_bands, multispectral_shots, of_shots
from colmap_netvlad.retrieval.confirm import largest_features
from colmap_netvlad.retrieval.gps import near_first
from colmap_netvlad.retrieval.methods import Method, deep, find_method, hdf5
from colmap_netvlad.retrieval.options import (
    GPS_MODES,
    HIGHEST_SEED,
    SEARCH_DEPTH,
    RetrievalOptions,
    check_k,
    ranking_depth,
)
from colmap_netvlad.retrieval.rerank import rerank
from colmap_netvlad.runtime.errors import InputError

logger = logging.getLogger(__name__)

DEFAULT_OPTIONS = RetrievalOptions()


def rank(
    flight: Flight,
    name: str | Path,
    options: RetrievalOptions = DEFAULT_OPTIONS,
    least_depth: int = 0,
) -> Ranking:
    """Rank the images of a flight by a method of the table, or by `options.model` if given.

    A multispectral flight is ranked by one band of each shot (`retrieval.bands`).

    It is done once and deep enough for all that follows: the ranking lists `ranking_depth(k)`
    partners of each image (or all others); who wants k of them cuts it (`Ranking.top`). A `k`
    above the number of other images is lowered to it; the ranking's notes say so.

    Args:
        least_depth: partners to list at least.

    Raises:
        InputError: no such method, an option out of its range, fewer than two images, or what the
            method needs is not there.
    """
    if options.rerank < 0:
        raise InputError(f"`rerank` is {options.rerank}; it is a number of candidates, 0 for none.")
    if not 0 <= options.seed <= HIGHEST_SEED:
        raise InputError(f"`seed` is {options.seed}; it is a number from 0 to {HIGHEST_SEED}.")
    check_masks(options.masks)
    method = _method(name, options)
    # The baselines are of images: all pairs, and pairs by chance.
    shots = multispectral_shots(flight) if method.needs else None
    if shots is None:
        return _rank(flight, method, options, least_depth)
    if len(shots.representatives) < 2:
        raise InputError(
            f"All {len(flight.images)} images of the database are bands of one multispectral shot; "
            "a pair needs two. Import more photos with `colmap-netvlad features`."
        )
    ranking = _rank(of_shots(flight, shots), method, options, least_depth)
    return for_bands(ranking, shots, flight.names)


def _rank(flight: Flight, method: Method, options: RetrievalOptions, least_depth: int) -> Ranking:
    others = len(flight.images) - 1
    k = check_k(options.k, len(flight.images))
    depth = min(max(ranking_depth(k), least_depth), others)
    positions = _positions(flight, method, options)
    ranking = method.candidates(flight, options, min(max(SEARCH_DEPTH, depth), others))
    if positions is not None:
        ranking = near_first(ranking, positions)
    if method.model and options.rerank:
        model = deep.cells_key(options.model or method.model, options)
        compared = min(options.rerank, others)
        ranking = rerank(ranking, flight.store, model, k, compared, largest_features(flight))
        note = f"up to {compared} candidates of each image compared place by place"
        ranking = replace(ranking, notes=(*ranking.notes, note))
    if method.takes_model and options.model is not None:
        ranking = replace(ranking, notes=(*ranking.notes, f"its deep model is {options.model}"))
    if k < options.k:
        note = f"k lowered from {options.k} to {k}: the project has {others + 1} images"
        ranking = replace(ranking, notes=(*ranking.notes, note))
    return ranking.top(depth)


def rank_project(
    project: Project,
    name: str | Path,
    options: RetrievalOptions = DEFAULT_OPTIONS,
    least_depth: int = 0,
) -> Ranking:
    """Open a project and `rank` its images; photos that cannot be used are logged."""
    with open_flight(project) as flight:
        ranking = rank(flight, name, options, least_depth)
    for line in ranking.left_out_lines():
        logger.warning(line)
    return ranking


def check_exports(name: str | Path, options: RetrievalOptions) -> str | Path:
    """Return the model whose descriptors `export_descriptors` writes.

    Raises:
        InputError: the method has no descriptors of its own.
    """
    method = _method(name, options)
    if method.model is None:
        raise InputError(
            f"{method.name} has no deep descriptors to export; choose a method that has a model."
        )
    return options.model or method.model


def export_descriptors(
    flight: Flight, name: str | Path, options: RetrievalOptions, file: Path
) -> None:
    """Write the global descriptors of a ranked flight in hloc's HDF5 layout.

    Raises:
        InputError: as `check_exports`, there are none, or the file cannot be written.
    """
    hdf5.export(flight, options, check_exports(name, options), file)


def _method(name: str | Path, options: RetrievalOptions) -> Method:
    """Return the method: a model that is given is one, unless the named method takes a model."""
    if options.model is None:
        return find_method(name)
    named = find_method(name)
    return named if named.takes_model else find_method(options.model)


def _positions(flight: Flight, method: Method, options: RetrievalOptions) -> Positions | None:
    """Return the positions that are to re-weight a method's candidates, or None.

    Raises:
        InputError: no such mode, or positions are required and there are no useful ones.
    """
    compared = method.model is not None and options.rerank > 0
    mode = options.gps or ("auto" if compared else "off")
    if mode not in GPS_MODES:
        raise InputError(f"`gps` is {mode}; choose {', '.join(GPS_MODES)}.")
    if mode == "off" or "positions" in method.needs:
        return None
    positions = flight.positions
    if mode == "require" and not positions.useful:
        why = f" {positions.notes[-1]}" if positions.notes else ""
        raise InputError(
            f"Positions are required, but neither {flight.project.database} nor the photos' EXIF "
            f"have any that tell photos apart.{why} Use `gps` auto or off."
        )
    return positions if positions.useful or positions.notes else None
