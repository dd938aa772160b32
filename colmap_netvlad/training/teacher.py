"""A teacher: a finished model whose similarities between photos a network is to keep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from colmap_netvlad.models.describe import DescriptorModel
from colmap_netvlad.runtime.files import atomic_path
from colmap_netvlad.runtime.progress import step
from colmap_netvlad.training.inputs import Photos, fingerprint_of_photos


class Teacher:
    """A model's descriptors of all training photos, upright and whole, kept on disk.

    A network that is shown turned and cut views of the same photos learns to agree with what the
    teacher says of the whole ones.
    """

    def __init__(self, model: DescriptorModel, photos: Photos, folder: Path) -> None:
        """Describe all photos, or read the descriptors of an earlier run.

        Raises:
            InputError: a photo cannot be read, or the disk is full.
        """
        sizes = [len(scene) for scene in photos.scenes]
        self._first = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        key = f"{model.fingerprint[:16]}-{fingerprint_of_photos(photos.scenes)}"
        path = folder / f"teacher-{key}.npy"
        if not path.is_file():
            described = _describe(model, photos)
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                np.save(file, described)
        self._descriptors = np.load(path)

    def similarities(self, samples: Sequence[tuple[int, int]]) -> Tensor:
        """Return (N, N) cosine similarities of photos given as (scene, image)."""
        rows = [self._first[scene] + image for scene, image in samples]
        descriptors = torch.from_numpy(self._descriptors[rows]).float()
        return descriptors @ descriptors.T


def _describe(model: DescriptorModel, photos: Photos) -> NDArray[np.float16]:
    described = []
    with step("Teacher's descriptors", sum(len(scene) for scene in photos.scenes)) as bar:
        for number, scene in enumerate(photos.scenes):
            for image in range(len(scene)):
                pixels = photos.whole(number, image, model.long_side).transpose(2, 0, 1)[None]
                described.append(model.describe(pixels)[0].astype(np.float16))
                bar.advance()
    return np.stack(described)
