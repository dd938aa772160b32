"""What `colmap-netvlad pairs` does: rank, take the union of the top k, write the pairs list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.components import component_names, components
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.pairs.connect import apart_lines, connecting_budget, connecting_pairs
from colmap_netvlad.pairs.lists import (
    SUFFIXES,
    format_of,
    in_colmap_list,
    read_pairs,
    write_pairs,
)
from colmap_netvlad.pairs.rules import (
    PartnerRules,
    in_order,
    join_pairs,
    sequential_pairs,
    with_camera_quota,
    without_same_frame,
)
from colmap_netvlad.pairs.sessions import (
    DEPTH,
    across_pairs,
    find_sessions,
    joined,
    session_lines,
)
from colmap_netvlad.pairs.union import ImagePair, union_of_top
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.fusion import similarity_matrix
from colmap_netvlad.retrieval.methods import METHODS
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import check_exports, export_descriptors, rank
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import check_output
from colmap_netvlad.runtime.shell import command_line

NO_RULES = PartnerRules()


@dataclass(frozen=True)
class PairsReport:
    """The result of `make_pairs`.

    Attributes:
        ranking: what the pairs were taken from, k deep.
        pairs: the union of every image's own k partners.
        components: image names of each connected component of the pairs, largest first.
        connecting: pairs between components that were added because each image's own k partners
            do not connect all images.
        sessions: what was taken for a flight of its own, in words; empty where nobody asked.
        output: the pairs list that holds every pair.
        colmap_list: the list for COLMAP, where it cannot hold all pairs and so differs from
            `output`; else None.
        unwritable: image names that COLMAP's list cannot express.
    """

    ranking: Ranking
    pairs: list[ImagePair]
    components: list[list[str]]
    output: Path
    colmap_list: Path | None
    unwritable: list[str]
    connecting: int = 0
    sessions: list[str] = field(default_factory=list)


def make_pairs(
    project: Project,
    method: str = DEFAULT,
    options: RetrievalOptions | None = None,
    format: str | None = None,
    output: Path | None = None,
    rules: PartnerRules = NO_RULES,
    connect: bool = True,
    export: Path | None = None,
    *,
    k: int | None = None,
) -> PairsReport:
    """Retrieve each image's k nearest partners and write the union as a pairs list.

    Never writes to the user's database. Descriptors and what was compared are kept in the project's
    cache, where the photo folder is remembered as well.

    Args:
        project: database, photos, cache.
        method: a name in `methods.METHODS`, or a checkpoint file.
        options: k and what else a method takes.
        format: "colmap", "csv" or "json"; None: as the name of `output` ends, else "colmap".
        output: the pairs list; default `pairs.txt` (.csv, .json) beside the database. Names that
            COLMAP's list cannot express (spaces, a leading #) make a second, complete list:
            the same name ending in .csv.
        rules: cameras, sequences and pairs the user knows of; photos of one rig frame are never
            paired.
        export: also write the method's global descriptors there, in hloc's HDF5 layout.
        k: shorthand for `options.k`.
        connect: where the k nearest leave the images in several components, add the best pairs
            between these, at most `connecting_budget` of them.

    Raises:
        InputError: anything in the input a user can mend.
    """
    options = options or RetrievalOptions()
    if k is not None:
        options = replace(options, k=k)
    format = format or format_of(output or project.pairs)
    if format not in SUFFIXES:
        raise InputError(f"There is no format {format!r}; formats are {', '.join(SUFFIXES)}.")
    output = output or project.pairs.with_suffix(SUFFIXES[format])
    rules.check()
    if export is not None:
        check_exports(method, options)
    with open_flight(project) as flight:
        complete = _complete_list(output, format, flight.names)
        _check_files(
            [("output", output), ("output", complete), ("export", export)],
            [project.database, project.cache, *_files_read(method, options, rules)],
        )
        extra = _extra_pairs(flight.names, rules)
        sessions = find_sessions(flight.names, project.images) if rules.across else []
        ranking = rank(flight, method, options, DEPTH if rules.across else 0)
        if export is not None:
            export_descriptors(flight, method, options, export)
        frames = [flight.frames.get(image.image_id) for image in flight.images]
        cameras = [image.camera_id for image in flight.images]
        names = flight.names
    ranking = without_same_frame(ranking, frames)
    depth = min(options.k, len(names) - 1)
    chosen = with_camera_quota(ranking, cameras, depth, rules.other_cameras)
    own = union_of_top(chosen, depth)
    across = across_pairs(ranking, sessions, rules.across) if sessions else []
    pairs = join_pairs(joined(own, across), extra, names)
    links = _links(ranking, pairs) if connect else []
    pairs = in_order([*pairs, *links], names)
    unwritable = write_pairs(output, pairs, format)
    colmap_list = None
    if unwritable and complete is not None:
        colmap_list, output = output, complete
        write_pairs(output, pairs, "csv")
    return PairsReport(
        chosen,
        pairs,
        component_names(names, [(pair.name1, pair.name2) for pair in pairs]),
        output,
        colmap_list,
        unwritable,
        len(links),
        session_lines(sessions) if sessions else [],
    )


def _links(ranking: Ranking, pairs: Sequence[ImagePair]) -> list[ImagePair]:
    """Return the best pairs between the components that pairs leave apart, if there are several."""
    names = ranking.names
    index = {name: i for i, name in enumerate(names)}
    chosen = [(index[pair.name1], index[pair.name2]) for pair in pairs]
    component = components(len(names), chosen)
    if ranking.every_pair or not component.any():
        return []
    candidates = {(p.name1, p.name2): p for p in union_of_top(ranking, ranking.depth)}
    added = connecting_pairs(
        similarity_matrix(ranking), component, chosen, names, connecting_budget(len(pairs))
    )
    return [candidates[names[i], names[j]] for i, j in added]


def _extra_pairs(names: Sequence[str], rules: PartnerRules) -> list[tuple[str, str]]:
    extra = sequential_pairs(names, rules.sequential)
    if rules.own_pairs is not None:
        extra += read_pairs(rules.own_pairs, names)
    return extra


def as_json(report: PairsReport) -> dict[str, Any]:
    """Return what `colmap-netvlad pairs --json` prints."""
    ranking = report.ranking
    return {
        "images": len(ranking.names),
        "method": ranking.method,
        "k": ranking.depth,
        "pairs": len(report.pairs),
        "connecting": report.connecting,
        "components": report.components,
        "seconds_describe": ranking.seconds_describe,
        "seconds_search": ranking.seconds_search,
        "notes": ranking.notes,
        "left_out": [{"image": name, "reason": reason} for name, reason in ranking.left_out],
        "unseen": [{"image": name, "reason": reason} for name, reason in ranking.unseen],
        "output": report.output,
        "colmap_list": report.colmap_list,
    }


def summary(project: Project, report: PairsReport) -> list[str]:
    """Return the lines that `colmap-netvlad pairs` prints."""
    ranking = report.ranking
    lines = [
        f"Images       {len(ranking.names)}",
        f"Pairs        {len(report.pairs)}  ({ranking.method}, union of each image's "
        f"{ranking.depth} nearest)",
        f"Description  {ranking.seconds_describe:.1f} s",
        f"Search       {ranking.seconds_search:.1f} s",
        *(f"Note         {note}" for note in ranking.notes),
        *(f"Across       {line}" for line in report.sessions),
        *_component_lines(report),
        f"Written      {report.output}",
    ]
    if report.colmap_list is not None:
        lines.append(
            f"Warning      {report.colmap_list} lacks the pairs of {len(report.unwritable)} "
            f"images: COLMAP's list cannot hold names such as {report.unwritable[0]!r}; "
            f"{report.output.name} has all pairs, and the next command reads it."
        )
    return [*lines, f"Next         {_next_command(project, report)}"]


def _component_lines(report: PairsReport) -> list[str]:
    groups, lines = report.components, []
    if report.connecting:
        lines.append(
            f"Connecting   {report.connecting} pairs added between components that each image's "
            f"{report.ranking.depth} nearest leave apart (`connect`)"
        )
    if len(groups) == 1:
        return [*lines, "Components   1: the pairs connect all images"]
    return [
        *lines,
        f"Components   {len(groups)}: the pairs do not connect all images; a larger `k` may. "
        f"The largest has {len(groups[0])} images; apart from it are:",
        *(f"             {line}" for line in apart_lines(groups)),
    ]


def _next_command(project: Project, report: PairsReport) -> str:
    words = ["colmap-netvlad", "reconstruct", "--db", str(project.database)]
    if report.output != project.pairs:
        words += ["--pairs", str(report.output)]
    return command_line(words)


def _complete_list(output: Path, format: str, names: Sequence[str]) -> Path | None:
    """Return where a second list holds the names that COLMAP's cannot, or None."""
    all_fit = format != "colmap" or all(map(in_colmap_list, names))
    return None if all_fit else output.with_suffix(".csv")


def _files_read(
    method: str, options: RetrievalOptions, rules: PartnerRules
) -> list[str | Path | None]:
    by_path = None if str(method) in METHODS else method
    return [by_path, options.model, options.vocab_tree, rules.own_pairs]


def _check_files(
    written: Sequence[tuple[str, Path | None]], read: Sequence[str | Path | None]
) -> None:
    """Make sure, before the work, that files can be written, and over none that is read or written
    as well.

    Args:
        written: arguments and the files they name.
    """
    taken = {Path(file).resolve(): file for file in read if file is not None}
    for argument, file in written:
        if file is None:
            continue
        check_output(file, argument)
        if file.resolve() in taken:
            precious = taken[file.resolve()]
            raise InputError(f"`{argument}` would overwrite {precious}; name another file.")
        taken[file.resolve()] = file
