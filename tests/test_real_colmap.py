"""COLMAP's own program at both ends: its database goes in, our pairs and models come out.

Run with whatever `colmap` is on PATH (measured: Debian's 3.8, `apt-get install colmap`).

What "agree" means on the rendered flight: every photo registered by both, every camera centre of
both within 1 % of the flight's extent of the truth, mean reprojection errors within 5 % and
numbers of points within 20 % of each other. (Measured: 0.341 and 0.342 px, 948 and 1,000 points.
The two differ in matcher, verification and mapper, all of them estimated from random samples.)
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pycolmap
import pytest
from click.testing import CliRunner
from conftest import make_once
from test_pairs_command import sha256

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.demo.check import check_against_truth
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.project import Project

ERRORS_AGREE = 0.05
POINTS_AGREE = 0.20

needs_colmap = pytest.mark.skipif(
    shutil.which("colmap") is None,
    reason="COLMAP is not on PATH (apt-get install colmap): nothing is held against it",
)


def colmap(command: str, **options: object) -> str:
    """Run a command of COLMAP on the CPU, and return all that it prints."""
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    # Without a screen Qt ends the program, also where it draws nothing.
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}

    def run(*arguments: str) -> str:
        done = subprocess.run(
            ["colmap", command, *arguments], capture_output=True, text=True, env=environment
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    # `SiftExtraction.use_gpu` in 3.8, `FeatureExtraction.use_gpu` in newer ones.
    gpu = re.search(r"--\w+\.use_gpu", run("--help") if words else "")
    return run(*words, *([gpu[0], "0"] if gpu else []))


def ours(*arguments: object) -> str:
    """Run `colmap-netvlad`, and return what it prints."""
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


@dataclass(frozen=True)
class Analysis:
    """What `colmap model_analyzer` says of a model."""

    registered: int
    points: int
    observations: int
    error: float


def analyze(model: Path) -> Analysis:
    """Let COLMAP read a model."""
    text = colmap("model_analyzer", path=model)

    def figure(name: str) -> str:
        found = re.search(rf"{name}: ([\d.]+)", text)
        assert found, text
        return found[1]

    return Analysis(
        int(figure("Registered images")),
        int(figure("Points")),
        int(figure("Observations")),
        float(figure("Mean reprojection error")),
    )


def colmap_model(project: Project, pairs: Path, folder: Path) -> Path:
    """Match a pairs list in the project's database and map it, all with COLMAP's program."""
    folder.mkdir()
    colmap(
        "matches_importer",
        database_path=project.database,
        match_list_path=pairs,
        match_type="pairs",
    )
    colmap(
        "mapper",
        database_path=project.database,
        image_path=project.images,
        output_path=folder,
    )
    assert [path.name for path in folder.iterdir()] == ["0"]
    return folder / "0"


def matched_names(path: Path) -> set[frozenset[str]]:
    """The names of the image pairs that a database has matches of."""
    with open_database(path) as database:
        names = {image.image_id: image.name for image in database.images()}
        return {frozenset((names[a], names[b])) for a, b in database.matched_pairs()}


def assert_whole_and_true(model: Path, flight: RenderedFlight) -> None:
    check = check_against_truth([pycolmap.Reconstruction(model)], flight)
    assert check.passed, f"{check.registered} registered, off by {check.largest:.2%}"


@pytest.fixture
def extracted(flight: RenderedFlight, shared_folder: Path, tmp_path: Path) -> Project:
    """A project of the test's own whose features COLMAP's program extracted."""

    def make(folder: Path) -> None:
        folder.mkdir()
        colmap(
            "feature_extractor",
            database_path=folder / "project.db",
            image_path=flight.images,
            **{"ImageReader.single_camera": 1, "SiftExtraction.max_num_features": 1500},
        )

    made = make_once(shared_folder / "colmap", make)
    project = Project(tmp_path / "colmap" / "project.db", flight.images)
    shutil.copytree(made, project.folder)
    return project


@needs_colmap
def test_ours_and_colmaps_models_of_colmaps_features_agree(
    extracted: Project, flight: RenderedFlight, tmp_path: Path
) -> None:
    before = sha256(extracted.database)
    ours("pairs", "--db", extracted.database, "--images", extracted.images, "--k", 6)
    ours("match", "--db", extracted.database, "--copy")
    printed = ours("reconstruct", "--db", extracted.database, "--copy")
    assert sha256(extracted.database) == before  # COLMAP's database is still COLMAP's

    our_model = extracted.sparse / "0"
    read, known = analyze(our_model), pycolmap.Reconstruction(our_model)
    assert read.registered == len(flight.names)
    assert read.points == known.num_points3D()
    assert read.observations == known.compute_num_observations()
    assert read.error == pytest.approx(known.compute_mean_reprojection_error(), abs=1e-5)
    assert f"{read.error:.3f}" in printed

    their_model = colmap_model(extracted, extracted.pairs, tmp_path / "theirs")
    assert matched_names(extracted.database) == {
        frozenset(pair) for pair in read_pairs(extracted.pairs, image_names(extracted.database))
    }
    theirs = analyze(their_model)
    assert theirs.registered == read.registered
    assert theirs.error == pytest.approx(read.error, rel=ERRORS_AGREE)
    assert theirs.points == pytest.approx(read.points, rel=POINTS_AGREE)
    for model in (our_model, their_model):
        assert_whole_and_true(model, flight)


@needs_colmap
def test_colmap_4_works_on_in_a_database_that_we_made_and_older_ones_refuse_it(
    project_copy: Callable[..., Project], flight: RenderedFlight, tmp_path: Path
) -> None:
    """README says so: with COLMAP 3 let its own `feature_extractor` make the database.

    (Measured: 3.8, 3.10 to 3.13 refuse it, `SQL logic error`; 4.0 and 4.1 open it.)
    """
    project = project_copy()
    ours("pairs", "--db", project.database, "--k", 6)
    found = re.search(r"COLMAP (\d+)\.", colmap("help"))
    assert found
    if int(found[1]) >= 4:
        model = colmap_model(project, project.pairs, tmp_path / "theirs")
        assert_whole_and_true(model, flight)
    else:
        with pytest.raises(AssertionError, match="SQL"):
            colmap_model(project, project.pairs, tmp_path / "theirs")


# hloc's pairs: a name, a space, a name; a query has one line for each of its neighbours.


def write_as_hloc(path: Path, pairs: list[tuple[str, str]]) -> None:
    """Write as hloc's `pairs_from_retrieval`: no end of line after the last pair."""
    path.write_text("\n".join(" ".join(pair) for pair in pairs))


def read_as_hloc(path: Path) -> dict[str, list[str]]:
    """Read as hloc's `parsers.parse_retrieval`: neighbours by query."""
    found: dict[str, list[str]] = {}
    for line in path.read_text().rstrip("\n").split("\n"):
        if line:
            query, neighbour = line.split()
            found.setdefault(query, []).append(neighbour)
    return found


def test_hloc_reads_our_pairs(project_copy: Callable[..., Project]) -> None:
    project = project_copy()
    ours("pairs", "--db", project.database, "--k", 3)
    read = [(a, b) for a, neighbours in read_as_hloc(project.pairs).items() for b in neighbours]
    assert read == read_pairs(project.pairs, image_names(project.database))
    assert len(read) >= len(image_names(project.database)) * 3 / 2


def test_pairs_of_hloc_are_matched(project_copy: Callable[..., Project]) -> None:
    project = project_copy()
    names = image_names(project.database)
    # Each photo's neighbour, in both orders as retrieval finds them.
    listed = [p for a, b in pairwise(names) for p in ((a, b), (b, a))]
    write_as_hloc(project.pairs, listed)
    printed = ours("match", "--db", project.database)
    assert f"Pairs: {len(names) - 1} (0 matched before, {len(names) - 1} now)" in printed
