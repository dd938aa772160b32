"""Global descriptors of others, computed elsewhere (MegaLoc, SALAD, DINOv2), in hloc's files.

hloc's layout: a group for each image, named as the image ("folder/photo.jpg" is nested), with a
dataset `global_descriptor` of (D,) values (Sarlin et al., From coarse to fine: robust hierarchical
localization at large scale, CVPR 2019; `hloc.extract_features`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.flight import Flight
from colmap_netvlad.models.catalogue import DEFAULT
from colmap_netvlad.retrieval.described import rank_vectors
from colmap_netvlad.retrieval.methods import deep
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path

DATASET = "global_descriptor"

WRITE_ROWS = 256
"""Descriptors read from the store at a time while they are exported."""


def candidates(flight: Flight, options: RetrievalOptions, depth: int, file: Path) -> Ranking:
    """Rank by the descriptors in a file; photos are described in cells to be compared.

    Images that the file lacks have no candidates and are listed, and so are photos that cannot be
    used, which are ranked by the file alone.

    Args:
        options: `model` names another deep model whose cells are compared than the default.

    Raises:
        InputError: the file is not HDF5 in hloc's layout, or of none of the images.
    """
    with _opened(file) as content:
        left_out = {}
        for name in flight.names:
            reason = _fault(content, name)
            if reason:
                left_out[name] = f"{reason} in {file.name}"
        described = [name for name in flight.names if name not in left_out]
        if not described:
            raise InputError(
                f"{file} has a {DATASET} of none of the {len(flight.names)} images (first: "
                f"{flight.names[0]}); image names are relative to the photo folder."
            )
        vectors = _Rows(content, described, file)
        bad: dict[str, str] = {}
        if options.rerank:
            _, bad, _ = deep.describe_photos(flight, options, options.model or DEFAULT)
        ranking = rank_vectors(vectors, flight.names, left_out, options, depth, file.stem)
        return ranking.with_unseen(bad)


def export(flight: Flight, options: RetrievalOptions, model: str | Path, file: Path) -> None:
    """Write a model's descriptors of all images that have one, float16, in hloc's layout.

    Raises:
        InputError: no image has one, or the file cannot be written.
    """
    import h5py

    store = flight.store
    key = deep.cells_key(model, options)
    known = store.described(key)
    names = [name for name in flight.names if name in known]
    if not names:
        raise InputError(
            f"There is nothing to `export`: {model} has described no photo; it does where `rerank` "
            "is above 0."
        )
    with atomic_path(file) as temporary, h5py.File(temporary, "w") as content:
        for first in range(0, len(names), WRITE_ROWS):
            block = names[first : first + WRITE_ROWS]
            for name, vector in zip(block, store.read_vectors(key, block), strict=True):
                content.create_group(name).create_dataset(DATASET, data=np.float16(vector))


class _Rows:
    """(N, D) descriptors of a file, L2-normalised, read as they are sliced."""

    def __init__(self, content: Any, names: Sequence[str], file: Path) -> None:
        self._content, self._names = content, names
        lengths = {content[name][DATASET].shape[0]: name for name in reversed(names)}
        if len(lengths) > 1:
            (one, a), (other, b) = list(lengths.items())[:2]
            raise InputError(
                f"{file} has descriptors of {one} values ({a}) and of {other} ({b}); one file "
                "holds one model's."
            )
        self.shape = (len(names), next(iter(lengths)))

    def __getitem__(self, rows: slice) -> NDArray[np.float32]:
        found = [self._content[name][DATASET][()] for name in self._names[rows]]
        vectors = np.array(found, np.float32).reshape(-1, self.shape[1])
        return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _opened(file: Path) -> Any:
    import h5py

    if not file.is_file():
        raise InputError(f"The file of descriptors {file} does not exist.")
    try:
        return h5py.File(file, "r")
    except OSError as fault:
        raise InputError(f"{file} is not an HDF5 file of descriptors, or it is damaged.") from fault


def _fault(content: Any, name: str) -> str:
    """Return what is wrong with an image's descriptor, or nothing."""
    import h5py

    dataset = content.get(f"{name}/{DATASET}")
    if not isinstance(dataset, h5py.Dataset):
        return "has no descriptor"
    if dataset.ndim != 1 or dataset.dtype.kind != "f":
        return "has a descriptor that is no vector of floats"
    if not np.isfinite(dataset[()]).all():
        return "has a descriptor that is not finite"
    return ""
