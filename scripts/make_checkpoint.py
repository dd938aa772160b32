#!/usr/bin/env python3
"""Make an untrained NetVLAD checkpoint: an ImageNet trunk and k-means centres over photos.

It is what training starts from, and what runs until a trained model is there:

    python scripts/make_checkpoint.py --name netvlad-lite-imagenet \
        --backbone efficientnet-lite0-stage5 --weights efficientnet-lite0-imagenet.safetensors \
        --long-side 384 --rotations 4 \
        --output netvlad-lite-imagenet.safetensors flights/scene1 flights/scene2

Every FOLDER is searched for photos, itself and below.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import click
import numpy as np
import torch
from torch.nn import functional

from colmap_netvlad.models.aggregation import NetVLAD
from colmap_netvlad.models.backbones import BACKBONES, load_trunk
from colmap_netvlad.models.checkpoint import save_checkpoint
from colmap_netvlad.models.describe import choose_device, choose_precision, prepare_trunk
from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.models.trunk import Trunk
from colmap_netvlad.photos.decode import decode_photo
from colmap_netvlad.photos.files import BadPhoto, find_photos
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.terminal import Command


@click.command(cls=Command, help=__doc__)
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option("--name", required=True, help="What the checkpoint calls itself.")
@click.option("--backbone", default="vgg16", type=click.Choice(list(BACKBONES)))
@click.option("--weights", type=click.Path(path_type=Path), help="Trunk; default: download.")
@click.option("--clusters", default=64, show_default=True)
@click.option("--long-side", default=320, show_default=True, help="Photos are reduced to this.")
@click.option("--rotations", default=4, show_default=True, type=click.Choice([1, 4]))
@click.option("--photos-per-folder", default=20, show_default=True, help="Spread evenly.")
@click.option("--per-photo", default=60, show_default=True, help="Local features drawn a photo.")
@click.option("--licence", default="", help="Origin and licence of the trunk's weights.")
@click.option("--seed", default=0, show_default=True)
@click.option("--output", required=True, type=click.Path(path_type=Path))
def make_checkpoint(
    folders: tuple[Path, ...],
    name: str,
    backbone: str,
    weights: Path | None,
    clusters: int,
    long_side: int,
    rotations: int,
    photos_per_folder: int,
    per_photo: int,
    licence: str,
    seed: int,
    output: Path,
) -> None:
    trunk = load_trunk(backbone, weights)
    photos = [path for folder in folders for path in photos_below(folder, photos_per_folder)]
    features = sample_features(trunk, photos, long_side, per_photo, seed)
    aggregation = NetVLAD(trunk.channels, clusters)
    alpha = aggregation.initialise(features, seed)
    metadata = {
        "name": name,
        "long_side": long_side,
        "rotations": rotations,
        "summary": f"{backbone} with ImageNet weights, k-means centres; not trained for flights.",
        "recipe": {
            "centres": "k-means over local features, paper eq. 16",
            "alpha": round(alpha, 3),
            "features": len(features),
            "seed": seed,
        },
        "data": {"scenes": [folder.name for folder in folders], "photos": len(photos)},
        "licence": licence or BACKBONES[backbone].published.licence,
        "command": command_line(),
    }
    save_checkpoint(output, GlobalDescriptor(trunk, aggregation), metadata)
    click.echo(
        f"{output}: {backbone}, {clusters} centres from {len(features)} local features of "
        f"{len(photos)} photos, alpha {alpha:.1f}, {output.stat().st_size / 1e6:.1f} MB"
    )


def photos_below(folder: Path, most: int) -> list[Path]:
    """At most so many photos of a folder and its subfolders, evenly spread over their names."""
    names = find_photos(folder)
    if not names:
        raise InputError(f"{folder} holds no photos.")
    chosen = np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int)
    return [folder / names[i] for i in chosen]


@torch.inference_mode()
def sample_features(
    trunk: Trunk, photos: list[Path], long_side: int, per_photo: int, seed: int
) -> np.ndarray:
    """L2-normalised local features, float32 (M, channels), drawn at random from each photo."""
    generator = torch.Generator().manual_seed(seed)
    device = choose_device()
    precision = choose_precision(device)
    fast = prepare_trunk(trunk, device, precision)
    drawn = []
    with progress.step("Local features", len(photos)) as bar:
        for path in photos:
            try:
                photo = torch.from_numpy(decode_photo(path, long_side))
            except BadPhoto as fault:
                raise InputError(f"{path}: {fault}") from fault
            pixels = photo.permute(2, 0, 1)[None].float().to(device)
            local = fast(trunk.normalisation(pixels).to(precision))[0].float().flatten(1).cpu()
            local = functional.normalize(local, dim=0)
            chosen = torch.randperm(local.shape[1], generator=generator)[:per_photo]
            drawn.append(local[:, chosen].T)
            bar.advance()
    return torch.cat(drawn).numpy()


def command_line() -> str:
    """This run, with names of files instead of paths of this machine."""
    words = [Path(word).name if "/" in word else word for word in sys.argv]
    return shlex.join(["python", f"scripts/{words[0]}", *words[1:]])


if __name__ == "__main__":
    make_checkpoint()
