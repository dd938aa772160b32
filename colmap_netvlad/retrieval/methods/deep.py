"""Deep global descriptors: photo -> network -> descriptor in the cache -> nearest neighbours."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.photos import contents
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.flight import Flight
from colmap_netvlad.models.catalogue import CATALOGUE
from colmap_netvlad.photos.decode import load_batches
from colmap_netvlad.photos.folders import photo_folders
from colmap_netvlad.photos.masks import find_mask, without_mask
from colmap_netvlad.retrieval.described import cache_note, missing, rank_described
from colmap_netvlad.retrieval.fusion import combine
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.words import rank_in_words, serves
from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.jobs import Enclosed, Load
from colmap_netvlad.runtime.machine import usable_processors
from colmap_netvlad.runtime.progress import step

if TYPE_CHECKING:
    from colmap_netvlad.models.describe import DescriptorModel

BATCH_SIZE = 8


def candidates(
    flight: Flight,
    options: RetrievalOptions,
    depth: int,
    name_or_path: str | Path,
    beside: Sequence[tuple[Ranking, float]] = (),
) -> Ranking:
    """Rank by a model's descriptors; see `describe_photos`.

    A flight is described in words of its own (`retrieval.words`) unless exact or approximate
    search by the model's descriptors is asked for. Photos that cannot be used are listed with a
    reason; they have no partners but those that a ranking beside gives them.

    Args:
        flight: its photo folder must be known.
        name_or_path: a model of the catalogue, or a checkpoint file.
        beside: other rankings and their shares (`fusion.combine`).

    Raises:
        InputError: no photo folder, no weights, not a checkpoint, or no photo that can be used.
    """
    key, left_out, note = describe_photos(flight, options, name_or_path)
    method = Path(name_or_path).stem if Path(name_or_path).suffix else str(name_or_path)
    notes = [note, *_mask_notes(options.masks, flight.names)]
    known = flight.store, key, flight.names, left_out, options, depth, method, notes
    if serves(options, len(flight.names) - len(left_out)):
        ranking = combine([*rank_in_words(*known), *beside], method, depth)
    elif beside:
        ranking = combine([(rank_described(*known), 1.0), *beside], method, depth)
    else:
        ranking = rank_described(*known)
    return ranking.with_unseen(left_out)


def describe_photos(
    flight: Flight, options: RetrievalOptions, name_or_path: str | Path
) -> tuple[str, dict[str, str], str]:
    """Describe the photos that the store does not have yet, as they are on disk now.

    Cells for `retrieval.words` and `retrieval.rerank` are kept with the descriptors where either
    will ask for them.

    Returns:
        What the store keeps them under; name -> reason of the photos that cannot be used; a
        sentence on what was computed.

    Raises:
        InputError: as `candidates`.
    """
    folder, names = flight.project.need_images(), flight.names
    photos, left_out = photo_contents(flight.store, folder, names, options.masks)
    key = cells_key(name_or_path, options)
    to_do = missing(flight.store, key, photos, cells=_needs_cells(options))
    bad = _describe(
        flight.store, key, checkpoint_file(name_or_path), folder, to_do, photos, options
    )
    left_out |= bad
    if len(left_out) == len(names):
        raise InputError(
            f"None of the {len(names)} photos in {folder} can be used (first: {names[0]} "
            f"{left_out[names[0]]}); mend `images`."
        )
    return key, left_out, cache_note(len(to_do) - len(bad), len(names) - len(left_out))


def _mask_notes(masks: Path | None, names: Sequence[str]) -> list[str]:
    if masks is None:
        return []
    bare = without_mask(masks, names)
    if len(bare) == len(names):
        raise InputError(f"None of the {len(names)} photos has a mask in {masks}; mend `masks`.")
    return [f"{len(bare)} of {len(names)} photos have no mask: described whole"] if bare else []


def _needs_cells(options: RetrievalOptions) -> bool:
    return options.rerank > 0 or options.exact is None


def cells_key(name_or_path: str | Path, options: RetrievalOptions) -> str:
    """Return what the store keeps a model's descriptors and cells under.

    Photos seen through masks are kept beside the whole ones.
    """
    model = model_fingerprint(checkpoint_file(name_or_path))
    return model if options.masks is None else f"{model}-masked"


def checkpoint_file(name_or_path: str | Path) -> Path:
    """Return the file of a catalogue model or a checkpoint by path, without loading PyTorch.

    Raises:
        InputError: it is not there.
    """
    entry = CATALOGUE.get(str(name_or_path))
    if entry is not None:
        return entry.file()
    path = Path(name_or_path)
    if not path.is_file():
        raise InputError(f"The checkpoint {path} does not exist.")
    return path


def model_fingerprint(checkpoint: Path) -> str:
    """Return the sha256 of a checkpoint file: `DescriptorModel.fingerprint`."""
    with checkpoint.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def photo_contents(
    store: Store, folder: Path, names: Sequence[str], masks: Path | None
) -> tuple[dict[str, str], dict[str, str]]:
    """Return (name -> content fingerprint) and (name -> reason) of photos that have none.

    A photo seen through another mask is another content.
    """
    photos, bad = contents(store, {name: folder / name for name in names})
    if masks is not None:
        found = {name: find_mask(masks, name) for name in photos}
        files = {f"mask of {name}": mask for name, mask in found.items() if mask is not None}
        seen, unreadable = contents(store, files)
        for name in list(photos):
            key = f"mask of {name}"
            if key in unreadable:
                del photos[name]
                bad[name] = f"has a mask that {unreadable[key]}"
            elif key in seen:
                photos[name] += f"-{seen[key]}"
    return photos, bad


def _describe(
    store: Store,
    key: str,
    checkpoint: Path,
    folder: Path,
    names: Sequence[str],
    photos: dict[str, str],
    options: RetrievalOptions,
) -> dict[str, str]:
    """Describe photos into the store, a transaction a batch; return (name -> reason) of the bad."""
    if not names:
        return {}
    described = workers.stream(
        partial(_describe_share, Enclosed(checkpoint), options),
        names,
        load=Load(gpu=(options.device or "cuda").startswith("cuda")),
        folders=photo_folders(folder, options.masks),
        first=_batch_size(options),
    )
    bad: dict[str, str] = {}
    start = time.perf_counter()
    try:
        with step("Describing photos", len(names)) as bar, closing(described) as batches:
            for batch in batches:
                bad |= dict(batch.bad)
                if batch.names:
                    done, fingerprints = time.perf_counter(), [photos[n] for n in batch.names]
                    store.add_descriptors(
                        key, batch.names, fingerprints, batch.vectors, done - start, batch.cells
                    )
                    # Waiting for the decoders belongs to the next batch's time.
                    start = done
                bar.advance(len(batch.names) + len(batch.bad))
    finally:
        _network.cache_clear()
    return {name: bad[name] for name in names if name in bad}


@dataclass(frozen=True, eq=False)
class _Described:
    """Some photos: their descriptors, their cells where asked for; (name, reason) of the bad."""

    names: tuple[str, ...]
    vectors: NDArray[np.float32]
    cells: list[Cells]
    bad: list[tuple[str, str]]


def _describe_share(
    checkpoint: Enclosed,
    options: RetrievalOptions,
    folder: Path,
    masks: Path | None,
    names: Sequence[str],
) -> Iterator[_Described]:
    """Describe photos batch by batch."""
    network = _network(checkpoint, options.device)
    size = _batch_size(options)
    for batch in load_batches(folder, names, network.long_side, size, masks=masks):
        vectors, maps = network.describe_with_cells(batch.pixels)
        cells = [Cells.of(features) for features in maps] if _needs_cells(options) else []
        yield _Described(batch.names, vectors, cells, batch.bad)


def _batch_size(options: RetrievalOptions) -> int:
    """Return how many photos are described at once: one for each processor at least."""
    return options.batch_size or max(BATCH_SIZE, usable_processors())


@lru_cache(maxsize=1)
def _network(checkpoint: Enclosed, device: str | None) -> DescriptorModel:
    """Load a model once a process."""
    from colmap_netvlad.models.checkpoint import load_model

    with checkpoint.opened() as path:
        return load_model(path, device)
