"""Training batches: which photos, and which of them is anchor, positive, negative (section 3.1).

Batched nontrivial sampling (eq. 6 and 8) needs no descriptors: B scenes, one anchor each, M of
its positives; the other anchors' positives are its negatives. Global hard negative mining (eq. 7)
describes all photos before each epoch and takes the nearest photos of other scenes; the paper has
one positive there (section 4.3.1), here there are M as well. What is cut
from the photos of a flight (`augment.pseudo_scene`) is no other scene than the flight.

Beside the paper's: another flight is trivially different, and telling apart photos of one flight
is the task. So an anchor can get negatives of its own flight that surely show other ground; and
flight batches hold many photos of few flights, all of them anchors, all relations between them
used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training.scenes import Scene

MINING = ("nontrivial", "global", "flight")

NEGATIVES = ("apart", "unmatched")


@dataclass(frozen=True)
class Query:
    """Roles in a batch, by row: the anchor, its positives by descending GS, its negatives."""

    anchor: int
    positives: tuple[int, ...]
    negatives: tuple[int, ...]


@dataclass(frozen=True)
class Batch:
    """The photos of a batch as (scene index, image index), and the queries over them."""

    samples: tuple[tuple[int, int], ...]
    queries: tuple[Query, ...]


@dataclass(frozen=True)
class SamplingOptions:
    """How batches are drawn.

    Attributes:
        mining: "nontrivial" (eq. 8), "global" (eq. 7), or "flight" (not the paper's).
        scenes: B, the anchors of a batch, each of another flight.
        positives: M, the positives of an anchor.
        epsilon: a positive shares more than this many 3D points with its anchor (eq. 6).
        negatives: what a negative of the same flight is: "apart" (`Scene.apart`) or "unmatched"
            (`Scene.unmatched`).
        hard_negatives: negatives of an anchor in global mining, each of another flight.
        flight_photos: photos drawn from each scene of a flight batch.
        same_flight: further negatives of an anchor from its own flight, surely apart.
        pseudo_share: the share of anchors drawn from pseudo-scenes, 0..1.
        seed: of all draws.
    """

    mining: str = "nontrivial"
    scenes: int = 5
    positives: int = 3
    epsilon: int = 15
    negatives: str = "apart"
    hard_negatives: int = 2
    flight_photos: int = 32
    same_flight: int = 0
    pseudo_share: float = 0.0
    seed: int = 0


class Sampler:
    """Draws batches from annotated scenes; the same seed and epoch give the same batches.

    Attributes:
        scenes: the scenes, as given.
        left_out: sentences on scenes that no batch can be drawn from.
    """

    def __init__(self, scenes: Sequence[Scene], options: SamplingOptions) -> None:
        """Find the possible anchors of each scene.

        Raises:
            InputError: no scene has an anchor with enough positives, or all that have are of
                one flight and no same-flight negatives were asked for.
        """
        self.scenes = list(scenes)
        self.options = options
        self.left_out: list[str] = []
        self._positives = [_positives(scene, options.epsilon) for scene in scenes]
        self._anchors: dict[int, list[int]] = {}
        for index, scene in enumerate(scenes):
            anchors = [
                image
                for image, found in enumerate(self._positives[index])
                if len(found) >= options.positives
            ]
            if anchors:
                self._anchors[index] = anchors
            elif scene.crops is None:
                self.left_out.append(
                    f"Scene {scene.name} is left out: none of its {len(scene)} photos shares more "
                    f"than {options.epsilon} points with {options.positives} others."
                )
        self._check()
        self._real: dict[str, list[int]] = {}
        self._pseudo: dict[str, list[int]] = {}
        for index in self._anchors:
            kind = self._real if scenes[index].crops is None else self._pseudo
            kind.setdefault(scenes[index].origin, []).append(index)
        self._origins = list(self._real | self._pseudo)

    def _check(self) -> None:
        if not self._anchors:
            raise InputError(
                "No scene can give a batch: an anchor needs "
                f"{self.options.positives} positives with more than {self.options.epsilon} common "
                "points. " + " ".join(self.left_out)
            )
        origins = {self.scenes[index].origin for index in self._anchors}
        if len(origins) > 1 or self.options.mining == "flight":
            return
        (only,) = origins
        if self.options.mining == "global" or not self.options.same_flight:
            raise InputError(
                f"There is one usable scene only ({only}), and negatives come "
                "from other scenes: annotate another flight, or ask for `same_flight` negatives."
            )
        self._anchors = {
            index: kept
            for index, images in self._anchors.items()
            if (kept := [image for image in images if len(self._strangers(index, image))])
        }
        if not self._anchors:
            raise InputError(
                f"The one usable scene {only} has no two photos that are surely apart, so "
                "there are no negatives: annotate another flight."
            )

    def batches(
        self, epoch: int, count: int, descriptors: Sequence[NDArray[np.floating]] | None = None
    ) -> list[Batch]:
        """Draw the `count` batches of an epoch.

        Args:
            descriptors: for global mining, one (N, D) L2-normalised array a scene, of the
                network as it stands before the epoch.
        """
        rng = np.random.default_rng([self.options.seed, epoch])
        if self.options.mining == "global":
            if descriptors is None:
                raise ValueError("global hard negative mining needs the descriptors")
            return [self._hard_batch(rng, descriptors) for _ in range(count)]
        draw = self._flight_batch if self.options.mining == "flight" else self._nontrivial_batch
        return [draw(rng) for _ in range(count)]

    def _nontrivial_batch(self, rng: np.random.Generator) -> Batch:
        builder = _Builder()
        drawn = []
        for scene in self._draw_scenes(rng):
            anchor, positives = self._draw_positives(rng, scene)
            row = builder.add(scene, anchor)
            rows = tuple(builder.add(scene, image) for image in positives)
            own = tuple(builder.add(scene, image) for image in self._draw_apart(rng, scene, anchor))
            drawn.append((row, rows, own))
        queries = []
        for number, (row, rows, own) in enumerate(drawn):
            others = [p for k, (_, rows_k, _) in enumerate(drawn) if k != number for p in rows_k]
            queries.append(Query(row, rows, (*others, *own)))
        return Batch(tuple(builder.samples), tuple(queries))

    def _hard_batch(
        self, rng: np.random.Generator, descriptors: Sequence[NDArray[np.floating]]
    ) -> Batch:
        builder = _Builder()
        queries = []
        origins = [scene.origin for scene in self.scenes]
        for scene in self._draw_scenes(rng):
            anchor, positives = self._draw_positives(rng, scene)
            hardest = nearest_of_other_scenes(descriptors, origins, scene, anchor)
            chosen = rng.permutation(len(hardest))[: self.options.hard_negatives]
            row = builder.add(scene, anchor)
            rows = tuple(builder.add(scene, image) for image in positives)
            negatives = [builder.add(*hardest[number]) for number in chosen]
            negatives += [builder.add(scene, i) for i in self._draw_apart(rng, scene, anchor)]
            queries.append(Query(row, rows, tuple(negatives)))
        return Batch(tuple(builder.samples), tuple(queries))

    def _flight_batch(self, rng: np.random.Generator) -> Batch:
        """Many photos of each scene, every one an anchor.

        Its positives share points with it and matched; larger scenes are drawn more often.
        """
        builder = _Builder()
        queries = []
        for scene in self._draw_flights(rng):
            count = len(self.scenes[scene])
            images = np.sort(rng.permutation(count)[: self.options.flight_photos]).tolist()
            row_of = {image: builder.add(scene, image) for image in images}
            for image in images:
                found = self._positives[scene][image].tolist()
                matched = set(self.scenes[scene].matched(image).tolist())
                positives = tuple(row_of[i] for i in found if i in row_of and i in matched)
                strangers = self._strangers(scene, image).tolist()
                negatives = tuple(row_of[i] for i in strangers if i in row_of)
                if positives:
                    queries.append(Query(row_of[image], positives, negatives))
        return Batch(tuple(builder.samples), tuple(queries))

    def _draw_flights(self, rng: np.random.Generator) -> list[int]:
        """Scenes with a probability that goes with the square root of their photos."""
        usable = list(self._anchors)
        weights = np.sqrt([len(self.scenes[scene]) for scene in usable])
        count = min(self.options.scenes, len(usable))
        drawn = rng.choice(len(usable), size=count, replace=False, p=weights / weights.sum())
        return [usable[i] for i in drawn]

    def _strangers(self, scene: int, image: int) -> NDArray[np.intp]:
        """The possible negatives of an image in its own flight."""
        one = self.scenes[scene]
        return one.apart(image) if self.options.negatives == "apart" else one.unmatched(image)

    def _draw_scenes(self, rng: np.random.Generator) -> list[int]:
        """B scenes of different flights (fewer where there are fewer), some of them pseudo-scenes.

        A pseudo-scene shows the ground of its flight, so the two give each other no negatives.
        """
        pseudo = rng.random(self.options.scenes) < self.options.pseudo_share
        left = [self._origins[i] for i in rng.permutation(len(self._origins))]
        chosen = []
        for is_pseudo in pseudo[: len(left)]:
            wanted, other = self._pseudo, self._real
            if not is_pseudo:
                wanted, other = other, wanted
            origin = next((origin for origin in left if origin in wanted), left[0])
            left.remove(origin)
            usable = wanted.get(origin) or other[origin]
            chosen.append(usable[rng.integers(len(usable))])
        return chosen

    def _draw_positives(self, rng: np.random.Generator, scene: int) -> tuple[int, list[int]]:
        """One anchor and M of its positives (eq. 6), by descending GS."""
        anchor = int(rng.choice(self._anchors[scene]))
        found = self._positives[scene][anchor]
        picks = np.sort(rng.permutation(len(found))[: self.options.positives])
        return anchor, [int(found[i]) for i in picks]

    def _draw_apart(self, rng: np.random.Generator, scene: int, anchor: int) -> list[int]:
        if not self.options.same_flight:
            return []
        apart = self._strangers(scene, anchor)
        return [int(apart[i]) for i in rng.permutation(len(apart))[: self.options.same_flight]]


def nearest_of_other_scenes(
    descriptors: Sequence[NDArray[np.floating]], origins: Sequence[str], scene: int, image: int
) -> list[tuple[int, int]]:
    """Return for each other flight k its photo nearest to the query: argmin ||f_q - f_n|| (eq. 7).

    Args:
        descriptors: one (N, D) L2-normalised array a scene.
        origins: the flight of each scene; pseudo-scenes are of the flight they are cut from.
        scene, image: the query.

    Returns:
        (scene, image), one for each flight but the query's.
    """
    query = descriptors[scene][image].astype(np.float32)
    nearest: dict[str, tuple[float, int, int]] = {}
    for k, others in enumerate(descriptors):
        if origins[k] == origins[scene] or not len(others):
            continue
        # Of unit vectors the nearest is the one with the largest inner product.
        products = others @ query
        found = int(np.argmax(products))
        best = nearest.get(origins[k])
        if best is None or products[found] > best[0]:
            nearest[origins[k]] = float(products[found]), k, found
    return [(k, found) for _, k, found in nearest.values()]


def _positives(scene: Scene, epsilon: int) -> list[NDArray[np.intp]]:
    """For each image its possible positives {t: GS(t, q) > epsilon}, by descending GS."""
    table = scene.common_points
    found = []
    for image in range(len(scene)):
        row = slice(table.indptr[image], table.indptr[image + 1])
        partners, counts = table.indices[row], table.data[row]
        keep = counts > epsilon
        order = np.lexsort((partners[keep], -counts[keep]))
        found.append(partners[keep][order].astype(np.intp))
    return found


class _Builder:
    """Collects the photos of a batch, each once."""

    def __init__(self) -> None:
        self.samples: list[tuple[int, int]] = []
        self._rows: dict[tuple[int, int], int] = {}

    def add(self, scene: int, image: int) -> int:
        """Return the row of a photo, adding it where it is new."""
        row = self._rows.setdefault((scene, image), len(self.samples))
        if row == len(self.samples):
            self.samples.append((scene, image))
        return row
