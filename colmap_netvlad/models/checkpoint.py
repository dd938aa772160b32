"""One file per model: weights and everything needed to run them (safetensors with metadata)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from colmap_netvlad.models.aggregation import AGGREGATIONS, build_aggregation
from colmap_netvlad.models.backbones import build_trunk
from colmap_netvlad.models.catalogue import CATALOGUE
from colmap_netvlad.models.describe import DescriptorModel
from colmap_netvlad.models.network import GlobalDescriptor
from colmap_netvlad.models.trunk import Normalisation
from colmap_netvlad.models.whitening import Whitening
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically
from colmap_netvlad.runtime.version import VERSION

METADATA_KEY = "colmap-netvlad"
FORMAT_VERSION = 1

REQUIRED = (
    "format_version",
    "name",
    "backbone",
    "normalisation",
    "aggregation",
    "dim",
    "long_side",
    "rotations",
)
"""Metadata a model cannot run without; `save_checkpoint` fills in what the network knows."""


def save_checkpoint(
    path: Path, model: GlobalDescriptor, metadata: dict[str, Any], *, half: bool = True
) -> None:
    """Write a network and its card, whole or not at all.

    Args:
        path: ends in .safetensors.
        model: the network, on any device.
        metadata: `name`, `long_side` and `rotations` are needed; `summary`, `recipe`, `data`,
            `scores`, `licence`, `command` and whatever else is worth keeping come along. Plain
            JSON data.
        half: keep matrices in float16, which halves the file; statistics of batch norms stay
            float32.

    Raises:
        InputError: the file cannot be written.
    """
    card = {
        "format_version": FORMAT_VERSION,
        "created_by": f"colmap-netvlad {VERSION}",
        "backbone": model.trunk.name,
        "normalisation": model.trunk.normalisation.as_dict(),
        "aggregation": model.aggregation.options(),
        "whitening": None if model.whitening is None else model.whitening.dim,
        "axes": None if model.axes is None else len(model.axes),
        "dim": model.dim,
        **metadata,
    }
    missing = [key for key in REQUIRED if key not in card]
    if missing:
        raise ValueError(f"metadata lacks {', '.join(missing)}")

    def stored(tensor: Tensor) -> Tensor:
        tensor = tensor.detach().cpu().contiguous()
        return tensor.half() if half and tensor.dim() > 1 else tensor

    state = {
        key: stored(value)
        for key, value in model.state_dict().items()
        if not key.endswith("num_batches_tracked")
    }
    # One metadata entry: with several their order, and so the file's hash, would be a matter of
    # chance.
    write_atomically(path, save(state, {METADATA_KEY: json.dumps(card, sort_keys=True)}))


def read_metadata(path: Path) -> dict[str, Any]:
    """A checkpoint's card, without its weights.

    Raises:
        InputError: not a checkpoint of ours, truncated, or of another format version.
    """
    return _read(path, weights=False)[0]


def load_network(name_or_path: str | Path) -> GlobalDescriptor:
    """The bare network of a checkpoint, float32 on the processor, to train further.

    Raises:
        InputError: as `load_model`.
    """
    return _load(find_checkpoint(name_or_path))[0]


def load_model(name_or_path: str | Path, device: str | None = None) -> DescriptorModel:
    """A model of the catalogue, or a checkpoint by path, ready to describe photos.

    Args:
        name_or_path: a name in `CATALOGUE`, a .safetensors checkpoint, or the published
            Pitts30K_struct.mat (see `netvlad_matlab`).
        device: cpu, cuda, cuda:1, mps; None: cuda where there is one, else cpu.

    Raises:
        InputError: no such model or file, not a checkpoint, truncated, of another version,
            weights missing, or the device is absent.
    """
    path = find_checkpoint(name_or_path)
    network, card = _load(path)
    return DescriptorModel(
        network,
        name=card["name"],
        fingerprint=hashlib.sha256(path.read_bytes()).hexdigest(),
        long_side=card["long_side"],
        rotations=card["rotations"],
        device=device,
        metadata=card,
    )


def find_checkpoint(name_or_path: str | Path) -> Path:
    """The file of a named model, or the path itself.

    Raises:
        InputError: neither a name nor a file.
    """
    entry = CATALOGUE.get(str(name_or_path))
    if entry is not None:
        return entry.file()
    path = Path(name_or_path)
    if not path.is_file():
        raise InputError(
            f"{name_or_path} is neither a model nor a checkpoint file: models are "
            f"{', '.join(CATALOGUE)}."
        )
    return path


def _load(path: Path) -> tuple[GlobalDescriptor, dict[str, Any]]:
    if path.suffix == ".mat":
        from colmap_netvlad.models import netvlad_matlab

        return netvlad_matlab.load(path), netvlad_matlab.CARD
    card, state = _read(path, weights=True)
    # Shapes first, without memory: a damaged card may ask for any size.
    with torch.device("meta"):
        _check_shapes(_built(path, card), state, path)
    network = _built(path, card)
    network.load_state_dict({key: value.float() for key, value in state.items()}, strict=False)
    return network, card


def _built(path: Path, card: dict[str, Any]) -> GlobalDescriptor:
    """Make the network that a card describes."""
    try:
        trunk = build_trunk(card["backbone"], Normalisation.from_dict(card["normalisation"]))
        aggregation = build_aggregation(trunk.channels, card["aggregation"])
        whitening = Whitening(aggregation.dim, card["whitening"]) if card.get("whitening") else None
        axes = torch.zeros(card["axes"], trunk.channels) if card.get("axes") else None
        return GlobalDescriptor(trunk, aggregation, whitening, axes)
    except (KeyError, TypeError, ValueError, RuntimeError) as fault:
        raise InputError(
            f"{path} is a checkpoint with a network this version does not know "
            f"({fault}; aggregations are {', '.join(AGGREGATIONS)}): update colmap-netvlad."
        ) from fault


def _check_shapes(network: GlobalDescriptor, state: dict[str, Tensor], path: Path) -> None:
    for key, value in network.state_dict().items():
        if key.endswith("num_batches_tracked"):
            continue
        if key not in state:
            raise InputError(f"{path} is incomplete: {key} is missing; make or fetch it again.")
        if state[key].shape != value.shape:
            raise InputError(
                f"{path} contradicts itself: {key} is {tuple(state[key].shape)}, its metadata "
                f"asks for {tuple(value.shape)}."
            )


def _read(path: Path, *, weights: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with safe_open(path, "pt") as file:
            card = _card(path, (file.metadata() or {}).get(METADATA_KEY))
            # safe_open is no dictionary
            keys = file.keys() if weights else []
            return card, {key: file.get_tensor(key) for key in keys}
    except OSError as fault:
        raise InputError(f"Cannot read {path}: {fault.strerror or fault}.") from fault
    except SafetensorError as fault:
        if "IncompleteBuffer" in str(fault) or "incomplete" in str(fault):
            raise InputError(f"{path} is truncated: fetch or copy it again.") from fault
        raise InputError(f"{path} is not a colmap-netvlad checkpoint ({fault}).") from fault


def _card(path: Path, text: str | None) -> dict[str, Any]:
    if text is None:
        raise InputError(
            f"{path} is not a colmap-netvlad checkpoint: a safetensors file without its metadata."
        )
    try:
        card = json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise InputError(
            f"{path} is a damaged checkpoint: its card is no JSON ({fault})."
        ) from fault
    if not isinstance(card, dict):
        raise InputError(f"{path} is a damaged checkpoint: its card is no JSON object.")
    version = card.get("format_version")
    if version != FORMAT_VERSION:
        raise InputError(
            f"{path} is a checkpoint of format version {version}, this is colmap-netvlad "
            f"{VERSION}, which reads version {FORMAT_VERSION}: use the colmap-netvlad it was "
            f"made with ({card.get('created_by', 'unknown')}), or make it again."
        )
    missing = [key for key in REQUIRED if key not in card]
    if missing:
        raise InputError(f"{path} is a damaged checkpoint: it lacks {', '.join(missing)}.")
    wrong = [key for key, right in _RIGHT.items() if not right(card.get(key))]
    if wrong:
        raise InputError(
            f"{path} is a damaged checkpoint: its {wrong[0]} cannot be {card.get(wrong[0])!r}."
        )
    return card


def _is_number(value: object, least: int, most: int) -> bool:
    return type(value) is int and least <= value <= most


_RIGHT: dict[str, Callable[[Any], bool]] = {
    "name": lambda value: isinstance(value, str),
    "backbone": lambda value: isinstance(value, str),
    "normalisation": lambda value: isinstance(value, dict),
    "aggregation": lambda value: isinstance(value, dict) and isinstance(value.get("kind"), str),
    "dim": lambda value: _is_number(value, 1, 2**24),
    "long_side": lambda value: _is_number(value, 16, 2**14),
    "rotations": lambda value: _is_number(value, 1, 4),
    "whitening": lambda value: value is None or _is_number(value, 1, 2**24),
    "axes": lambda value: value is None or _is_number(value, 1, 2**14),
}
"""What the values of a card can be."""


__all__ = [
    "find_checkpoint",
    "load_model",
    "load_network",
    "read_metadata",
    "save_checkpoint",
]
