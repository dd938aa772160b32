"""Annotated scenes: the photos of one flight and which of them see the same points.

An annotation is one compressed numpy archive, `annotation.npz`. N is the number of images; pairs
are rows [i, j, count] of image indices, i < j, each pair once:

- `card`, JSON text: `format` ("colmap-netvlad annotation"), `version`, `scene` (its name),
  `images` (the photo folder, relative to the annotation's where it lies in it, else absolute),
  `method` (how the matched pairs were chosen: "exhaustive", "bow", ...), `names` (N),
  `fingerprints` (N, of the photo files), `points` (3D points of all models), `overlap` (see
  `Scene.overlap`);
- `sizes` (N, 2): width and height, px;
- `model` (N,): the reconstruction that registered an image, -1 for none;
- `poses` (N, 7): qw qx qy qz tx ty tz from world to camera, NaN where not registered;
- `common_points` (P, 3): pairs with their number of common 3D points GS (eq. 4), where any;
- `matches` (Q, 3): pairs with their number of verified matches, where any;
- `observed_first` (N + 1,), `observed_point` (M,), `observed_at` (M, 2): rows
  observed_first[i] to observed_first[i + 1] are the 3D points that image i observes, and where:
  origin in the centre of the photo, x right, y down, unit the longer side.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.graph.pair import Pair, as_pair
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically

FORMAT = "colmap-netvlad annotation"
VERSION = 1
ANNOTATION = "annotation.npz"

HARDLY_MATCHES = 8
"""With fewer verified matches than this a pair shows different ground: by chance there are some."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Which 3D points each image observes, and where in the photo.

    Attributes:
        first: (N + 1,) int, rows first[i] to first[i + 1] belong to image i.
        point: (M,) int32, index of the 3D point.
        at: (M, 2) float32, position: origin in the photo's centre, unit its longer side.
    """

    first: NDArray[np.int64]
    point: NDArray[np.int32]
    at: NDArray[np.float32]

    def of(self, image: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the points (m,) and positions (m, 2) of an image."""
        rows = slice(int(self.first[image]), int(self.first[image + 1]))
        return self.point[rows], self.at[rows]


@dataclass(frozen=True, eq=False)
class Scene:
    """One annotated scene.

    Attributes:
        name: the scene's name, unique in a dataset.
        images: the photo folder.
        names: N image names relative to it.
        common_points: (N, N) symmetric sparse int32, GS(a, b) of eq. 4, diagonal empty.
        matches: (N, N) symmetric sparse int32, verified matches, diagonal empty.
        sizes: (N, 2) int, width and height of the photos, px (their ratio matters).
        model: (N,) int, index of the reconstruction an image is registered in, or -1.
        poses: (N, 7) qw qx qy qz tx ty tz, world to camera; NaN where not registered.
        points: number of 3D points.
        method: how the matched pairs were chosen; "exhaustive" makes `matches` complete.
        fingerprints: of the photo files, for finding equal photos in two scenes.
        observations: the 3D points that each image observes, or None where not known.
        crops: (N, 3, 3) for pseudo-scenes: the homography from a photo to the view cut from it,
            in the coordinates of `augment`; None where a photo is taken whole.
        cut_from: for pseudo-scenes: the name of the scene whose photo they are cut from.
    """

    name: str
    images: Path
    names: tuple[str, ...]
    common_points: sparse.csr_array
    matches: sparse.csr_array
    sizes: NDArray[np.int32]
    model: NDArray[np.int32]
    poses: NDArray[np.float64]
    points: int
    method: str
    fingerprints: tuple[str, ...] = ()
    observations: Observations | None = None
    crops: NDArray[np.float64] | None = None
    cut_from: str | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def origin(self) -> str:
        """The flight: scenes of one origin may show the same ground, those of two never do."""
        return self.cut_from or self.name

    @property
    def registered(self) -> int:
        """The number of registered images."""
        return int((self.model >= 0).sum())

    @property
    def pairs(self) -> int:
        """The number of pairs with common 3D points."""
        return int(self.common_points.nnz // 2)

    @property
    def overlap(self) -> float:
        """Mean number of images that share points with a registered image."""
        return 2 * self.pairs / max(self.registered, 1)

    @cached_property
    def neighbours(self) -> sparse.csr_array:
        """(N, N) sparse, 1 where two images share 3D points or matched (> 15 matches)."""
        near = (self.common_points > 0) + (self.matches > CORRECT_MATCHES)
        return near.astype(np.int32).tocsr()

    def apart(self, image: int) -> NDArray[np.intp]:
        """Return the images that surely show other ground than `image`.

        They share no points with it, did not match, and have no neighbour in common with it; both
        have neighbours of their own, since an image that matched nothing may lie anywhere.
        """
        near = self.neighbours
        known = np.diff(near.indptr) > 0
        if not known[image]:
            return np.empty(0, np.intp)
        first = near.indices[near.indptr[image] : near.indptr[image + 1]]
        known[image] = False
        known[first] = False
        for neighbour in first:
            known[near.indices[near.indptr[neighbour] : near.indptr[neighbour + 1]]] = False
        return np.flatnonzero(known)

    def matched(self, image: int) -> NDArray[np.intp]:
        """Return the images with more than 15 verified matches with `image`."""
        row = slice(self.matches.indptr[image], self.matches.indptr[image + 1])
        return self.matches.indices[row][self.matches.data[row] > CORRECT_MATCHES].astype(np.intp)

    def unmatched(self, image: int) -> NDArray[np.intp]:
        """Return the images that hardly match `image` (< 8 verified matches, no common points).

        That says something of scenes whose pairs were all tried; of others it is `apart`.
        """
        if self.method != "exhaustive":
            return self.apart(image)
        strange = np.ones(len(self), bool)
        strange[image] = False
        row = slice(self.matches.indptr[image], self.matches.indptr[image + 1])
        strange[self.matches.indices[row][self.matches.data[row] >= HARDLY_MATCHES]] = False
        shared = self.common_points
        strange[shared.indices[shared.indptr[image] : shared.indptr[image + 1]]] = False
        return np.flatnonzero(strange)

    def correct_pairs(self) -> dict[Pair, int]:
        """Return the verified matches of the scene's correct pairs (> 15) by image names."""
        upper = sparse.triu(self.matches > CORRECT_MATCHES, k=1).tocoo()
        return {
            as_pair(self.names[i], self.names[j]): int(self.matches[i, j])
            for i, j in zip(upper.row.tolist(), upper.col.tolist(), strict=True)
        }


NO_OBSERVATIONS = Observations(
    np.zeros(1, np.int64), np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
)


def save_annotation(scene: Scene, path: Path) -> None:
    """Write an annotation whole or not at all.

    Raises:
        InputError: the folder cannot be written, or the disk is full.
    """
    card = {
        "format": FORMAT,
        "version": VERSION,
        "scene": scene.name,
        "images": _relative(scene.images, path.parent),
        "method": scene.method,
        "names": list(scene.names),
        "fingerprints": list(scene.fingerprints),
        "points": scene.points,
        "overlap": round(scene.overlap, 3),
    }
    seen = scene.observations or NO_OBSERVATIONS
    archive = io.BytesIO()
    np.savez_compressed(
        archive,
        card=np.array(json.dumps(card, ensure_ascii=False)),
        sizes=scene.sizes,
        model=scene.model,
        poses=scene.poses,
        common_points=_triples(scene.common_points),
        matches=_triples(scene.matches),
        observed_first=seen.first,
        observed_point=seen.point,
        observed_at=seen.at,
    )
    write_atomically(path, archive.getvalue())


def load_annotation(path: Path) -> Scene:
    """Read an annotation.

    Raises:
        InputError: it is missing, malformed, of another version, or its photos are gone.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist; `colmap-netvlad annotate` makes it.")
    try:
        with np.load(path) as archive:
            tables = dict(archive)
        card = json.loads(str(tables.pop("card")))
        found = card["format"], card["version"]
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as fault:
        raise InputError(
            f"{path} is not an annotation of colmap-netvlad, or damaged; remove it and run "
            "`colmap-netvlad annotate` again."
        ) from fault
    if found != (FORMAT, VERSION):
        raise InputError(
            f"{path} is an annotation of version {found[1]}, this program reads version "
            f"{VERSION}; remove the file and run `colmap-netvlad annotate` again."
        )
    try:
        return _scene_of(card, tables, path.parent)
    except (ValueError, KeyError, TypeError, IndexError) as fault:
        raise InputError(f"{path} is damaged ({fault}); remove it and annotate again.") from fault


def find_annotations(datasets: Iterable[Path]) -> list[Path]:
    """List the annotations of datasets (folders of scenes, scenes, or annotation files).

    Raises:
        InputError: a dataset has none.
    """
    found: list[Path] = []
    for dataset in datasets:
        if dataset.is_file():
            here = [dataset]
        elif (dataset / ANNOTATION).is_file():
            here = [dataset / ANNOTATION]
        else:
            here = sorted(dataset.glob(f"*/{ANNOTATION}"))
        if not here:
            raise InputError(
                f"{dataset} holds no annotated scene (no {ANNOTATION} in it or in its folders); "
                "run `colmap-netvlad annotate` on it first."
            )
        found += here
    return found


def load_dataset(
    datasets: Iterable[Path], leave_out: Sequence[str] = (), validation: Sequence[Scene] = ()
) -> list[Scene]:
    """Load all annotated scenes of datasets, but those named in `leave_out`.

    Scenes that have the name of one of `validation` are left out as well, where there are any.

    Raises:
        InputError: `leave_out` has a name that is no scene's, or what `load_annotation` and
            `check_disjoint` raise.
    """
    scenes = [load_annotation(path) for path in find_annotations(datasets)]
    known = {scene.name for scene in scenes}
    unknown = [name for name in leave_out if name not in known]
    if unknown:
        raise InputError(
            f"`leave_out` names {unknown[0]!r}, which is no scene of the datasets: there are "
            f"{', '.join(sorted(known))}."
        )
    held_out = {*leave_out, *(scene.name for scene in validation)}
    kept = [scene for scene in scenes if scene.name not in held_out]
    check_disjoint(kept)
    return kept


def check_disjoint(scenes: Sequence[Scene]) -> None:
    """Make sure that no photo is in two scenes, where it would be its own negative.

    Raises:
        InputError: equal photos, or two scenes of one name.
    """
    seen: dict[str, Scene] = {}
    owner: dict[str, tuple[Scene, str]] = {}
    for scene in scenes:
        if scene.name in seen:
            raise InputError(
                f"Two scenes are named {scene.name} ({seen[scene.name].images} and "
                f"{scene.images}); rename a folder."
            )
        seen[scene.name] = scene
        for name, fingerprint in zip(scene.names, scene.fingerprints, strict=False):
            other, other_name = owner.setdefault(fingerprint, (scene, name))
            if other is not scene:
                raise InputError(
                    f"The photo {name} of scene {scene.name} is also {other_name} of scene "
                    f"{other.name}; a photo must not be its own negative: leave one scene out."
                )


def symmetric(
    triples: Sequence[tuple[int, int, int]] | NDArray[np.integer], size: int
) -> sparse.csr_array:
    """Build a symmetric (size, size) matrix of counts from (i, j, count), each pair once."""
    table = np.asarray(triples, dtype=np.int64).reshape(-1, 3)
    rows, columns, counts = table.T
    if len(table) and (min(rows.min(), columns.min()) < 0 or (rows == columns).any()):
        raise ValueError("a pair of an image with itself or with no image")
    both = sparse.coo_array(
        (
            np.concatenate([counts, counts]).astype(np.int32),
            (np.concatenate([rows, columns]), np.concatenate([columns, rows])),
        ),
        shape=(size, size),
    )
    return both.tocsr()


def common_points(seen: Observations, points: int) -> sparse.csr_array:
    """Return (N, N) GS (eq. 4) of all images: the number of points that both observe."""
    ones = np.ones(len(seen.point), np.int32)
    shape = (len(seen.first) - 1, max(points, 1))
    observes = sparse.csr_array((ones, seen.point, seen.first), shape=shape)
    observes.data = np.ones_like(observes.data)
    common = sparse.csr_array(observes @ observes.T)
    common = sparse.csr_array(common - sparse.diags_array(common.diagonal(), dtype=np.int32))
    common.eliminate_zeros()
    return common.astype(np.int32)


def _triples(matrix: sparse.csr_array) -> NDArray[np.int32]:
    upper = sparse.triu(matrix, k=1).tocoo()
    table = np.stack([upper.row, upper.col, upper.data], axis=1).astype(np.int32)
    return table[np.lexsort((table[:, 1], table[:, 0]))]


def _scene_of(card: dict[str, Any], tables: dict[str, NDArray[Any]], folder: Path) -> Scene:
    names = tuple(card["names"])
    if any(len(tables[key]) != len(names) for key in ("sizes", "model", "poses")):
        raise ValueError("its tables have different lengths")
    images = (folder / card["images"]).resolve()
    if not images.is_dir():
        raise InputError(
            f"The photos of scene {card['scene']} are gone: there is no folder {images}."
        )
    seen = Observations(*(tables[f"observed_{key}"] for key in ("first", "point", "at")))
    return Scene(
        name=card["scene"],
        images=images,
        names=names,
        common_points=symmetric(tables["common_points"], len(names)),
        matches=symmetric(tables["matches"], len(names)),
        sizes=tables["sizes"],
        model=tables["model"],
        poses=tables["poses"],
        points=int(card["points"]),
        method=str(card["method"]),
        fingerprints=tuple(card["fingerprints"]),
        observations=seen if len(seen.first) == len(names) + 1 else None,
    )


def _relative(images: Path, folder: Path) -> str:
    images, folder = images.resolve(), folder.resolve()
    if images.is_relative_to(folder):
        return os.path.relpath(images, folder)
    return str(images)
