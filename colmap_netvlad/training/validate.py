"""How well a network ranks the photos of flights it was not trained on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.metrics import accuracy, mean_average_precision
from colmap_netvlad.pairs.union import union_of_top
from colmap_netvlad.photos.decode import load_batches
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path
from colmap_netvlad.runtime.progress import step
from colmap_netvlad.training.inputs import fingerprint_of_photos
from colmap_netvlad.training.scenes import Scene
from colmap_netvlad.training.stages import SplitNetwork

Front = tuple[NDArray[np.int64], NDArray[np.float16]]
"""Rows of photos in their scene, and their frozen features (n, C, h, w) in one orientation."""


@dataclass(frozen=True)
class Score:
    """Figures of one ranking, all 0..1.

    Attributes:
        mean_average_precision: over the whole ranking.
        accuracy10, accuracy20: eq. 19 of the pairs retrieved with k = 10 and 20.
    """

    mean_average_precision: float
    accuracy10: float
    accuracy20: float


def score(ranking: Ranking, scene: Scene) -> Score:
    """Measure a full ranking against a scene's correct pairs."""
    correct = scene.correct_pairs()

    def accuracy_at(k: int) -> float:
        pairs = union_of_top(ranking, k)
        return accuracy([(pair.name1, pair.name2) for pair in pairs], correct)

    precision = mean_average_precision(ranking, correct, len(ranking.names) - 1)
    return Score(precision, accuracy_at(10), accuracy_at(20))


def mean_score(scores: Sequence[Score]) -> Score:
    """Return the mean over scenes."""
    return Score(
        fmean(s.mean_average_precision for s in scores),
        fmean(s.accuracy10 for s in scores),
        fmean(s.accuracy20 for s in scores),
    )


def full_ranking(names: tuple[str, ...], descriptors: NDArray[np.floating], method: str) -> Ranking:
    """Rank all photos of a scene for each of them by inner product, exactly."""
    similarity = descriptors.astype(np.float32) @ descriptors.astype(np.float32).T
    np.fill_diagonal(similarity, -np.inf)
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :-1].astype(np.int32)
    return Ranking(names, order, np.take_along_axis(similarity, order, axis=1), method)


class Validation:
    """Scenes that are never trained on, and a network's scores on them.

    Photos are described as a finished model describes them: whole, at `long_side`, averaged over
    quarter turns. Where the front of the network is frozen its features are kept in `folder`.
    """

    def __init__(
        self, scenes: Sequence[Scene], long_side: int, rotations: int, folder: Path | None = None
    ) -> None:
        """Check that the scenes have correct pairs.

        Raises:
            InputError: one has none, so that there is nothing to measure.
        """
        for scene in scenes:
            if not scene.correct_pairs():
                raise InputError(
                    f"The validation scene {scene.name} has no pair with more than 15 verified "
                    "matches; leave it out."
                )
        self.scenes = list(scenes)
        self._long_side = long_side
        self._rotations = rotations
        self._folder = folder

    def scores(self, network: SplitNetwork) -> dict[str, Score]:
        """Return the score of each scene by its name."""
        with step("Validating", sum(len(scene) for scene in self.scenes)) as bar:
            found = {}
            for scene in self.scenes:
                ranking = full_ranking(scene.names, self.describe(network, scene), "training")
                found[scene.name] = score(ranking, scene)
                bar.advance(len(scene))
        return found

    @torch.inference_mode()
    def describe(self, network: SplitNetwork, scene: Scene) -> NDArray[np.float32]:
        """Return (N, dim) L2-normalised descriptors of a scene's photos."""
        total = torch.zeros(len(scene), network.network.dim)
        device = next(network.parameters()).device
        for rows, front in self._fronts(network, scene):
            for first in range(0, len(rows), 4):
                part = torch.from_numpy(front[first : first + 4])
                described = network.rest(part.to(device).float()).float().cpu()
                total[rows[first : first + 4]] += described
        return functional.normalize(total, dim=1).numpy()

    def _fronts(self, network: SplitNetwork, scene: Scene) -> Iterator[Front]:
        """Yield the frozen features of all photos and quarter turns, kept ones where there are."""
        if not network.frozen_layers or self._folder is None:
            yield from self._compute(network, scene)
            return
        key = f"{fingerprint_of_photos([scene])}-{network.frozen_fingerprint()}"
        folder = self._folder / f"{scene.name}-{self._long_side}-{self._rotations}-{key}"
        if not (folder / "complete").exists():
            for number, (rows, front) in enumerate(self._compute(network, scene)):
                with (
                    atomic_path(folder / f"{number:06d}.npz") as temporary,
                    temporary.open("wb") as file,
                ):
                    np.savez(file, rows=rows, front=front)
            (folder / "complete").touch()
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as kept:
                yield kept["rows"], kept["front"]

    def _compute(self, network: SplitNetwork, scene: Scene) -> Iterator[Front]:
        index = {name: row for row, name in enumerate(scene.names)}
        device = next(network.parameters()).device
        for batch in load_batches(scene.images, scene.names, self._long_side, 8):
            if batch.bad:
                name, reason = batch.bad[0]
                raise InputError(
                    f"The photo {name} of the validation scene {scene.name} {reason}; mend it, or "
                    "take it out and annotate the scene again."
                )
            rows = np.array([index[name] for name in batch.names])
            pixels = torch.from_numpy(batch.pixels).to(device)
            for turns in range(self._rotations):
                with torch.inference_mode():
                    front = network.front(torch.rot90(pixels, turns, dims=(2, 3)))
                yield rows, front.half().cpu().numpy()
