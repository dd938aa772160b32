"""Methods measured on annotated scenes."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from pathlib import Path

import pytest

from colmap_netvlad.commands.annotate import AnnotateOptions, annotate
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training.evaluate import evaluate, markdown
from colmap_netvlad.training.scenes import Scene


@pytest.fixture
def scene_and_databases(
    flight: RenderedFlight, matched_database: Path, tmp_path: Path
) -> tuple[Scene, Path]:
    databases = tmp_path / "databases"
    databases.mkdir()
    shutil.copy(matched_database, databases / f"{flight.images.parent.name}.db")
    options = AnnotateOptions(output=tmp_path / "out", databases=databases, mapper="none")
    (scene,) = annotate([flight.images.parent], options).scenes
    return scene, databases


def test_methods_are_measured_without_seeing_the_truth(
    scene_and_databases: tuple[Scene, Path],
) -> None:
    scene, databases = scene_and_databases
    path = databases / f"{scene.name}.db"
    before = hashlib.sha256(path.read_bytes()).digest()
    measured = evaluate(["random", "vlad"], [scene], databases)
    assert hashlib.sha256(path.read_bytes()).digest() == before
    by_chance, vlad = (one.mean for one in measured)
    assert 0 < by_chance.mean_average_precision < vlad.mean_average_precision <= 1
    # With k = 20 every pair of 12 photos is retrieved: the share of correct ones among all.
    share = len(scene.correct_pairs()) / (12 * 11 / 2)
    assert by_chance.accuracy20 == pytest.approx(share) == pytest.approx(vlad.accuracy20)
    lines = markdown(measured).splitlines()
    assert len(lines) == 4 and lines[3].startswith("| vlad |")


def test_scenes_without_all_truth_are_refused(scene_and_databases: tuple[Scene, Path]) -> None:
    scene, databases = scene_and_databases
    with pytest.raises(InputError, match="not all known"):
        evaluate(["random"], [dataclasses.replace(scene, method="bow")], databases)
    with pytest.raises(InputError, match="no_such"):
        evaluate(["no_such"], [scene], databases)
    (databases / f"{scene.name}.db").unlink()
    with pytest.raises(InputError, match="does not exist"):
        evaluate(["random"], [scene], databases)
