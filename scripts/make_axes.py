#!/usr/bin/env python3
"""Give a model the principal axes of its local features: shorter cells, compared quicker.

    python scripts/make_axes.py netvlad-o-lite.safetensors --axes 64 \
        --output netvlad-o-lite.safetensors flights/scene1 flights/scene2

The axes are those of the features at all places of the photos, each FOLDER with the same weight;
their mean is not taken off, since cosines are to be kept. Every FOLDER is searched for photos,
itself and below. A model that has axes gets new ones. Descriptors stay as they are.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import numpy as np
import torch
from make_checkpoint import command_line, photos_below
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from colmap_netvlad.models.checkpoint import METADATA_KEY, load_model
from colmap_netvlad.models.describe import DescriptorModel
from colmap_netvlad.photos.decode import decode_photo
from colmap_netvlad.photos.files import BadPhoto
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically
from colmap_netvlad.terminal import Command


@click.command(cls=Command, help=__doc__)
@click.argument("checkpoint", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option("--axes", "count", default=64, show_default=True, help="Values a cell keeps.")
@click.option("--photos-per-folder", default=20, show_default=True, help="Spread evenly.")
@click.option("--output", required=True, type=click.Path(path_type=Path))
def make_axes(
    checkpoint: Path, folders: tuple[Path, ...], count: int, photos_per_folder: int, output: Path
) -> None:
    # The file as it is, without its axes: matrices in half precision are not rounded twice.
    tensors = load_file(checkpoint)
    tensors.pop("axes", None)
    with safe_open(checkpoint, "pt") as file:
        card = json.loads(file.metadata()[METADATA_KEY])
    with TemporaryDirectory() as folder:
        bare = Path(folder) / checkpoint.name
        write(bare, tensors, card | {"axes": None})
        model = load_model(bare)
    photos = {folder: photos_below(folder, photos_per_folder) for folder in folders}
    with progress.step("Local features", sum(map(len, photos.values()))) as bar:
        shares = [products(model, chosen, bar) for chosen in photos.values()]
    values, vectors = np.linalg.eigh(np.mean(shares, axis=0))
    if not 0 < count <= len(values):
        raise InputError(f"`axes` is {count}; the model's features have {len(values)} values.")
    axes = vectors[:, ::-1][:, :count].T
    tensors["axes"] = torch.from_numpy(np.ascontiguousarray(axes, np.float16))
    card |= {
        "axes": count,
        "axes_command": command_line(),
        "axes_data": {
            "scenes": [f.name for f in folders],
            "photos": sum(map(len, photos.values())),
        },
    }
    write(output, tensors, card)
    kept = values[::-1][:count].sum() / values.sum()
    click.echo(f"{output}: {count} of {len(values)} axes, {kept:.1%} of the features' squares")


def write(path: Path, tensors: dict[str, Tensor], card: dict[str, Any]) -> None:
    write_atomically(path, save(tensors, {METADATA_KEY: json.dumps(card, sort_keys=True)}))


def products(model: DescriptorModel, photos: list[Path], bar: progress.Step) -> NDArray[np.float64]:
    """Return (C, C) the mean of f f^T over the features f at all places of some photos."""
    total: NDArray[np.float64] = np.zeros(())
    places = 0
    for path in photos:
        try:
            pixels = decode_photo(path, model.long_side).transpose(2, 0, 1)[None]
        except BadPhoto as fault:
            raise InputError(f"{path}: {fault}") from fault
        local = model.describe_with_cells(pixels)[1][0]
        features = local.reshape(len(local), -1).astype(np.float64)
        total = total + features @ features.T
        places += int(features.any(axis=0).sum())
        bar.advance()
    return total / max(places, 1)


if __name__ == "__main__":
    make_axes()
