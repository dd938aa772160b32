"""Folders of photos and masks, for work that may go to machines which do not see them."""

from __future__ import annotations

from pathlib import Path

from colmap_netvlad.photos.files import leaves_folder
from colmap_netvlad.photos.masks import find_mask
from colmap_netvlad.runtime.jobs import Folder


def photo_folders(images: Path, masks: Path | None) -> tuple[Folder[str], Folder[str] | None]:
    """Return both as `runtime.workers` takes them; the items of the work are image names."""
    return Folder(images, _photo), None if masks is None else Folder(masks, _mask)


def _photo(folder: Path, name: str) -> list[str]:
    return [] if leaves_folder(name) else [name]


def _mask(folder: Path, name: str) -> list[str]:
    mask = None if leaves_folder(name) else find_mask(folder, name)
    return [] if mask is None else [mask.relative_to(folder).as_posix()]
