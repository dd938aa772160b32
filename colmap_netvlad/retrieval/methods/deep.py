"""Deep global descriptors: photo -> network -> descriptor in the cache -> nearest neighbours."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_netvlad.cache.cells import LocalFeatures
from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.models.catalogue import CATALOGUE
from colmap_netvlad.photos.decode import load_batches
from colmap_netvlad.photos.files import BadPhoto, photo_fingerprint
from colmap_netvlad.photos.masks import find_mask
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.described import cache_note, missing, rank_described
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.progress import step

if TYPE_CHECKING:
    from colmap_netvlad.retrieval.options import RetrievalOptions

BATCH_SIZE = 8


def rank(project: Project, name_or_path: str | Path, options: RetrievalOptions) -> Ranking:
    """Rank by a model's descriptors; photos already described are not described again.

    Local features for `retrieval.rerank` are kept with them where `options.rerank` is not 0.
    Photos that cannot be used are left out: they have no partners and are listed with a reason.

    Args:
        project: its photo folder must be known.
        name_or_path: a model of the catalogue, or a checkpoint file.
        options: k, rerank, device, batch size, exact, seed.

    Raises:
        InputError: no photo folder, no weights, not a checkpoint, or no photo that can be used.
    """
    folder = project.need_images()
    checkpoint = checkpoint_file(name_or_path)
    names = image_names(project.database)
    with Store(project.cache) as store:
        photos, left_out = fingerprints(folder, names, options.masks)
        model = model_fingerprint(checkpoint)
        to_do = missing(store, model, photos, local=options.rerank > 0)
        bad = _describe(store, model, checkpoint, folder, to_do, photos, options)
        left_out |= bad
        if len(left_out) == len(names):
            raise InputError(
                f"None of the {len(names)} photos in {folder} can be used (first: {names[0]} "
                f"{left_out[names[0]]}); mend `images`."
            )
        note = cache_note(len(to_do) - len(bad), len(names) - len(left_out))
        method = str(name_or_path) if str(name_or_path) in CATALOGUE else checkpoint.stem
        return rank_described(store, model, names, left_out, options, method, [note])


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


def fingerprints(
    folder: Path, names: Sequence[str], masks: Path | None = None
) -> tuple[dict[str, str], dict[str, str]]:
    """Return (name -> content fingerprint) and (name -> reason) of photos that have none.

    A photo seen through a mask is another content.
    """

    def one(name: str) -> tuple[str, str]:
        try:
            photo = photo_fingerprint(folder / name)
            mask = find_mask(masks, name) if masks is not None else None
            return photo if mask is None else f"{photo}-{photo_fingerprint(mask)}", ""
        except BadPhoto as fault:
            return "", str(fault)

    photos, bad = {}, {}
    with ThreadPoolExecutor() as pool:
        for name, (fingerprint, reason) in zip(names, pool.map(one, names), strict=True):
            if reason:
                bad[name] = reason
            else:
                photos[name] = fingerprint
    return photos, bad


def _describe(
    store: Store,
    model: str,
    checkpoint: Path,
    folder: Path,
    names: Sequence[str],
    photos: dict[str, str],
    options: RetrievalOptions,
) -> dict[str, str]:
    """Describe photos into the store, a transaction a batch; return (name -> reason) of the bad."""
    if not names:
        return {}
    from colmap_netvlad.models.checkpoint import load_model

    network = load_model(checkpoint, options.device)
    bad: dict[str, str] = {}
    batches = load_batches(
        folder,
        names,
        network.long_side,
        options.batch_size or BATCH_SIZE,
        masks=options.masks,
    )
    start = time.perf_counter()
    with step("Describing photos", len(names)) as bar:
        for batch in batches:
            bad |= dict(batch.bad)
            if batch.names:
                vectors, maps = network.describe_with_local(batch.pixels)
                local = [LocalFeatures.of(features) for features in maps] if options.rerank else []
                done = time.perf_counter()
                contents = [photos[name] for name in batch.names]
                store.add_descriptors(model, batch.names, contents, vectors, done - start, local)
                # Waiting for the decoders belongs to the next batch's time.
                start = done
            bar.advance(len(batch.names) + len(batch.bad))
    return bad
