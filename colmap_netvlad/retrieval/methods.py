"""The table of retrieval methods: a function from a project to a ranking under each name."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_netvlad.database import image_names
from colmap_netvlad.errors import InputError
from colmap_netvlad.models.catalogue import CATALOGUE, DEFAULT
from colmap_netvlad.pairs import check_k
from colmap_netvlad.positions import Positions, read_positions
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval import baselines, bow, deep, hybrid, spatial, vlad
from colmap_netvlad.retrieval.gps import near_first
from colmap_netvlad.retrieval.hybrid import fusion_depth
from colmap_netvlad.retrieval.ranking import Ranking
from colmap_netvlad.retrieval.rerank import DEPTH, rerank
from colmap_netvlad.retrieval.store import Store

CHECKPOINT_SUFFIXES = (".safetensors", ".mat")


@dataclass(frozen=True)
class RetrievalOptions:
    """What a user chooses about retrieval; a method uses what concerns it.

    Attributes:
        k: partners of each image, at least 1; some methods rank deeper.
        model: a checkpoint to use instead of the named method.
        device: where networks run; None takes the fastest there is.
        seed: of every random choice.
        batch_size: photos described at once; None: the method's own.
        vocab_tree: the vocabulary tree of `bow`; None: see `bow.find_tree`.
        exact: True or False forces exact search or HNSW; None: see `search.EXACT_UP_TO`.
        masks: folder of masks in COLMAP's way: masked areas are neutral to deep descriptors.
        gps: whether positions re-weight the candidates, one of `GPS_MODES`; None: "auto" for
            methods that are not from the literature, else "off".
        rerank: candidates of each image that deep methods compare place by place
            (`retrieval.rerank`); 0: none, the global descriptors alone.
    """

    k: int = 30
    model: Path | str | None = None
    device: str | None = None
    seed: int = 0
    batch_size: int | None = None
    vocab_tree: Path | None = None
    exact: bool | None = None
    masks: Path | None = None
    gps: str | None = None
    rerank: int = DEPTH


GPS_MODES = ("auto", "off", "require")
"""Use positions where there are useful ones, never, or fail where there are none."""


@dataclass(frozen=True)
class Method:
    """A retrieval method.

    Attributes:
        name: what users call it.
        summary: one line with its source.
        needs: of "photos", "features", "positions".
        rank: ranks the images of a project by appearance (or, for `spatial`, by position). Where
            there is a `model` these are candidates, which are compared place by place then.
        gps: whether positions join in by themselves.
        model: the deep model it runs: a name of the catalogue or a checkpoint file.
    """

    name: str
    summary: str
    needs: frozenset[str]
    rank: Callable[[Project, RetrievalOptions], Ranking]
    gps: bool = False
    model: str | Path | None = None


def _deep_method(name: str, summary: str, checkpoint: str | Path) -> Method:
    def rank_deep(project: Project, options: RetrievalOptions) -> Ranking:
        return deep.rank(project, checkpoint, options)

    return Method(name, summary, frozenset({"photos"}), rank_deep, model=checkpoint)


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        *(_deep_method(entry.name, entry.summary, entry.name) for entry in CATALOGUE.values()),
        Method(
            "bow",
            "COLMAP's vocabulary tree (Schoenberger et al., ACCV 2016).",
            frozenset({"features"}),
            bow.rank,
        ),
        Method(
            "vlad",
            "VLAD on SIFT, 256 words (Jegou et al., CVPR 2010): the paper's baseline.",
            frozenset({"features"}),
            vlad.rank,
        ),
        Method(
            "hybrid",
            "Candidates of the default deep model, VLAD and, where there is any, GPS, compared"
            " place by place: ours.",
            frozenset({"photos", "features"}),
            hybrid.rank,
            gps=True,
            model=DEFAULT,
        ),
        Method(
            "spatial",
            "Nearest on the ground by position priors or GPS, as COLMAP's spatial matcher.",
            frozenset({"positions"}),
            spatial.rank,
        ),
        Method(
            "exhaustive",
            "All pairs; --k is ignored. The reference for sets where it can be afforded.",
            frozenset(),
            baselines.exhaustive,
        ),
        Method("random", "Partners by chance: the floor.", frozenset(), baselines.chance),
    )
}


def find_method(name: str | Path) -> Method:
    """Return a method by name, or one that runs a checkpoint by path.

    Raises:
        InputError: there is none of that name (suggests the nearest), or no such file.
    """
    text = str(name)
    if text in METHODS:
        return METHODS[text]
    path = Path(text)
    if path.is_file() or path.suffix in CHECKPOINT_SUFFIXES:
        file = deep.checkpoint_file(path)
        return _deep_method(file.stem, f"The checkpoint {file}.", file)
    near = difflib.get_close_matches(text.lower(), METHODS, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}?" if near else f"methods are {', '.join(METHODS)}."
    raise InputError(f"There is no retrieval method {text!r}: {hint}")


def rank(project: Project, name: str | Path, options: RetrievalOptions | None = None) -> Ranking:
    """Rank the images of a project by a method of the table, or by `options.model` if given.

    A `k` above the number of other images is lowered to it; the ranking's notes say so.

    Raises:
        InputError: no such method, `k` below 1, fewer than two images, or what the method needs
            is not there.
    """
    options = options or RetrievalOptions()
    if options.rerank < 0:
        raise InputError(f"--rerank is {options.rerank}; it is a number of candidates, 0 for none.")
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
        note = f"{compared} candidates of each image compared place by place (--rerank)"
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
        raise InputError(f"There is no --gps {mode}; choose {', '.join(GPS_MODES)}.")
    if mode == "off" or "positions" in method.needs:
        return None
    positions = read_positions(project)
    if mode == "require" and not positions.useful:
        why = f" {positions.notes[-1]}" if positions.notes else ""
        raise InputError(
            f"Positions are required, but neither {project.database} nor the photos' EXIF have "
            f"any that tell photos apart.{why} Use --gps auto or off."
        )
    return positions if positions.useful or positions.notes else None
