"""Put models together that share no image: verified pairs across them, one solve for all.

A match between photos of two models says that two 3D points are one. Robust similarities from
these points say which models fit; then the similarities of all models are solved at once, so that
errors do not add up along a chain.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import networkx as nx
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.mapping.merge import (
    Refused,
    SubModel,
    agreeing,
    join_cameras,
    move,
    read_sub_model,
    seen_once,
    shared_points,
    similarity,
)
from colmap_netvlad.mapping.options import MappingOptions, pipeline_options
from colmap_netvlad.mapping.refine import load_cache, rebuild, refine

SOLVED_POINTS = 500
"""Common points of two models that take part in the solve, evenly chosen."""

ROBUST_PIXELS = 2.0
"""Common points farther apart than this lose weight in the solve, px."""

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Matches = tuple[int, int, NDArray[np.uint32]]
"""Two image ids and (M, 2) keypoint indices of their verified matches."""


@dataclass(frozen=True, eq=False)
class Link:
    """What joins two models.

    Attributes:
        points: (S, 2) rows of points of the first and the second model that agree.
        first_from_second: the similarity they agree on.
    """

    points: Rows
    first_from_second: pycolmap.Sim3d


@dataclass(frozen=True)
class Together:
    """Models joined into one.

    Attributes:
        model: the joined model, in the frame of its largest member.
        members: names, largest first.
        refused: (name, reason) of models that share points with it but do not fit.
    """

    model: SubModel
    members: list[str]
    refused: list[tuple[str, str]]


def put_together(
    models: Sequence[SubModel], matches: Iterable[Matches], seed: int = 0
) -> list[Together]:
    """Join models into as few as fit together, largest first.

    Args:
        models: image ids are those of one database; images may be in several models.
        matches: verified matches between images of different models.
        seed: of RANSAC.
    """
    models = sorted(models, key=lambda model: (-len(model.poses), -len(model.xyz), model.name))
    links, faults = _links(models, common_points(models, matches), seed)
    graph = nx.Graph()
    graph.add_nodes_from(range(len(models)))
    for (a, b), link in links.items():
        graph.add_edge(a, b, weight=len(link.points))
    groups = sorted((sorted(group) for group in nx.connected_components(graph)), key=min)
    joined = []
    for group in groups:
        base = group[0]
        placed = solve(models, links, graph, group)
        refused = [
            (models[other].name, reason)
            for (a, b), reason in faults.items()
            for inside, other in ((a, b), (b, a))
            if inside == base and other not in group
        ]
        joined.append(
            Together(_union(models, links, placed), [models[i].name for i in group], refused)
        )
    return joined


def common_points(
    models: Sequence[SubModel], matches: Iterable[Matches]
) -> dict[tuple[int, int], Rows]:
    """Return (S, 2) rows of points that are one, for each two models (lower number first).

    Each point stands once, with the point that most matches (and common observations) join it to.
    """
    homes: dict[int, list[int]] = {}
    for number, model in enumerate(models):
        for image in model.poses:
            homes.setdefault(image, []).append(number)
    votes: dict[tuple[int, int], list[Rows]] = {}
    for image1, image2, rows in matches:
        for a in homes.get(image1, []):
            for b in homes.get(image2, []):
                if a != b:
                    first = _owners(models[a], image1, rows[:, 0])
                    second = _owners(models[b], image2, rows[:, 1])
                    both = np.stack([first, second], axis=1)[(first >= 0) & (second >= 0)]
                    votes.setdefault((min(a, b), max(a, b)), []).append(
                        both if a < b else both[:, ::-1]
                    )
    for a in range(len(models)):
        for b in range(a + 1, len(models)):
            shared = shared_points(models[a], models[b])
            if len(shared):
                votes.setdefault((a, b), []).append(shared)
    return {pair: _mutual(np.concatenate(found)) for pair, found in sorted(votes.items())}


def solve(
    models: Sequence[SubModel],
    links: dict[tuple[int, int], Link],
    graph: nx.Graph,
    group: Sequence[int],
) -> dict[int, pycolmap.Sim3d]:
    """Return the similarity of every model of a group into the frame of its first, solved at once.

    It starts from the strongest links and minimises the distances of all common points, robustly.
    """
    base, others = group[0], list(group[1:])
    start = {base: pycolmap.Sim3d()}
    tree = nx.maximum_spanning_tree(graph.subgraph(group))
    for known, new in nx.bfs_edges(tree, base):
        link = links[min(known, new), max(known, new)]
        step = link.first_from_second if known < new else link.first_from_second.inverse()
        start[new] = start[known] * step
    if not others:
        return start
    chosen = [
        (a, b, _evenly(link.points)) for (a, b), link in links.items() if {a, b} <= set(group)
    ]
    pixel = models[base].pixel

    def transforms(values: Floats) -> dict[int, tuple[Floats, Floats]]:
        matrices = {base: (np.eye(3), np.zeros(3))}
        for number, row in zip(others, values.reshape(-1, 7), strict=True):
            turn = Rotation.from_rotvec(row[1:4]).as_matrix()
            matrices[number] = (np.exp(row[0]) * turn, row[4:] * pixel)
        return matrices

    def distances(values: Floats) -> Floats:
        placed = transforms(values)
        apart = []
        for a, b, rows in chosen:
            (turn_a, shift_a), (turn_b, shift_b) = placed[a], placed[b]
            there = models[a].xyz[rows[:, 0]] @ turn_a.T + shift_a
            here = models[b].xyz[rows[:, 1]] @ turn_b.T + shift_b
            apart.append((there - here).ravel() / pixel)
        return np.concatenate(apart)

    first = np.concatenate([_parameters(start[number], pixel) for number in others])
    found = least_squares(distances, first, loss="soft_l1", f_scale=ROBUST_PIXELS, x_scale="jac").x
    return {
        number: pycolmap.Sim3d(np.column_stack([turn, shift]))
        for number, (turn, shift) in transforms(found).items()
    }


def join_and_adjust(
    advance: Callable[[int], None],
    database: Path,
    images: Path | None,
    models: Sequence[tuple[str, Path]],
    folder: Path,
    options: MappingOptions,
) -> None:
    """Put models together, adjust, and write `folder`/0, 1, ... (in a worker).

    A model that joins no other is written as it is. What happened is in `folder`/merge.json.
    """
    read = {name: pycolmap.Reconstruction(path) for name, path in models}
    sub_models = [read_sub_model(name, model) for name, model in read.items()]
    with open_database(database) as opened:
        camera_of = {row.image_id: row.camera_id for row in opened.images()}
    for sub, model in zip(sub_models, read.values(), strict=True):
        sub.cameras = database_cameras(model, camera_of)
    joined = put_together(
        sub_models,
        matches_across(database, [set(model.reg_image_ids()) for model in read.values()]),
        options.seed,
    )
    advance(10)
    cache = load_cache(database)
    told = []
    for number, group in enumerate(joined):
        target = folder / str(number)
        target.mkdir()
        if len(group.members) == 1:
            read[group.members[0]].write(target)
        else:
            result = rebuild(group.model, cache)
            pipeline = pipeline_options(options, colors=False)
            refine(result, cache, pipeline, lambda share: None, triangulate=True)
            if images is not None:
                result.extract_colors_for_all_images(images)
            result.write(target)
        told.append({"members": group.members, "refused": group.refused})
    (folder / "merge.json").write_text(json.dumps(told), encoding="utf-8")


def database_cameras(
    model: pycolmap.Reconstruction, camera_of: Mapping[int, int]
) -> dict[int, tuple[Floats, int]]:
    """Return a model's intrinsics by the database's camera ids, and how many images have them.

    The ids in a model are those of the database it was made from, which may be another: databases
    that were put together have new ones.

    Args:
        camera_of: the database's camera of each image id.
    """
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    counts = Counter(camera_of[image.image_id] for image in images)
    own = {camera_of[image.image_id]: image.camera_id for image in images}
    return {
        camera_id: (np.array(model.camera(own[camera_id]).params), count)
        for camera_id, count in counts.items()
    }


def matches_across(database: Path, homes: Sequence[set[int]]) -> list[Matches]:
    """Return the verified matches between images that no one model has both of."""
    with open_database(database) as opened:
        return [
            (image1, image2, opened.inlier_matches(image1, image2))
            for (image1, image2), count in sorted(opened.verified_matches().items())
            if count and _across(image1, image2, homes)
        ]


def _across(image1: int, image2: int, homes: Sequence[set[int]]) -> bool:
    first = {number for number, home in enumerate(homes) if image1 in home}
    second = {number for number, home in enumerate(homes) if image2 in home}
    return bool(first and second and not first & second)


def _links(
    models: Sequence[SubModel], common: dict[tuple[int, int], Rows], seed: int
) -> tuple[dict[tuple[int, int], Link], dict[tuple[int, int], str]]:
    links, faults = {}, {}
    for (a, b), points in common.items():
        try:
            found = similarity(models[a], models[b], points, seed)
        except Refused as refusal:
            faults[a, b] = str(refusal)
            continue
        links[a, b] = Link(points[agreeing(models[a], models[b], points, found)], found)
    return links, faults


def _owners(model: SubModel, image: int, keypoints: NDArray[np.uint32]) -> Rows:
    """Return the row of the point that each keypoint observes, -1 where there is none."""
    keys = (np.int64(image) << 32) | keypoints.astype(np.int64)
    place = np.searchsorted(model.keys, keys)
    place[place == len(model.keys)] = 0
    if not len(model.keys):
        return np.full(len(keys), -1)
    return np.where(model.keys[place] == keys, model.owner[place], -1)


def _mutual(rows: Rows) -> Rows:
    """Return each point once, in the pair with the most votes among its own."""
    unique, counts = np.unique(rows, axis=0, return_counts=True)
    unique = unique[np.lexsort((unique[:, 1], unique[:, 0], -counts))]
    _, first = np.unique(unique[:, 0], return_index=True)
    kept = unique[np.sort(first)]
    _, once = np.unique(kept[:, 1], return_index=True)
    return kept[np.sort(once)]


def _evenly(rows: Rows) -> Rows:
    return rows[:: max(1, len(rows) // SOLVED_POINTS)]


def _parameters(similarity: pycolmap.Sim3d, pixel: float) -> Floats:
    turn = Rotation.from_matrix(similarity.rotation.matrix()).as_rotvec()
    return np.concatenate(
        [[np.log(np.asarray(similarity.scale).item())], turn, similarity.translation / pixel]
    )


def _union(
    models: Sequence[SubModel],
    links: dict[tuple[int, int], Link],
    placed: dict[int, pycolmap.Sim3d],
) -> SubModel:
    """Return the models of a group as one: points that agree become one, with all their tracks."""
    group = list(placed)
    base = models[group[0]]
    if len(group) == 1:
        return base
    group.sort()
    offset = dict(zip(group, np.cumsum([0, *(len(models[i].xyz) for i in group)]), strict=False))
    xyz = np.concatenate([move(placed[i], models[i].xyz) for i in group])
    color = np.concatenate([models[i].color for i in group])
    same = [
        np.stack([link.points[:, 0] + offset[a], link.points[:, 1] + offset[b]], axis=1)
        for (a, b), link in links.items()
        if a in placed and b in placed
    ]
    i, j = np.concatenate(same).T
    graph = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(len(xyz), len(xyz)))
    count, label = connected_components(graph, directed=False)
    members = np.bincount(label, minlength=count)
    middle = np.column_stack(
        [np.bincount(label, xyz[:, axis], minlength=count) / members for axis in range(3)]
    )
    _, first = np.unique(label, return_index=True)
    keys = np.concatenate([models[i].keys for i in group])
    owner = label[np.concatenate([models[i].owner + offset[i] for i in group])]
    # The larger model goes first, both for an observation and for a photo that sees a point twice.
    _, once = np.unique(keys, return_index=True)
    once.sort()
    keys, owner = keys[once], owner[once]
    once = seen_once(keys, owner)
    keys, owner = keys[once], owner[once]
    kept = np.bincount(owner, minlength=count) >= 2
    held = kept[owner]
    keys, owner = keys[held], (np.cumsum(kept) - 1)[owner[held]]
    order = np.argsort(keys)
    poses: dict[int, pycolmap.Rigid3d] = {}
    cameras = models[group[0]].cameras
    rigs: dict[int, pycolmap.Rig] = {}
    for number in group:
        model = models[number]
        moved = {i: placed[number].transform_camera_world(pose) for i, pose in model.poses.items()}
        poses = moved | poses
        rigs = model.rigs | rigs
        if number != group[0]:
            cameras = join_cameras(cameras, model.cameras)
    return SubModel(
        base.name,
        poses=poses,
        cameras=cameras,
        rigs=rigs,
        xyz=middle[kept],
        color=color[first][kept],
        keys=keys[order],
        owner=owner[order],
        pixel=base.pixel,
    )
