"""Retrieval methods and checkpoints measured on annotated scenes, beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.flight import open_flight
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import scratch_folder
from colmap_netvlad.training.scenes import Scene
from colmap_netvlad.training.validate import Score, mean_score, score


@dataclass(frozen=True)
class Measured:
    """A method on all scenes.

    Attributes:
        method: a name of the table of methods, or a checkpoint.
        scores: by scene.
        seconds_per_photo: description and search of all scenes, by their photos.
    """

    method: str
    scores: dict[str, Score]
    seconds_per_photo: float

    @property
    def mean(self) -> Score:
        """The mean over scenes."""
        return mean_score(list(self.scores.values()))


def evaluate(
    methods: Sequence[str],
    scenes: Sequence[Scene],
    databases: Path,
    options: RetrievalOptions | None = None,
) -> list[Measured]:
    """Measure methods on scenes whose pairs were matched exhaustively.

    Args:
        methods: names of the table of methods, or paths of checkpoints.
        scenes: annotated scenes; each with `<databases>/<scene>.db`, whose features are copied
            without matches, so that no method sees the truth.

    Raises:
        InputError: a scene was not matched exhaustively, its database is not there, or a method
            cannot run.
    """
    for scene in scenes:
        if scene.method != "exhaustive":
            raise InputError(
                f"Scene {scene.name} was matched on {scene.method} pairs only, so its correct "
                "pairs are not all known; annotate it from an exhaustively matched database."
            )
    scores: dict[str, dict[str, Score]] = {method: {} for method in methods}
    seconds = dict.fromkeys(methods, 0.0)
    for scene in scenes:
        with scratch_folder() as folder:
            database = folder / "project.db"
            copy_database(databases / f"{scene.name}.db", database, matches=False)
            full = replace(options or RetrievalOptions(), k=len(scene) - 1)
            with open_flight(Project(database, scene.images)) as flight:
                for method in methods:
                    ranking = rank(flight, method, full)
                    scores[method][scene.name] = score(ranking, scene)
                    seconds[method] += ranking.seconds_describe + ranking.seconds_search
    photos = sum(len(scene) for scene in scenes)
    return [Measured(method, scores[method], seconds[method] / photos) for method in methods]


def markdown(measured: Sequence[Measured]) -> str:
    """Return the figures as a Markdown table: mAP / accuracy at 10 / at 20, %."""
    scenes = list(measured[0].scores)
    lines = [
        f"| method | {' | '.join(scenes)} | mean | s a photo |",
        f"|---|{'---|' * len(scenes)}---|---|",
    ]
    for one in measured:
        cells = [_cell(one.scores[scene]) for scene in scenes]
        name = Path(one.method).stem
        lines.append(
            f"| {name} | {' | '.join(cells)} | {_cell(one.mean)} | {one.seconds_per_photo:.3f} |"
        )
    return "\n".join(lines) + "\n"


def _cell(figures: Score) -> str:
    return (
        f"{100 * figures.mean_average_precision:.1f} / {100 * figures.accuracy10:.1f} / "
        f"{100 * figures.accuracy20:.1f}"
    )
