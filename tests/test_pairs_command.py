"""`colmap-netvlad pairs`, as a user runs it."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st
from schemas import VERSIONS, add_images, make_database

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.pairs.union import union_of_top
from colmap_netvlad.project import Project, open_project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import EXIT_PARTIAL

MakeProject = Callable[..., Project]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["pairs", *map(str, arguments)])


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def colmap_list(path: Path) -> list[tuple[str, str]]:
    return [tuple(line.split(" ")) for line in path.read_text().splitlines()]  # type: ignore[misc]


def write_photos(folder: Path, names: list[str]) -> None:
    generator = np.random.default_rng(0)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = generator.integers(0, 255, (48, 64, 3)).astype(np.uint8)
        encoded = cv2.imencode(Path(name).suffix, pixels)[1]
        (folder / name).write_bytes(encoded.tobytes())


def test_pairs_prints_what_it_did_and_the_next_command(project_copy: MakeProject) -> None:
    project = project_copy()
    result = run("--db", project.database, "--k", 4, "--method", "vlad")
    assert result.exit_code == 0, result.output
    for words in ("Images       12", "Pairs", "Description", "Search", "Components   1"):
        assert words in result.output
    assert f"colmap-netvlad reconstruct --db {project.database}" in result.output
    pairs = colmap_list(project.pairs)
    names = image_names(project.database)
    assert {name for pair in pairs for name in pair} == set(names)
    assert len({frozenset(pair) for pair in pairs}) == len(pairs)
    assert pairs == sorted(pairs, key=lambda pair: tuple(map(names.index, pair)))
    for name in names:
        assert sum(name in pair for pair in pairs) >= 4


@pytest.mark.parametrize("method", ["vlad", "bow", "random"])
def test_pairs_leaves_a_3x_database_byte_identical(
    method: str, legacy_database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_netvlad.retrieval.methods.bow.MOST_WORDS", 32)
    before = sha256(legacy_database)
    result = run("--db", legacy_database, "--k", 3, "--method", method)
    assert result.exit_code == 0, result.output
    assert sha256(legacy_database) == before
    beside = {path.name for path in legacy_database.parent.iterdir()}
    assert not {"project.db-wal", "project.db-shm", "project.db-journal"} & beside


@pytest.mark.parametrize("version", VERSIONS)
def test_databases_of_every_version_are_served(
    version: str, tmp_path: Path, tiny_checkpoint: Path
) -> None:
    database = tmp_path / "database.db"
    names = [f"{i}.png" for i in range(4)]
    make_database(database, version)
    add_images(database, names)
    write_photos(tmp_path / "images", names)
    before = sha256(database)
    result = run("--db", database, "--k", 2, "--model", tiny_checkpoint)
    assert result.exit_code == 0, result.output
    assert sha256(database) == before


def test_the_second_run_computes_nothing_and_says_so(
    project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    arguments = ("--db", project.database, "--k", 3, "--model", tiny_checkpoint)
    assert "12 of 12 descriptors computed" in run(*arguments).output
    first = project.pairs.read_bytes()
    assert "0 of 12 descriptors computed" in run(*arguments).output
    assert project.pairs.read_bytes() == first


def test_the_second_run_does_not_even_load_pytorch(
    project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    arguments = ["pairs", "--db", str(project.database), "--model", str(tiny_checkpoint)]
    assert CliRunner().invoke(cli, arguments).exit_code == 0
    code = (
        "import sys\n"
        "from colmap_netvlad.cli import cli\n"
        f"cli({arguments!r}, standalone_mode=False)\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_the_photo_folder_is_remembered(
    project_copy: MakeProject, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    project = project_copy()
    assert project.images is not None
    elsewhere = tmp_path / "photos elsewhere"
    project.images.rename(elsewhere)
    arguments = ("--db", project.database, "--k", 3, "--model", tiny_checkpoint)
    refused = run(*arguments)
    assert refused.exit_code == 1
    assert "--images" in refused.output
    assert run(*arguments, "--images", elsewhere).exit_code == 0
    assert run(*arguments).exit_code == 0


def test_a_workspace_moved_as_a_whole_still_finds_its_photos(
    project_copy: MakeProject, tmp_path: Path
) -> None:
    project = project_copy()
    assert project.images is not None
    inside = project.folder / "DCIM"
    project.images.rename(inside)
    assert run("--db", project.database, "--images", inside, "--method", "random").exit_code == 0
    project.folder.rename(tmp_path / "moved")
    found = open_project(tmp_path / "moved" / "project.db")
    assert found.images is not None
    assert found.images.resolve() == (tmp_path / "moved" / "DCIM").resolve()


def test_bad_photos_are_listed_at_the_end_and_the_exit_code_says_so(
    project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy(copy_photos=True)
    assert project.images is not None
    bad = image_names(project.database)[3]
    (project.images / bad).write_bytes(b"")
    result = run("--db", project.database, "--k", 3, "--model", tiny_checkpoint)
    assert result.exit_code == EXIT_PARTIAL
    assert f"Left out: {bad} is empty" in result.output
    assert bad not in {name for pair in colmap_list(project.pairs) for name in pair}


def test_a_photo_that_features_alone_rank_is_listed_too(
    project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy(copy_photos=True)
    bad = image_names(project.database)[3]
    (project.need_images() / bad).unlink()
    arguments = ("--db", project.database, "--k", 3, "--method", "hybrid")
    result = run(*arguments, "--model", tiny_checkpoint)
    assert result.exit_code == EXIT_PARTIAL
    assert f"Ranked without the photo: {bad} is missing" in result.stderr
    assert bad in {name for pair in colmap_list(project.pairs) for name in pair}


def test_every_kind_of_pixels_is_described(tmp_path: Path, tiny_checkpoint: Path) -> None:
    generator = np.random.default_rng(0)
    shapes = {
        "grey.png": ((48, 64), np.uint8),
        "rgba.png": ((48, 64, 4), np.uint8),
        "deep.png": ((48, 64, 3), np.uint16),
        "colour.jpg": ((48, 64, 3), np.uint8),
        "upright.jpg": ((64, 48, 3), np.uint8),
    }
    (tmp_path / "images").mkdir()
    for name, (shape, kind) in shapes.items():
        pixels = generator.integers(0, np.iinfo(kind).max, shape).astype(kind)
        cv2.imwrite(str(tmp_path / "images" / name), pixels)
    make_database(tmp_path / "project.db", "4.2")
    add_images(tmp_path / "project.db", list(shapes))
    result = run("--db", tmp_path / "project.db", "--k", 2, "--model", tiny_checkpoint)
    assert result.exit_code == 0, result.output
    assert "5 of 5 descriptors computed" in result.output


def test_odd_names_are_complete_in_csv_and_said(tmp_path: Path, tiny_checkpoint: Path) -> None:
    names = ["a/1.png", "b/1.png", "DJI 1.png", "#2.png", "Übersicht.png", "航拍.png"]
    write_photos(tmp_path / "images", names)
    make_database(tmp_path / "project.db", "4.2")
    add_images(tmp_path / "project.db", names)
    result = run("--db", tmp_path / "project.db", "--k", 9, "--model", tiny_checkpoint)
    assert result.exit_code == 0, result.output
    assert "lacks the pairs of 2 images" in result.output
    assert "--pairs" in result.output
    plain = colmap_list(tmp_path / "pairs.txt")
    assert len(plain) == 4 * 3 / 2
    with (tmp_path / "pairs.csv").open(encoding="utf-8", newline="") as file:
        rows = [(row["name1"], row["name2"]) for row in csv.DictReader(file)]
    assert len(rows) == 6 * 5 / 2
    assert {name for pair in rows for name in pair} == set(names)


def test_json_holds_scores_and_ranks(project_copy: MakeProject, tmp_path: Path) -> None:
    project = project_copy()
    output = tmp_path / "lists" / "pairs.json"
    result = run(
        "--db", project.database, "--k", 3, "--method", "vlad", "--format", "json",
        "--output", output,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    rows = json.loads(output.read_text())
    assert all(1 <= row["rank"] <= 3 and -1 <= row["score"] <= 1.001 for row in rows)
    ranking = rank_project(project, "vlad", RetrievalOptions(k=3))
    assert len(union_of_top(ranking, 3)) == len(rows)


@pytest.fixture
def two_places(tmp_path: Path) -> Path:
    """A database of two groups of three images, a hundred metres apart."""
    database = tmp_path / "project.db"
    names = [f"{i}.png" for i in range(6)]
    make_database(database, "3.9")
    add_images(database, names)
    with closing(sqlite3.connect(database)) as connection:
        for i in range(6):
            connection.execute(
                "UPDATE images SET prior_tx = ?, prior_ty = 0, prior_tz = 0 WHERE image_id = ?",
                (i + 100 * (i // 3), i + 1),
            )
        connection.commit()
    return database


def test_components_apart_are_listed_with_their_images(two_places: Path) -> None:
    result = run("--db", two_places, "--k", 2, "--method", "spatial", "--no-connect")
    assert result.exit_code == 0, result.output
    assert "Components   2" in result.output
    assert "3 images: 3.png, 4.png, 5.png" in result.output
    assert len((two_places.parent / "pairs.txt").read_text().splitlines()) == 6


def test_components_of_the_k_nearest_are_joined_by_the_best_pairs_between(
    two_places: Path,
) -> None:
    result = run("--db", two_places, "--k", 2, "--method", "spatial")
    assert result.exit_code == 0, result.output
    assert "5 pairs added between components" in result.output
    assert "Components   1" in result.output
    lines = (two_places.parent / "pairs.txt").read_text().splitlines()
    assert len(lines) == 11 and "2.png 3.png" in lines  # the nearest two of the two groups


def test_images_that_are_connected_get_no_further_pairs(project_copy: MakeProject) -> None:
    project = project_copy()
    with_option = make_pairs(project, "vlad", RetrievalOptions(k=4))
    without = make_pairs(project, "vlad", RetrievalOptions(k=4), connect=False)
    assert with_option.pairs == without.pairs and not with_option.connecting


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--k", "0"], "--k is 0"),
        (["--k", "-2"], "--k is -2"),
        (["--seed", "-1"], "--seed"),
        (["--seed", "99999999999"], "--seed"),
        (["--method", "vladd"], "did you mean vlad?"),
        (["--model", "none.safetensors"], "none.safetensors"),
        (["--images", "no such folder"], "no such folder"),
        (["--format", "xml"], "xml"),
        (["--device", "abacus", "--model", "CHECKPOINT"], "abacus"),
    ],
)
def test_bad_options_are_one_sentence(
    arguments: list[str], sentence: str, project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    before = sha256(project.database)
    arguments = [str(tiny_checkpoint) if word == "CHECKPOINT" else word for word in arguments]
    result = run("--db", project.database, "--method", "random", *arguments)
    assert result.exit_code not in (0, EXIT_PARTIAL)
    assert sentence in result.output
    assert "Traceback" not in result.output
    assert not project.pairs.exists()
    assert sha256(project.database) == before


def not_sqlite(path: Path) -> None:
    path.write_bytes(b"text" * 300)


def not_colmap(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE notes (text TEXT)")


def no_images(path: Path) -> None:
    make_database(path, "4.2")


def one_image(path: Path) -> None:
    make_database(path, "4.2")
    add_images(path, ["a.jpg"])


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (not_sqlite, "not a COLMAP database"),
        (not_colmap, "not a COLMAP database"),
        (no_images, "has 0 images"),
        (one_image, "has 1 image;"),
        (lambda path: None, "does not exist"),
    ],
)
def test_bad_databases_are_one_sentence(
    make: Callable[[Path], None], sentence: str, tmp_path: Path
) -> None:
    make(tmp_path / "project.db")
    result = run("--db", tmp_path / "project.db", "--method", "random")
    assert result.exit_code == 1
    assert sentence in result.output
    assert not (tmp_path / "pairs.txt").exists()


def test_a_file_that_is_no_checkpoint_is_one_sentence(
    project_copy: MakeProject, tmp_path: Path
) -> None:
    wrong = tmp_path / "wrong.safetensors"
    wrong.write_bytes(b"no weights here")
    result = run("--db", project_copy().database, "--model", wrong)
    assert result.exit_code == 1
    assert "wrong.safetensors" in result.output
    assert isinstance(result.exception, SystemExit)


def test_a_database_locked_by_another_process_is_said(
    project_copy: MakeProject,
) -> None:
    project = project_copy()
    with closing(sqlite3.connect(project.database)) as other:
        other.execute("BEGIN EXCLUSIVE")
        result = run("--db", project.database, "--method", "random")
    assert result.exit_code == 1
    assert "locked by another process" in result.output


def test_a_read_only_folder_is_said_and_cache_and_output_go_elsewhere(
    project_copy: MakeProject, tmp_path: Path
) -> None:
    project = project_copy()
    project.folder.chmod(0o555)
    try:
        if os.access(project.folder, os.W_OK):
            pytest.skip("this user may write everywhere")
        refused = run("--db", project.database, "--method", "random")
        assert refused.exit_code == 1
        assert "--cache" in refused.output
        elsewhere = ("--cache", tmp_path / "c.db", "--output", tmp_path / "pairs.txt")
        assert run("--db", project.database, "--method", "random", *elsewhere).exit_code == 0
    finally:
        project.folder.chmod(0o755)


def test_a_cache_that_cannot_be_written_is_said_and_another_place_works(
    project_copy: MakeProject, tmp_path: Path
) -> None:
    project = project_copy()
    arguments = ("--db", project.database, "--method", "random")
    refused = run(*arguments, "--cache", tmp_path / "missing" / "cache.db")
    assert refused.exit_code == 1
    assert "--cache" in refused.output
    assert run(*arguments, "--cache", tmp_path / "cache.db").exit_code == 0
    assert not project.cache.exists()


def test_a_damaged_cache_is_said_with_the_way_out(project_copy: MakeProject) -> None:
    project = project_copy()
    project.cache.write_bytes(b"garbage" * 1000)
    result = run("--db", project.database, "--method", "random")
    assert result.exit_code == 1
    assert "damaged" in result.output
    assert "delete it" in result.output


@pytest.mark.parametrize("option", ["--output", "--cache", "--export"])
def test_the_users_database_is_never_overwritten(
    option: str, project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    before = sha256(project.database)
    result = run("--db", project.database, "--model", tiny_checkpoint, option, project.database)
    assert result.exit_code == 1
    assert sha256(project.database) == before


def test_a_second_list_of_odd_names_overwrites_no_database(tmp_path: Path) -> None:
    database = tmp_path / "pairs.csv"
    make_database(database, "4.2")
    add_images(database, ["DJI 1.jpg", "DJI 2.jpg"])
    before = sha256(database)
    result = run("--db", database, "--method", "random")
    assert result.exit_code == 1 and "--output would overwrite" in result.output
    assert sha256(database) == before


@pytest.mark.parametrize("option", ["--output", "--export"])
@pytest.mark.parametrize("taken", ["own.txt", "tiny.safetensors", "project.netvlad.db"])
def test_no_file_that_is_read_is_overwritten(
    option: str, taken: str, project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    model = shutil.copy(tiny_checkpoint, project.folder)
    a, b = image_names(project.database)[:2]
    own = project.folder / "own.txt"
    own.write_text(f"{a} {b}\n")
    before = {path: sha256(path) for path in (own, Path(model))}
    result = run(
        "--db", project.database, "--model", model, "--join", own, option, project.folder / taken
    )
    assert result.exit_code == 1 and f"{option} would overwrite" in result.output
    assert {path: sha256(path) for path in before} == before


def test_a_list_of_ones_own_under_the_usual_name_is_kept(project_copy: MakeProject) -> None:
    project = project_copy()
    a, b = image_names(project.database)[:2]
    project.pairs.write_text(f"{a} {b}\n")
    arguments = ("--db", project.database, "--method", "random", "--join", project.pairs)
    result = run(*arguments)
    assert result.exit_code == 1 and "--output would overwrite" in result.output
    assert project.pairs.read_text() == f"{a} {b}\n"
    assert run(*arguments, "--output", project.folder / "joined.txt").exit_code == 0


@pytest.mark.parametrize("option", ["--output", "--export"])
@pytest.mark.parametrize("place", ["images", "file/below.txt"])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    option: str,
    place: str,
    project_copy: MakeProject,
    tiny_checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the images were ranked")

    monkeypatch.setattr("colmap_netvlad.commands.pairs.rank", refuse)
    project = project_copy()
    (project.folder / "file").touch()
    result = run(
        "--db", project.database, "--model", tiny_checkpoint, option, project.folder / place
    )
    assert result.exit_code == 1 and option in result.output
    assert isinstance(result.exception, SystemExit)


def test_one_file_is_not_both_list_and_descriptors(
    project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy()
    arguments = ("--db", project.database, "--model", tiny_checkpoint)
    result = run(*arguments, "--export", project.pairs)
    assert result.exit_code == 1 and "--export would overwrite" in result.output


@pytest.mark.parametrize("suffix", [".csv", ".JSON", ".txt"])
def test_the_list_has_the_format_that_its_name_says(
    suffix: str, project_copy: MakeProject, tmp_path: Path
) -> None:
    project, output = project_copy(), tmp_path / f"p{suffix}"
    arguments = ("--db", project.database, "--method", "random", "--k", 2)
    assert run(*arguments, "--output", output).exit_code == 0
    assert run(*arguments).exit_code == 0
    names = image_names(project.database)
    assert read_pairs(output, names) == read_pairs(project.pairs, names)


def test_the_database_of_the_current_folder_is_found(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy()
    monkeypatch.chdir(project.folder)
    assert run("--method", "random", "--k", 2).exit_code == 0
    assert project.pairs.exists()


@settings(max_examples=60, deadline=None)
@given(data=st.data(), count=st.integers(2, 20), k=st.integers(1, 25))
def test_the_union_holds_every_images_own_partners_once(
    data: st.DataObject, count: int, k: int
) -> None:
    depth = data.draw(st.integers(1, count - 1))
    partners = np.full((count, depth), NO_PARTNER, np.int32)
    for i in range(count):
        others = [j for j in range(count) if j != i]
        row = data.draw(st.permutations(others))[: data.draw(st.integers(0, depth))]
        partners[i, : len(row)] = row
    scores = np.where(partners == NO_PARTNER, -np.inf, 1.0).astype(np.float32)
    names = tuple(f"{i:02d}" for i in range(count))
    pairs = union_of_top(Ranking(names, partners, scores, "any"), k)
    found = {frozenset((pair.name1, pair.name2)) for pair in pairs}
    expected = {
        frozenset((names[i], names[j]))
        for i, row in enumerate(partners[:, :k].tolist())
        for j in row
        if j != NO_PARTNER
    }
    assert found == expected
    assert len(pairs) == len(found)
    assert [(pair.name1, pair.name2) for pair in pairs] == sorted(
        (pair.name1, pair.name2) for pair in pairs
    )
    assert all(pair.name1 < pair.name2 for pair in pairs)


@pytest.mark.real
def test_pairs_on_a_real_flight_connect_most_photos(shared_data: Path, tmp_path: Path) -> None:
    photos = shared_data / "brighton_beach" / "images"
    if not photos.is_dir():
        pytest.skip(f"{photos} is not here")
    images = tmp_path / "images"
    shutil.copytree(photos, images)
    names = sorted(path.name for path in images.iterdir())
    make_database(tmp_path / "project.db", "4.2")
    add_images(tmp_path / "project.db", names)
    result = run("--db", tmp_path / "project.db", "--k", 5)
    assert result.exit_code == 0, result.output
    assert f"Images       {len(names)}" in result.output
