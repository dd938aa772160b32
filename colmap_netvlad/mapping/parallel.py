"""Parallel SfM (section 2.2 of the paper): cut, reconstruct clusters at once, merge, adjust.

Every cluster is mapped in a process of its own from a small database of its own. Finished
clusters are kept in a folder beside the output until the model is written, so a killed run goes
on where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import copy_images
from colmap_netvlad.graph.viewgraph import ViewGraph, read_view_graph
from colmap_netvlad.mapping.merge import merge, read_sub_model
from colmap_netvlad.mapping.options import MappingOptions, pipeline_options
from colmap_netvlad.mapping.output import Finish, as_mapped, largest_first, model_folder, numbered
from colmap_netvlad.mapping.partition import Cluster, partition
from colmap_netvlad.mapping.priors import with_priors, write_priors
from colmap_netvlad.mapping.refine import load_cache, rebuild, refine
from colmap_netvlad.mapping.settle import settle_model
from colmap_netvlad.runtime import progress, workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import claimed, write_atomically
from colmap_netvlad.runtime.jobs import Load, Source

logger = logging.getLogger(__name__)

CLUSTER_IMAGES = 250
"""Default size of a cluster before it is expanded (measured, see docs/parallel-sfm.md)."""

MIN_CLUSTER_MODEL = 3
"""Smaller models of a cluster do not help to merge."""

CLUSTER_GROWTH = 1.3
"""A cluster is adjusted globally each time its images or points have grown by this factor (alone
COLMAP does so at 1.1), with at most two rounds: the merged model is adjusted anyway. It saves
about a third of a cluster's time and changes its reprojection error by less than 0.1 %."""

WORKER_BYTES = 200 * 2**20
"""Memory of a worker before it loads anything: Python and pycolmap."""

BYTES_PER_DATABASE_BYTE = 4.0
"""Memory of a worker for each byte of its cluster's share of the database: twice what was
measured on real photos (96 MiB for 52 MiB)."""

MEMORY_SHARE = 0.7
"""Share of the machine's memory that workers may take when no limit is given."""


@dataclass
class ClusterReport:
    """How one cluster went.

    Attributes:
        images: images in the cluster, shared ones included.
        models: images registered in each of its models.
        fault: why it failed, or None.
    """

    images: int
    models: list[int] = field(default_factory=list)
    fault: str | None = None


@dataclass
class ParallelReport:
    """What parallel SfM did beside the models.

    Attributes:
        clusters: one report a cluster, in the partition's order.
        reused: clusters that an earlier, stopped run had finished.
        members: for each model, the sub-models it was merged from.
        refused: sub-models that share points with a larger one but do not fit, with the reason.
        joined_later: images that no merged sub-model had, registered afterwards.
        peak_bytes: the most memory any worker held.
    """

    clusters: list[ClusterReport]
    reused: int = 0
    members: list[list[str]] = field(default_factory=list)
    refused: list[tuple[str, str]] = field(default_factory=list)
    joined_later: int = 0
    peak_bytes: int = 0


def map_parallel(
    database: Path,
    images: Path | None,
    output: Path,
    options: MappingOptions = MappingOptions(),
    finish: Finish = as_mapped,
) -> list[pycolmap.Reconstruction]:
    """Reconstruct a large flight in clusters and write `output`/0, 1, ...

    What was left out (failed clusters, refused sub-models) is logged;
    `reconstruct_parallel` returns it.

    Args:
        database: COLMAP database with verified matches; it is not changed.
        images: photo folder, for the colours of points; None leaves them black.
        output: folder of the models; it appears whole, or not at all on a fault or Ctrl-C.
        options: seed, threads, size of a cluster, memory.
        finish: is called with the folder of the models before it gets its name.

    Returns:
        The models, largest first; empty where nothing could be reconstructed.

    Raises:
        InputError: `output` holds something already, another run is at work on it, or no cluster
            could be reconstructed because all of them failed.
    """
    models, report = reconstruct_parallel(database, images, output, options, finish)
    for line in report_lines(report):
        logger.warning(line)
    return models


def reconstruct_parallel(
    database: Path,
    images: Path | None,
    output: Path,
    options: MappingOptions = MappingOptions(),
    finish: Finish = as_mapped,
) -> tuple[list[pycolmap.Reconstruction], ParallelReport]:
    """Reconstruct in clusters (see `map_parallel`) and return models and report."""
    with model_folder(output) as folder, claimed(_state(output)) as alone:
        if not alone:
            raise InputError(
                f"Another run maps clusters for {output}, which would be mixed up: wait for it, or "
                "name another `output`."
            )
        graph = read_view_graph(database)
        clusters = partition(graph, options.cluster_size or CLUSTER_IMAGES)
        state = open_state(output, graph, clusters, options)
        report = map_clusters(database, clusters, state, options)
        merge_clusters(database, images, state, folder, options, report)
        models = largest_first(folder)
        finish(folder)
    forget_clusters(output)
    return models, report


def forget_clusters(output: Path) -> None:
    """Remove the finished clusters of models that are written."""
    with claimed(_state(output)):  # takes away the claim of a killed run
        shutil.rmtree(_state(output), ignore_errors=True)


def report_lines(report: ParallelReport) -> list[str]:
    """Return one line for everything that did not go to plan."""
    lines = [
        f"Cluster {number} ({cluster.images} images) failed: {cluster.fault}. "
        "Its images are registered into the model where they can be."
        for number, cluster in enumerate(report.clusters)
        if cluster.fault
    ]
    lines += [
        f"Sub-model {name} was not merged: {reason}. "
        "Its images are registered into the model where they can be."
        for name, reason in report.refused
    ]
    return lines


def open_state(
    output: Path, graph: ViewGraph, clusters: Sequence[Cluster], options: MappingOptions
) -> Path:
    """Return the folder of finished clusters, emptied if it belongs to other input.

    It lies beside `output` and holds a fingerprint of the view graph, the clusters and what the
    clusters' mappers are told.
    """
    state = _state(output)
    digest = hashlib.sha256()
    told = {
        "seed": options.seed,
        "max_models": options.max_models,
        "priors": options.priors and options.priors.fingerprint(),
    }
    digest.update(json.dumps([graph.names, told, pycolmap.__version__]).encode())
    digest.update(json.dumps([cluster.images for cluster in clusters]).encode())
    for array in (graph.edges, graph.inliers, graph.weights):
        digest.update(array.tobytes())
    mark = state / "fingerprint"
    if not (mark.is_file() and mark.read_text() == digest.hexdigest()):
        shutil.rmtree(state, ignore_errors=True)
        write_atomically(mark, digest.hexdigest())
    for stray in state.glob("*.part"):
        shutil.rmtree(stray, ignore_errors=True)
    return state


def map_clusters(
    database: Path, clusters: Sequence[Cluster], state: Path, options: MappingOptions
) -> ParallelReport:
    """Map clusters that are not finished yet, several at once.

    Each finished cluster is the folder `state`/<number> with models 0, 1, ... A cluster that
    fails leaves none and is reported; the others go on.

    Raises:
        InputError: all of them failed.
    """
    report = ParallelReport([ClusterReport(len(cluster.images)) for cluster in clusters])
    todo = [number for number in range(len(clusters)) if not (state / str(number)).is_dir()]
    report.reused = len(clusters) - len(todo)
    parts = {number: Path(tempfile.mkdtemp(suffix=".part", dir=state)) for number in todo}
    largest = max((len(clusters[number].images) for number in todo), default=0)
    count = worker_count(database, largest, len(todo), options)
    there = workers.capacity()
    threads = max(1, min(there.largest, (options.threads or there.processors) // max(count, 1)))
    jobs = [
        workers.Job(
            map_cluster,
            (clusters[number].images, options, threads),
            Source(database, part_of_cluster),
            parts[number],
            Load(threads, worker_bytes(database, largest)),
        )
        for number in todo
    ]

    def finished(job: int, outcome: workers.Outcome) -> None:
        number = todo[job]
        report.clusters[number].fault = outcome.fault
        report.peak_bytes = max(report.peak_bytes, outcome.peak_bytes)
        if outcome.fault is None:
            parts[number].rename(state / str(number))

    total = sum(len(cluster.images) for cluster in clusters)
    try:
        with progress.step(f"Mapping {len(clusters)} clusters", total) as bar:
            bar.advance(total - sum(len(clusters[number].images) for number in todo))
            workers.run(jobs, count, bar.advance, finished, engine.initialiser())
    finally:
        for part in parts.values():
            shutil.rmtree(part, ignore_errors=True)
    faults = [cluster.fault for cluster in report.clusters if cluster.fault]
    if faults and len(faults) == len(clusters):
        raise InputError(f"None of the {len(clusters)} clusters could be mapped: {faults[0]}.")
    return report


def part_of_cluster(database: Path, arguments: Sequence[Any], target: Path) -> None:
    """Write what `map_cluster` reads of a database."""
    copy_images(database, target, arguments[0])


def map_cluster(
    advance: Callable[[int], None],
    database: Path,
    folder: Path,
    names: Sequence[str],
    options: MappingOptions,
    threads: int,
) -> None:
    """Map one cluster into `folder`/0, 1, ... (in a worker)."""
    subset = folder / "cluster.db"
    copy_images(database, subset, names)
    if options.priors is not None:
        write_priors(subset, options.priors)
    pipeline = pipeline_options(options, colors=False)
    pipeline.min_model_size = MIN_CLUSTER_MODEL
    pipeline.ba_global_frames_ratio = pipeline.ba_global_points_ratio = CLUSTER_GROWTH
    pipeline.ba_global_max_refinements = 2
    pipeline.num_threads = pipeline.mapper.num_threads = threads
    pycolmap.incremental_mapping(
        subset,
        folder,  # photos are not read, but the folder has to exist
        folder,
        options=pipeline,
        initial_image_pair_callback=lambda: advance(2),
        next_image_callback=lambda: advance(1),
    )
    subset.unlink()


def merge_clusters(
    database: Path,
    images: Path | None,
    state: Path,
    folder: Path,
    options: MappingOptions,
    report: ParallelReport,
) -> None:
    """Merge the clusters in `state` into models `folder`/0, 1, ... and complete `report`.

    It runs in a worker too, so that Ctrl-C ends a long bundle adjustment at once.

    Raises:
        InputError: the worker failed.
    """
    finished = {path: numbered(path) for path in numbered(state)}
    for path, models in finished.items():
        report.clusters[int(path.name)].models = [_registered(model) for model in models]
    with progress.step("Merging and adjusting (%)", 100) as bar:
        job = workers.Job(
            merge_models,
            (
                database,
                images,
                [m for models in finished.values() for m in models],
                folder,
                options,
            ),
        )
        (outcome,) = workers.run([job], 1, bar.advance, initialiser=engine.initialiser())
    report.peak_bytes = max(report.peak_bytes, outcome.peak_bytes)
    if outcome.fault is not None:
        raise InputError(
            f"The {len(finished)} clusters were mapped, but merging them failed: {outcome.fault}. "
            "Run the command again: finished clusters are kept."
        )
    note = folder / "merge.json"
    told = json.loads(note.read_text(encoding="utf-8"))
    note.unlink()
    report.members = told["members"]
    report.refused = [(name, reason) for name, reason in told["refused"]]
    report.joined_later = told["joined_later"]


def merge_models(
    advance: Callable[[int], None],
    database: Path,
    images: Path | None,
    models: Sequence[Path],
    folder: Path,
    options: MappingOptions,
) -> None:
    """Merge models of clusters, adjust, and write `folder`/0, 1, ... (in a worker).

    A model of which the larger ones have nearly all images (fewer than `min_model_size` are its
    own) is left out. What happened is written to `folder`/merge.json.
    """
    sub_models = [
        read_sub_model(f"{path.parent.name}/{path.name}", pycolmap.Reconstruction(path))
        for path in models
    ]
    merged = merge(sub_models, options.seed)
    with with_priors(database, options.priors, folder) as source:
        cache = load_cache(source)
    pipeline = pipeline_options(options, colors=False)
    have: set[int] = set()
    told_percent = 0

    def reached(share: float) -> None:
        nonlocal told_percent
        advance(max(0, round(100 * share) - told_percent))
        told_percent = max(told_percent, round(100 * share))

    reached(0.05)
    members: list[list[str]] = []
    refused: list[tuple[str, str]] = []
    joined_later = 0
    least = options.least_images(cache.num_images())
    for group in sorted(merged, key=lambda group: -len(group.model.poses)):
        refused += group.refused
        if len(group.model.poses.keys() - have) < least:
            continue
        reconstruction = rebuild(group.model, cache)
        refine(reconstruction, cache, pipeline, reached)
        registered = set(reconstruction.reg_image_ids())
        if len(registered - have) < least:
            continue
        joined_later += len(registered - group.model.poses.keys())
        have |= registered
        if images is not None:
            reconstruction.extract_colors_for_all_images(images)
        settle_model(reconstruction, cache, options)
        target = folder / str(len(members))
        target.mkdir()
        reconstruction.write(target)
        members.append(group.members)
    told = {"members": members, "refused": refused, "joined_later": joined_later}
    (folder / "merge.json").write_text(json.dumps(told), encoding="utf-8")


def worker_count(database: Path, largest: int, jobs: int, options: MappingOptions) -> int:
    """Return how many clusters are mapped at once within the processors and the memory.

    Args:
        largest: images of the largest cluster.
    """
    there = workers.capacity()
    processors = options.threads or there.processors
    memory = options.memory or MEMORY_SHARE * there.memory
    return max(1, min(processors, jobs, math.floor(memory / worker_bytes(database, largest))))


def worker_bytes(database: Path, images: int) -> float:
    """Return the memory that mapping a cluster of so many images takes, estimated from their
    share of the database."""
    share = images / max(1, _image_count(database))
    return WORKER_BYTES + BYTES_PER_DATABASE_BYTE * share * database.stat().st_size


def _image_count(database: Path) -> int:
    from colmap_netvlad.colmap.database import open_database

    with open_database(database) as opened:
        return len(opened.images())


def _state(output: Path) -> Path:
    return output.parent / f".{output.name}.clusters"


def _registered(model: Path) -> int:
    return int(pycolmap.Reconstruction(model).num_reg_images())
