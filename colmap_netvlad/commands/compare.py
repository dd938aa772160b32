"""The same project under several methods: rankings -> pairs -> matches -> models -> report."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from colmap_netvlad import metrics
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.comparison import pool
from colmap_netvlad.comparison.evidence import Evidence
from colmap_netvlad.comparison.figures import (
    FULL_RANKING,
    Candidate,
    compute_figures,
    gather_evidence,
)
from colmap_netvlad.comparison.models import kept_figures, reconstruct_once
from colmap_netvlad.comparison.result import EXHAUSTIVE, Comparison, ModelFigures, write_json
from colmap_netvlad.comparison.workspace import Workspace, check_comparable, open_workspace
from colmap_netvlad.flight import Flight, open_flight
from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.matching.matchers import usable_matcher
from colmap_netvlad.matching.options import MATCHER_DEFAULT, MatchOptions
from colmap_netvlad.pairs.union import union_of_top
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods import Method, deep, find_method
from colmap_netvlad.retrieval.options import RetrievalOptions, check_k
from colmap_netvlad.retrieval.rank import rank
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically

logger = logging.getLogger(__name__)

ASK_ABOVE = 600.0
"""Exhaustive matching that is estimated to take longer than this, s, is asked about first."""

STOLEN_TIME = 1.2
"""A method that reports more than this share of the time it was seen to take reused results."""

Confirm = Callable[[str], bool]


@dataclass(frozen=True)
class CompareOptions:
    """What a user chooses about a comparison.

    Attributes:
        k: numbers of partners to compare; clamped to the number of other images.
        output: the comparison's folder; None: `<database>-compare` beside the database.
        reconstruct: whether each method's model is made; one made earlier is shown in any case.
        reconstruct_k: the number of partners the models are made from, one of `k`; None: the
            largest.
        retrieval: how to rank, as far as it concerns each method; its k and seed are set from
            here. `model` is for methods that take one (hybrid, files of descriptors).
        seed: of every method, of verification and of mapping.
        matching: who matches all pairs; where no matcher is named the folder's, COLMAP's with the
            method exhaustive, else the default.
        mapping: its other options.
    """

    k: tuple[int, ...] = (30,)
    output: Path | None = None
    reconstruct: bool = True
    reconstruct_k: int | None = None
    retrieval: RetrievalOptions = field(default_factory=RetrievalOptions)
    seed: int = 0
    matching: MatchOptions = field(default_factory=MatchOptions)
    mapping: MappingOptions = field(default_factory=MappingOptions)


@dataclass(frozen=True)
class CompareReport:
    """The result of `compare`.

    Attributes:
        comparison: all figures.
        page, json, csv: where they stand: the report page, and the figures as tables.
    """

    comparison: Comparison
    page: Path
    json: Path
    csv: Path


def compare(
    project: Project,
    methods: Sequence[str],
    options: CompareOptions = CompareOptions(),
    confirm: Confirm = lambda question: False,
    *,
    k: Sequence[int] = (),
) -> CompareReport:
    """Compare retrieval methods on one project, and write the report.

    The user's database is read only. Everything is kept in the comparison's folder: a killed run
    goes on where it stopped, and methods asked for in a later run are added to the earlier ones.

    Args:
        methods: names of the table of methods, or checkpoints by path.
        confirm: asked with one question before an exhaustive matching that takes long.

        k: shorthand for `options.k`.

    Returns:
        The figures, and where the page and the tables are. A method that fails is in
        `Comparison.incomplete`; the others are complete.

    Raises:
        InputError: no method, an unknown one, a model that none of them takes, no features, k out
            of range, a folder that is not this project's comparison, or exhaustive matching that
            was not confirmed.
    """
    if k:
        options = replace(options, k=tuple(k))
    if not methods:
        raise InputError("No method to compare; name some in `methods`, bow and vlad for example.")
    model = options.retrieval.model
    if model is not None and not any(find_method(text).takes_model for text in methods):
        raise InputError(
            f"`model` {model} would be ignored: none of {', '.join(methods)} takes one; a "
            "checkpoint is a method of its own, by its path in `methods`."
        )
    texts = [_stable_text(text) for text in methods]
    with open_flight(project) as flight:
        return _compare(flight, texts, options, confirm)


def _compare(
    flight: Flight, texts: Sequence[str], options: CompareOptions, confirm: Confirm
) -> CompareReport:
    check_comparable(flight)
    project = flight.project
    ks = _checked_ks(options, len(flight.names))
    folder = options.output or project.folder / f"{project.database.stem}-compare"
    workspace = open_workspace(folder, flight)
    matching = _matching(flight, workspace, texts, options)
    candidates = _candidates(workspace.add_methods(texts))
    if any(not candidate.ranks for candidate in candidates):
        _check_cost(workspace, flight, matching, confirm)
    for candidate in candidates:
        _rank(candidate, flight, workspace, ks, options)
    pairs = {k: {c.name: _pairs(c, k) for c in candidates if c.ranking} for k in ks}
    matched_now = pool.match_once(workspace, pairs[ks[-1]], matching)
    _say_matched(pairs[ks[-1]], matched_now)
    k = check_k(options.reconstruct_k or ks[-1], len(flight.names))
    for candidate in candidates:
        if candidate.ranking:
            _map(candidate, workspace, project.images, pairs[k][candidate.name], k, options)
    evidence = gather_evidence(flight, workspace, candidates, pairs[ks[-1]])
    comparison = compute_figures(flight, workspace, candidates, pairs, evidence, options.seed)
    write_report(workspace, comparison, evidence)
    return CompareReport(comparison, workspace.html, workspace.json, workspace.csv)


def write_report(workspace: Workspace, comparison: Comparison, evidence: Evidence) -> None:
    """Write `compare.json`, `compare.csv` and `compare.html`."""
    from colmap_netvlad.report.comparison import write_csv
    from colmap_netvlad.report.page import render_page

    write_json(workspace.json, comparison)
    write_csv(workspace.csv, comparison)
    write_atomically(workspace.html, render_page(comparison, evidence))


def _checked_ks(options: CompareOptions, images: int) -> tuple[int, ...]:
    if not options.k:
        raise InputError("`k` names no number of partners; give one or several.")
    ks = tuple(sorted({check_k(k, images) for k in options.k}))
    wanted = options.reconstruct_k
    if wanted is not None and check_k(wanted, images) not in ks:
        raise InputError(
            f"`reconstruct_k` is {wanted}, which is not one of `k`: {', '.join(map(str, ks))}."
        )
    return ks


def _matching(
    flight: Flight, workspace: Workspace, texts: Sequence[str], options: CompareOptions
) -> MatchOptions:
    """Return how all pairs of this comparison are matched: by one matcher, the truth by COLMAP's.

    Raises:
        InputError: another matcher than the folder's, or than COLMAP's with all pairs.
    """
    exhaustive = EXHAUSTIVE in (*workspace.methods(), *texts)
    kept = workspace.matcher()
    matching = replace(options.matching, seed=options.seed)
    if matching.matcher is None and not matching.thorough:
        matching = matching.labelled(kept or ("colmap" if exhaustive else MATCHER_DEFAULT))
    with open_database(flight.project.database) as opened:
        matcher, note = usable_matcher(matching, opened.has_sift())
    if note:
        logger.warning(note)
        matching = replace(matching, matcher=matcher.name, thorough=False)
    if kept is not None and matching.label != kept:
        raise InputError(
            f"The pairs in {workspace.folder} were matched by {kept}, not by {matching.label}, and "
            "one comparison has one matcher; name another folder with `output`."
        )
    if exhaustive and matching.label != "colmap":
        raise InputError(
            f"The method {EXHAUSTIVE} is the truth, which COLMAP's own matcher tells; compare it "
            f"with `matcher` colmap, or leave it out in another folder (`output`)."
        )
    workspace.keep_matcher(matching.label)
    return matching


def _stable_text(text: str) -> str:
    """Check a method's name, and make the path of a checkpoint absolute, so that it is found
    again from another folder."""
    find_method(text)
    return str(Path(text).resolve()) if Path(text).is_file() else text


def _candidates(texts: Sequence[str]) -> list[Candidate]:
    """Find all methods, also of earlier runs: one that has gone since is a failed one."""
    candidates: list[Candidate] = []
    for text in texts:
        try:
            method = find_method(text)
            candidate = Candidate(text, method.name, method.summary)
        except InputError as fault:
            candidate = Candidate(text, Path(text).stem, "", failed=fault.message)
        if candidate.name in {other.name for other in candidates}:
            candidate.name = text
        candidates.append(candidate)
    return candidates


def _check_cost(
    workspace: Workspace, flight: Flight, options: MatchOptions, confirm: Confirm
) -> None:
    """Say what exhaustive matching will cost, and ask where that is long."""
    possible = len(flight.names) * (len(flight.names) - 1) // 2
    left = possible - len(pool.matched(workspace))
    if not left:
        return
    each = pool.measure_cost(workspace, flight.names, options)
    minutes = each * left / 60
    cost = (
        f"Exhaustive matching: {left:,} pairs, about {minutes:.1f} min "
        f"({each:.3f} s a pair, measured on {min(pool.SAMPLE, possible)})."
    )
    logger.info(cost)
    if minutes * 60 > ASK_ABOVE and not confirm(f"{cost} Go on?"):
        raise InputError(f"{cost} Say so with `confirm`, or leave the method exhaustive out.")


def _rank(
    candidate: Candidate,
    flight: Flight,
    workspace: Workspace,
    ks: tuple[int, ...],
    options: CompareOptions,
) -> None:
    if candidate.failed:
        return
    count = len(flight.names)
    depth = count - 1 if count <= FULL_RANKING else ks[-1]
    try:
        method = find_method(candidate.text)
        retrieval = _concerning(method, options, depth)
        column, folder = f"{candidate.text}-k{depth}", flight.project.images
        at_hand = method.model is None or (folder is not None and folder.is_dir())
        key = None if at_hand else workspace.latest_key(column)
        key = key or _ranking_key(candidate.text, flight, retrieval)
        kept = workspace.load_ranking(key)
        if kept is None:
            logger.info("Ranking by %s", candidate.name)
            start = time.perf_counter()
            ranking = rank(flight, candidate.text, retrieval).top(depth)
            seen = time.perf_counter() - start
            kept = ranking, metrics.efficiency(ranking) > STOLEN_TIME * seen
            workspace.save_ranking(key, *kept)
        workspace.keep_latest_key(column, key)
        candidate.ranking, candidate.timed_earlier = kept
        if not at_hand:
            notes = (*candidate.ranking.notes, "the photos are not at hand: as ranked before")
            candidate.ranking = replace(candidate.ranking, notes=notes)
    except Exception as fault:  # whatever stops one method leaves the others
        candidate.failed = _reason(fault)


def _concerning(method: Method, options: CompareOptions, depth: int) -> RetrievalOptions:
    """Return what concerns a method, so that its column is the method it names, and is not made
    again for what it ignores."""
    told = replace(options.retrieval, k=depth, seed=options.seed)
    if not method.takes_model:
        told = replace(told, model=None)
    return told if method.model else replace(told, masks=None, rerank=0)


def _ranking_key(text: str, flight: Flight, options: RetrievalOptions) -> str:
    """Return a key of everything a ranking of the same features depends on."""
    method = find_method(text)
    # The device and how many photos at once change a time at most.
    parts = [repr(replace(options, device=None, batch_size=None))]
    parts.append(hashlib.sha256(flight.positions.metres.tobytes()).hexdigest())
    files = [Path(text), options.vocab_tree]
    if method.model is not None:
        files.append(deep.checkpoint_file(options.model or method.model))
        folder = flight.project.images
        if folder is not None:
            photos = deep.photo_contents(flight.store, folder, flight.names, options.masks)
            parts.append(repr(photos))
    parts += [deep.model_fingerprint(file) for file in files if file and file.is_file()]
    return f"{text}-k{options.k}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:16]}"


def _pairs(candidate: Candidate, k: int) -> set[Pair]:
    assert candidate.ranking is not None
    depth = k if candidate.ranks else candidate.ranking.depth
    return {as_pair(p.name1, p.name2) for p in union_of_top(candidate.ranking, depth)}


def _say_matched(pairs: Mapping[str, set[Pair]], now: int) -> None:
    distinct = len(set().union(*pairs.values()))
    asked = sum(map(len, pairs.values()))
    logger.info(
        f"Matched each distinct pair once: {distinct:,} pairs for {asked:,} asked by "
        f"{len(pairs)} methods, {now:,} of them now."
    )


def _map(
    candidate: Candidate,
    workspace: Workspace,
    images: Path | None,
    pairs: set[Pair],
    k: int,
    options: CompareOptions,
) -> None:
    mapping = replace(options.mapping, seed=options.seed)
    folder = workspace.model_folder(candidate.name)
    candidate.model = kept_figures(folder, pairs, k, mapping)
    if candidate.model or not options.reconstruct:
        return
    logger.info("Mapping %s", candidate.name)
    try:
        candidate.model = reconstruct_once(workspace.union, images, folder, pairs, k, mapping)
    except Exception as fault:  # whatever stops one method leaves the others
        candidate.model = ModelFigures(k, failed=_reason(fault))


def _reason(fault: Exception) -> str:
    if isinstance(fault, InputError):
        return fault.message
    lines = str(fault).strip().splitlines()
    return f"{type(fault).__name__}: {lines[0] if lines else 'no message'}"
