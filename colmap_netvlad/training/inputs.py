"""What goes into the network: views of photos, or their frozen features kept on disk."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from colmap_netvlad.photos.decode import SIDE_MULTIPLE, decode_photo
from colmap_netvlad.photos.files import BadPhoto, photo_path
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.progress import step
from colmap_netvlad.training.augment import View, draw_view, render
from colmap_netvlad.training.options import TrainOptions
from colmap_netvlad.training.sampling import Batch
from colmap_netvlad.training.scenes import Scene
from colmap_netvlad.training.stages import SplitNetwork

MEMORY_BYTES = 1 << 30
"""Decoded photos kept in memory."""

LARGEST_SIDE = 2048
"""Photos are decoded to this at most, px."""

# Streams of random numbers, so that no draw depends on how many others were made.
_VIEWS, _KEPT_VIEWS, _CHOICES = 1, 2, 3


@dataclass(frozen=True, eq=False)
class Drawn:
    """Inputs of a batch.

    Attributes:
        inputs: (N, ...) for `Inputs.front`.
        homographies: (N, 3, 3) from each photo to its view.
    """

    inputs: Tensor
    homographies: NDArray[np.float64]


class Inputs(Protocol):
    """Where a batch's inputs come from."""

    def batch(self, batch: Batch, epoch: int, number: int) -> Drawn:
        """Return the inputs of batch `number` of an epoch; the same whenever asked for."""

    def for_mining(self, scene: int, image: int) -> Tensor:
        """Return the input (1, ...) that a photo is described by for global mining."""

    def front(self, network: SplitNetwork, inputs: Tensor) -> Tensor:
        """Return the frozen features of such inputs, float (N, C, h, w)."""


class Photos:
    """The photos of scenes, decoded on demand, and views of them."""

    def __init__(self, scenes: Sequence[Scene], options: TrainOptions) -> None:
        self.scenes = scenes
        self.size = (options.width, options.height)
        self._options = options
        self._augmentation = options.for_views()
        self._kept: OrderedDict[tuple[Path, int], NDArray[np.uint8]] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def photo(self, scene: int, image: int, shrink: float = 1.0) -> NDArray[np.uint8]:
        """Return a decoded photo (H, W, 3), large enough for views that show `shrink` of it.

        Raises:
            InputError: the photo cannot be read any more.
        """
        one = self.scenes[scene]
        if one.crops is not None:
            shrink *= self._options.for_pseudo_scenes().scale[0]
        side = min(LARGEST_SIDE, math.ceil(max(self.size) / min(shrink, 1.0)))
        path = one.images / one.names[image]
        with self._lock:
            if (path, side) in self._kept:
                self._kept.move_to_end((path, side))
                return self._kept[path, side]
        try:
            pixels = decode_photo(photo_path(one.images, one.names[image]), side)
        except BadPhoto as fault:
            raise InputError(
                f"The photo {path} of scene {one.name} {fault}; mend it, or take it out and "
                "annotate the scene again."
            ) from fault
        with self._lock:
            if (path, side) not in self._kept:
                self._kept[path, side] = pixels
                self._bytes += pixels.nbytes
            while self._bytes > MEMORY_BYTES and len(self._kept) > 1:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return pixels

    def draw(
        self, scene: int, image: int, rng: np.random.Generator, upright: bool | None = None
    ) -> View:
        """Draw a random view of a photo, or of a pseudo-scene's cut of it.

        Args:
            upright: whether it is the whole photo as it stands; None: by chance.
        """
        if upright is None:
            upright = rng.random() < self._options.upright
        if upright:
            return View(np.eye(3))
        width, height = self.scenes[scene].sizes[image].tolist()
        return draw_view(rng, (width, height), self.size, self._augmentation)

    def render(self, scene: int, image: int, view: View) -> NDArray[np.uint8]:
        """Render a view that `draw` drew: (H, W, 3)."""
        photo = self.photo(scene, image, self._options.scale_min)
        return render(photo, view, self.size, self._crop(scene, image))

    def whole(self, scene: int, image: int, long_side: int) -> NDArray[np.uint8]:
        """Return a photo, or a pseudo-scene's cut of it, upright and whole: (H, W, 3)."""
        one = self.scenes[scene]
        if one.crops is None:
            return decode_photo(photo_path(one.images, one.names[image]), long_side)
        photo = self.photo(scene, image)
        size = decoded_size(photo.shape[1::-1], long_side)
        return render(photo, View(np.eye(3)), size, self._crop(scene, image))

    def batch(self, batch: Batch, epoch: int, number: int) -> Drawn:
        """Return new views, uint8 (N, 3, H, W)."""
        seed = self._options.seed
        views = [
            self.draw(*sample, np.random.default_rng([seed, _VIEWS, epoch, number, row]))
            for row, sample in enumerate(batch.samples)
        ]
        rendered = [self.render(*s, view) for s, view in zip(batch.samples, views, strict=True)]
        return Drawn(_stack(rendered), np.stack([view.homography for view in views]))

    def for_mining(self, scene: int, image: int) -> Tensor:
        """Return the photo itself, whole and upright, uint8 (1, 3, H, W)."""
        return _stack([self.render(scene, image, View(np.eye(3)))])

    def front(self, network: SplitNetwork, inputs: Tensor) -> Tensor:
        """See `Inputs`."""
        return network.front(inputs)

    def _crop(self, scene: int, image: int) -> NDArray[np.float64] | None:
        crops = self.scenes[scene].crops
        return None if crops is None else crops[image]


class KeptFeatures:
    """Frozen features of a fixed number of views of every photo, in one float16 file.

    The file is written front to back, so a killed run goes on where it stopped; its name holds a
    hash of all it depends on.
    """

    def __init__(
        self, photos: Photos, network: SplitNetwork, options: TrainOptions, folder: Path
    ) -> None:
        """Compute what is missing.

        Raises:
            InputError: the disk has no room for the features, or a photo cannot be read.
        """
        self._photos = photos
        self._views = options.views
        self._seed = options.seed
        self._upright = round(options.upright * options.views)
        sizes = [len(scene) for scene in photos.scenes]
        self._first = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        key = fingerprint_of_views(network, photos.scenes, options)
        self.path = folder / f"features-{key}.f16"
        with torch.inference_mode():
            device = next(network.parameters()).device
            empty = torch.zeros(1, 3, options.height, options.width, device=device)
            probe = network.front(empty)
        self._shape = tuple(probe.shape[1:])
        self._compute(network, device)
        count = int(self._first[-1]) * self._views
        self._features = np.memmap(self.path, np.float16, mode="r", shape=(count, *self._shape))

    def batch(self, batch: Batch, epoch: int, number: int) -> Drawn:
        """Return features of one of the kept views of each photo, float16 (N, C, h, w)."""
        rng = np.random.default_rng([self._seed, _CHOICES, epoch, number])
        views = rng.integers(self._views, size=len(batch.samples)).tolist()
        rows = [
            int(self._first[scene] + image) * self._views + view
            for (scene, image), view in zip(batch.samples, views, strict=True)
        ]
        homographies = [self._draw(row)[2].homography for row in rows]
        features = np.stack([self._features[row] for row in rows])
        return Drawn(torch.from_numpy(features), np.stack(homographies))

    def for_mining(self, scene: int, image: int) -> Tensor:
        """Return features of the photo's first kept view, float16 (1, C, h, w).

        That is the photo itself where `upright` keeps one, else a view like the others: features
        of whole photos would cost another run of the frozen part.
        """
        row = int(self._first[scene] + image) * self._views
        return torch.from_numpy(self._features[row : row + 1].copy())

    def front(self, network: SplitNetwork, inputs: Tensor) -> Tensor:
        """See `Inputs`."""
        return inputs.float()

    @torch.inference_mode()
    def _compute(self, network: SplitNetwork, device: torch.device) -> None:
        size = 2 * math.prod(self._shape)
        total = int(self._first[-1]) * self._views
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.touch()
        done = self.path.stat().st_size // size
        needed = (total - done) * size
        free = shutil.disk_usage(self.path.parent).free
        if needed > free:
            raise InputError(
                f"The kept features need {needed / 2**30:.1f} GiB in {self.path.parent}, which has "
                f"{free / 2**30:.1f} GiB free; make room, or lower `views`."
            )
        try:
            with self.path.open("r+b") as file, step("Features of views", total) as bar:
                file.truncate(done * size)
                file.seek(0, 2)
                bar.advance(done)
                for first in range(done, total, 8):
                    drawn = [self._draw(i) for i in range(first, min(first + 8, total))]
                    views = [self._photos.render(*one) for one in drawn]
                    features = network.front(_stack(views).to(device))
                    file.write(features.half().cpu().numpy().tobytes())
                    bar.advance(len(views))
        except OSError as fault:
            raise InputError(f"Cannot write {self.path}: {fault.strerror}.") from fault

    def _draw(self, number: int) -> tuple[int, int, View]:
        """Return scene, image and view of a row of the file."""
        row, view = divmod(number, self._views)
        scene = int(np.searchsorted(self._first, row, side="right")) - 1
        image = row - int(self._first[scene])
        rng = np.random.default_rng([self._seed, _KEPT_VIEWS, scene, image, view])
        return scene, image, self._photos.draw(scene, image, rng, upright=view < self._upright)


def decoded_size(photo: Sequence[int], long_side: int) -> tuple[int, int]:
    """Return width and height of a photo reduced as `decode_photo` reduces it."""
    scale = long_side / max(photo[0], photo[1])
    width, height = (
        max(SIDE_MULTIPLE, round(side * scale / SIDE_MULTIPLE) * SIDE_MULTIPLE)
        for side in (photo[0], photo[1])
    )
    return width, height


def fingerprint_of_views(
    network: SplitNetwork, scenes: Sequence[Scene], options: TrainOptions
) -> str:
    """Return a hash of all that the frozen features of views depend on."""
    record = (options.width, options.height, options.views, options.upright, options.seed)
    text = (
        repr((record, options.for_views()))
        + network.frozen_fingerprint()
        + fingerprint_of_photos(scenes)
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fingerprint_of_photos(scenes: Sequence[Scene]) -> str:
    """Return a hash of the photos of scenes and of how pseudo-scenes are cut from them."""
    record = [
        (
            scene.name,
            list(scene.names),
            list(scene.fingerprints),
            None if scene.crops is None else scene.crops.tolist(),
        )
        for scene in scenes
    ]
    return hashlib.sha256(json.dumps(record).encode()).hexdigest()[:16]


def _stack(views: Sequence[NDArray[np.uint8]]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.stack(views).transpose(0, 3, 1, 2)))
