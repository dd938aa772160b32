"""The table of retrieval methods, one file a method."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.flight import Flight
from colmap_netvlad.models.catalogue import CATALOGUE, DEFAULT
from colmap_netvlad.retrieval.methods import baselines, bow, deep, hdf5, hybrid, spatial, vlad
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError

DESCRIPTOR_SUFFIXES = (".h5", ".hdf5")
HDF5_START = b"\x89HDF\r\n\x1a\n"
CHECKPOINT_SUFFIXES = (".safetensors", ".mat")


@dataclass(frozen=True)
class Method:
    """A retrieval method.

    Attributes:
        name: what users call it.
        summary: one line with its source.
        needs: of "photos", "features", "positions".
        candidates: ranks a flight's images by appearance (or, for `spatial`, by position), as many
            partners of each as it is told. Where there is a `model` these are compared place by
            place then.
        model: the deep model it runs: a name of the catalogue or a checkpoint file.
        takes_model: whether `RetrievalOptions.model` replaces its model; for the others a model
            given there is a method of its own.
    """

    name: str
    summary: str
    needs: frozenset[str]
    candidates: Callable[[Flight, RetrievalOptions, int], Ranking]
    model: str | Path | None = None
    takes_model: bool = False


def _deep_method(name: str, summary: str, checkpoint: str | Path) -> Method:
    def candidates(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
        return deep.candidates(flight, options, depth, checkpoint)

    return Method(name, summary, frozenset({"photos"}), candidates, model=checkpoint)


def _file_method(file: Path) -> Method:
    def candidates(flight: Flight, options: RetrievalOptions, depth: int) -> Ranking:
        return hdf5.candidates(flight, options, depth, file)

    summary = f"The global descriptors in {file}, compared place by place by {DEFAULT}."
    needs = frozenset({"photos"})
    return Method(file.stem, summary, needs, candidates, model=DEFAULT, takes_model=True)


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        *(_deep_method(entry.name, entry.summary, entry.name) for entry in CATALOGUE.values()),
        Method(
            "bow",
            "COLMAP's vocabulary tree (Schoenberger et al., ACCV 2016).",
            frozenset({"features"}),
            bow.candidates,
        ),
        Method(
            "vlad",
            "VLAD on SIFT, 256 words (Jegou et al., CVPR 2010): the paper's baseline.",
            frozenset({"features"}),
            vlad.candidates,
        ),
        Method(
            "hybrid",
            "Candidates of the default deep model, VLAD and, where there is any, GPS, compared"
            " place by place: ours.",
            frozenset({"photos", "features"}),
            hybrid.candidates,
            model=DEFAULT,
            takes_model=True,
        ),
        Method(
            "spatial",
            "Nearest on the ground by position priors or GPS, as COLMAP's spatial matcher.",
            frozenset({"positions"}),
            spatial.candidates,
        ),
        Method(
            "exhaustive",
            "All pairs; k is ignored. The reference for sets where it can be afforded.",
            frozenset(),
            baselines.exhaustive,
        ),
        Method("random", "Partners by chance: the floor.", frozenset(), baselines.chance),
    )
}


def find_method(name: str | Path) -> Method:
    """Return a method by name, or one that runs a checkpoint or a file of descriptors by path.

    Raises:
        InputError: there is none of that name (suggests the nearest), or no such file.
    """
    text = str(name)
    if text in METHODS:
        return METHODS[text]
    path = Path(text)
    if path.suffix in DESCRIPTOR_SUFFIXES or _is_hdf5(path):
        if not path.is_file():
            raise InputError(f"The file of descriptors {path} does not exist.")
        return _file_method(path)
    if path.is_file() or path.suffix in CHECKPOINT_SUFFIXES:
        file = deep.checkpoint_file(path)
        return _deep_method(file.stem, f"The checkpoint {file}.", file)
    near = difflib.get_close_matches(text.lower(), METHODS, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}?" if near else f"methods are {', '.join(METHODS)}."
    raise InputError(f"There is no retrieval method {text!r}: {hint}")


def _is_hdf5(path: Path) -> bool:
    # MATLAB's own HDF5 files, which hold networks, begin otherwise.
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(HDF5_START)) == HDF5_START
