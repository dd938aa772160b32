"""Annotated scenes: the photos of one flight and which of them see the same points.

An annotation is one JSON file, `annotation.json`, with these keys (all lists over images are in
the order of `names`; pairs are given once, by index, the lower first):

- `format` ("colmap-netvlad annotation"), `version` (an integer), `scene` (its name);
- `images`: the photo folder, relative to the annotation's folder where it lies in it, else
  absolute;
- `method`: how the matched pairs were chosen ("exhaustive", "bow", ...), and `photos`: how many
  photos the folder held;
- `names`, `fingerprints` (of the photo files), `model` (which reconstruction registered an
  image, -1 for none), `poses` ([qw, qx, qy, qz, tx, ty, tz] from world to camera, or null);
- `points`: the number of 3D points of all models, `overlap`: mean overlap (see `Scene.overlap`);
- `common_points`: [i, j, GS] triples, GS(i, j) the number of common 3D points (eq. 4) where any;
- `matches`: [i, j, n] triples, n the number of verified matches where any.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.errors import InputError
from colmap_netvlad.files import write_atomically
from colmap_netvlad.metrics import CORRECT_MATCHES, Pair, as_pair

FORMAT = "colmap-netvlad annotation"
VERSION = 1
ANNOTATION = "annotation.json"


@dataclass(frozen=True, eq=False)
class Scene:
    """One annotated scene.

    Attributes:
        name: the scene's name, unique in a dataset.
        images: the photo folder.
        names: N image names relative to it.
        common_points: (N, N) symmetric sparse int32, GS(a, b) of eq. 4, diagonal empty.
        matches: (N, N) symmetric sparse int32, verified matches, diagonal empty.
        model: (N,) int, index of the reconstruction an image is registered in, or -1.
        poses: (N, 7) qw qx qy qz tx ty tz, world to camera; NaN where not registered.
        points: number of 3D points.
        method: how the matched pairs were chosen; "exhaustive" makes `matches` complete.
        fingerprints: of the photo files, for finding equal photos in two scenes.
        crops: (N, 3, 3) for pseudo-scenes: the homography from a photo to the view cut from it,
            in the coordinates of `augment`; None where a photo is taken whole.
    """

    name: str
    images: Path
    names: tuple[str, ...]
    common_points: sparse.csr_array
    matches: sparse.csr_array
    model: NDArray[np.int32]
    poses: NDArray[np.float64]
    points: int
    method: str
    fingerprints: tuple[str, ...] = ()
    crops: NDArray[np.float64] | None = field(default=None)

    def __len__(self) -> int:
        return len(self.names)

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

    def correct_pairs(self) -> dict[Pair, int]:
        """Return the verified matches of the scene's correct pairs (> 15) by image names."""
        upper = sparse.triu(self.matches > CORRECT_MATCHES, k=1).tocoo()
        return {
            as_pair(self.names[i], self.names[j]): int(self.matches[i, j])
            for i, j in zip(upper.row.tolist(), upper.col.tolist(), strict=True)
        }


def save_annotation(scene: Scene, path: Path) -> None:
    """Write an annotation whole or not at all.

    Raises:
        InputError: the folder cannot be written, or the disk is full.
    """
    record = {
        "format": FORMAT,
        "version": VERSION,
        "scene": scene.name,
        "images": _relative(scene.images, path.parent),
        "method": scene.method,
        "photos": len(scene),
        "names": list(scene.names),
        "fingerprints": list(scene.fingerprints),
        "model": scene.model.tolist(),
        "poses": [None if np.isnan(pose).any() else pose.tolist() for pose in scene.poses],
        "points": scene.points,
        "overlap": round(scene.overlap, 3),
        "common_points": _triples(scene.common_points),
        "matches": _triples(scene.matches),
    }
    write_atomically(path, json.dumps(record, ensure_ascii=False))


def load_annotation(path: Path) -> Scene:
    """Read an annotation.

    Raises:
        InputError: it is missing, malformed, of another version, or its photos are gone.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist; `colmap-netvlad annotate` makes it.")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        found = record["format"], record["version"]
    except (ValueError, KeyError, TypeError) as fault:
        raise InputError(f"{path} is not an annotation of colmap-netvlad ({fault}).") from fault
    if found != (FORMAT, VERSION):
        raise InputError(
            f"{path} is an annotation of version {found[1]}, this program reads version "
            f"{VERSION}; remove the file and run `colmap-netvlad annotate` again."
        )
    try:
        return _scene_of(record, path.parent)
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


def load_dataset(datasets: Iterable[Path], leave_out: Sequence[str] = ()) -> list[Scene]:
    """Load all annotated scenes of datasets, but those named in `leave_out`.

    Raises:
        InputError: a name in `leave_out` is no scene, or what `load_annotation` and
            `check_disjoint` raise.
    """
    scenes = [load_annotation(path) for path in find_annotations(datasets)]
    unknown = set(leave_out) - {scene.name for scene in scenes}
    if unknown:
        raise InputError(f"No scene is named {', '.join(sorted(unknown))}.")
    kept = [scene for scene in scenes if scene.name not in leave_out]
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
    triples: Iterable[tuple[int, int, int]] | Sequence[Sequence[int]], size: int
) -> sparse.csr_array:
    """Build a symmetric (size, size) matrix of counts from (i, j, count), each pair once."""
    table = np.asarray(list(triples), dtype=np.int64).reshape(-1, 3)
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


def _triples(matrix: sparse.csr_array) -> list[list[int]]:
    upper = sparse.triu(matrix, k=1).tocoo()
    table = np.stack([upper.row, upper.col, upper.data], axis=1).astype(int)
    return table[np.lexsort((table[:, 1], table[:, 0]))].tolist()


def _scene_of(record: dict, folder: Path) -> Scene:
    names = tuple(record["names"])
    empty = [float("nan")] * 7
    poses = [pose or empty for pose in record["poses"]]
    if not len(names) == len(poses) == len(record["model"]):
        raise ValueError("its lists have different lengths")
    images = (folder / record["images"]).resolve()
    if not images.is_dir():
        raise InputError(
            f"The photos of scene {record['scene']} are gone: there is no folder {images}."
        )
    return Scene(
        name=record["scene"],
        images=images,
        names=names,
        common_points=symmetric(record["common_points"], len(names)),
        matches=symmetric(record["matches"], len(names)),
        model=np.asarray(record["model"], dtype=np.int32),
        poses=np.asarray(poses, dtype=np.float64).reshape(-1, 7),
        points=int(record["points"]),
        method=str(record["method"]),
        fingerprints=tuple(record["fingerprints"]),
    )


def _relative(images: Path, folder: Path) -> str:
    images, folder = images.resolve(), folder.resolve()
    if images.is_relative_to(folder):
        return os.path.relpath(images, folder)
    return str(images)
