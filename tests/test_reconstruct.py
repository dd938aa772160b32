"""Matches -> sparse models -> report."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from guided import change, rows

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import image_names, open_database, pair_id
from colmap_netvlad.commands import reconstruct as command
from colmap_netvlad.commands.georegister import database_beside
from colmap_netvlad.commands.match import MatchingReport, match, working_copy
from colmap_netvlad.commands.reconstruct import (
    ReconstructReport,
    reconstruct,
    report_lines,
)
from colmap_netvlad.commands.report import report
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.output import free_output
from colmap_netvlad.mapping.summary import ModelSummary, combine, registered_names, summarize
from colmap_netvlad.matching.options import MatchReport
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.pairs.lists import write_pairs
from colmap_netvlad.pairs.union import ImagePair
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.terminal import models_table, print_models

MakeProject = Callable[..., Project]


def write_all_pairs(project: Project) -> None:
    names = image_names(project.database)
    lines = (f"{a} {b}\n" for i, a in enumerate(names) for b in names[i + 1 :])
    project.pairs.write_text("".join(lines), encoding="utf-8")


def map_matched(project: Project) -> ReconstructReport:
    """Reconstruct from pairs that are matched already."""
    write_all_pairs(project)
    return reconstruct(project)


def poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {
        model.image(i).name: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()
    }


def test_reconstruct_writes_the_model_and_prints_its_figures(project_copy: MakeProject) -> None:
    project = project_copy(matched=True)
    write_all_pairs(project)
    result = CliRunner().invoke(cli, ["reconstruct", "--db", str(project.database)])
    assert result.exit_code == 0, result.output
    model = pycolmap.Reconstruction(project.sparse / "0")
    assert model.num_reg_images() == 12
    for figure in ("12 of 12", f"{model.num_points3D():,}", "66 matched before", "mapping"):
        assert figure in result.stdout
    assert "Matches are in" in result.stdout
    assert max(map(len, result.stdout.splitlines())) < 400
    colours = {tuple(point.color) for point in model.points3D.values()}
    assert len(colours) > 10  # points are coloured from the photos


def test_two_runs_give_the_same_model_and_the_first_one_stays(project_copy: MakeProject) -> None:
    project = project_copy(matched=True)
    first = map_matched(project)
    files = {path: path.read_bytes() for path in project.sparse.rglob("*") if path.is_file()}
    second = map_matched(project)
    assert second.output == project.folder / "sparse-2"
    assert {path: path.read_bytes() for path in files} == files
    assert (first.models, first.missing) == (second.models, second.missing)
    one, two = (pycolmap.Reconstruction(report.output / "0") for report in (first, second))
    for name, pose in poses(one).items():
        assert np.array_equal(pose, poses(two)[name])


def test_models_whose_name_another_run_took_meanwhile_get_the_next(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy(matched=True)
    made_by_another = project.sparse / "0" / "images.bin"

    def save_while_another_ends(*arguments: object) -> None:
        made_by_another.parent.mkdir(parents=True)
        made_by_another.touch()

    monkeypatch.setattr(command, "save_runs", save_while_another_ends)
    report = map_matched(project)
    assert report.output == project.folder / "sparse-2"
    assert pycolmap.Reconstruction(report.output / "0").num_reg_images() == 12
    assert report.quality[0].page.parent == report.output / "0"
    assert [path.name for path in project.sparse.rglob("*")] == ["0", "images.bin"]


def test_map_without_photos_works_on_the_database_alone(
    project_copy: MakeProject, tmp_path: Path
) -> None:
    models = map_incremental(project_copy(matched=True).database, None, tmp_path / "out" / "sparse")
    assert sum(model.num_reg_images() for model in models) == 12
    assert (tmp_path / "out" / "sparse" / "0" / "images.bin").is_file()


def test_the_list_that_was_written_last_is_matched(project_copy: MakeProject) -> None:
    """Where names do not fit in COLMAP's list, `pairs` writes the complete one after it."""
    project = project_copy()
    a, b, c = image_names(project.database)[:3]
    project.pairs.write_text(f"{a} {b}\n", encoding="utf-8")
    os.utime(project.pairs, ns=(1, 1))
    listed = [ImagePair(a, b, 0.9, 1), ImagePair(b, c, 0.8, 1)]
    write_pairs(project.pairs.with_suffix(".csv"), listed, "csv")
    assert match(project).matches.requested == 2
    os.utime(project.pairs)
    assert match(project).matches.requested == 1


def test_copy_leaves_the_database_byte_identical(project_copy: MakeProject) -> None:
    project = project_copy()
    write_all_pairs(project)
    before = hashlib.sha256(project.database.read_bytes()).hexdigest()
    arguments = ["reconstruct", "--db", str(project.database), "--copy"]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    assert hashlib.sha256(project.database.read_bytes()).hexdigest() == before
    assert (project.sparse / "0").is_dir() and "66 now" in result.stdout
    again = CliRunner().invoke(cli, arguments)
    assert "66 matched before" in again.stdout and "sparse-2" in again.stdout
    # What asks for the model's database later finds the copy, which has its matches.
    assert database_beside(project.sparse, None)[0] == project.copy
    (links,) = (check for check in report(project.sparse).checks if check.title == "Weak links")
    assert (links.value, links.level) == ("none", "green")


def test_a_copy_of_other_features_is_made_anew(project_copy: MakeProject) -> None:
    project = project_copy(matched=True)
    copy = working_copy(project)
    assert copy.database.name == "project.copy.db" and copy.images == project.images
    change(copy.database, "DELETE FROM matches", "DELETE FROM two_view_geometries")
    marked = copy.database.stat().st_ino
    assert working_copy(project).database.stat().st_ino == marked  # same images and features
    connection = pycolmap.Database.open(copy.database)
    connection.clear_keypoints()
    connection.close()
    assert working_copy(project).database.stat().st_ino != marked


def test_a_database_of_the_users_with_the_name_of_a_copy_is_left_alone(
    project_copy: MakeProject,
) -> None:
    project = project_copy()
    shutil.copy(project.database, project.copy)
    before = project.copy.read_bytes()
    with pytest.raises(InputError, match=r"project\.copy\.db is there already, was not made as"):
        working_copy(project)
    assert project.copy.read_bytes() == before


def test_a_copy_with_photos_of_its_own_is_left_alone(project_copy: MakeProject) -> None:
    project = project_copy()
    copy = working_copy(project).database
    change(copy, "INSERT INTO images (name, camera_id) VALUES ('added.jpg', 1)")
    before = copy.read_bytes()
    with pytest.raises(InputError, match=r"does not have \(added\.jpg\)"):
        working_copy(project)
    assert copy.read_bytes() == before


def test_a_copy_follows_cameras_priors_and_features_and_keeps_its_matches(
    project_copy: MakeProject,
) -> None:
    project = project_copy()
    copy = working_copy(project).database
    names = image_names(copy)
    match_pairs(copy, [(names[0], names[1]), (names[1], names[2])])
    kept = rows(copy)
    change(
        project.database,
        "UPDATE cameras SET prior_focal_length = 1 - prior_focal_length",
        "UPDATE descriptors SET data = zeroblob(128 * rows) WHERE image_id = 3",
        "INSERT INTO images (name, camera_id) VALUES ('new.jpg', 1)",
    )
    working_copy(project)
    with open_database(copy) as made, open_database(project.database) as old:
        assert made.cameras() == old.cameras() and made.images() == old.images()
    assert rows(copy) == {pair: row for pair, row in kept.items() if pair == pair_id(1, 2)} != {}
    change(project.database, "UPDATE pose_priors SET coordinate_system = 1")
    working_copy(project)
    with open_database(copy) as made, open_database(project.database) as old:
        assert made.pose_priors() == old.pose_priors() != {}
    assert len(rows(copy)) == 1


def test_matches_of_a_copy_of_an_old_colmaps_database_are_kept(legacy_database: Path) -> None:
    """pycolmap brings the copy to another schema."""
    project = Project(legacy_database, None)
    copy = working_copy(project).database
    match_pairs(copy, [image_names(copy)[:2]])
    working_copy(project)
    assert match_pairs(copy, [image_names(copy)[:2]]).already == 1


def test_an_interrupted_mapping_leaves_no_trace(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy(matched=True)

    def stop(*arguments: object, **options: object) -> object:
        call(*arguments, **options)
        raise KeyboardInterrupt

    call = engine.call
    monkeypatch.setattr(engine, "call", stop)
    write_all_pairs(project)
    before = {path.name for path in project.folder.iterdir()}
    with pytest.raises(KeyboardInterrupt):
        map_matched(project)
    after = {path.name for path in project.folder.iterdir()}
    kept = {project.cache.name}  # positions of the photos, read to tell look-alikes
    assert {name for name in after - before if not name.endswith(("-wal", "-shm"))} <= kept


def test_a_given_output_that_exists_is_left_alone(
    project_copy: MakeProject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "notes.txt").touch()
    assert free_output(tmp_path / "taken") == tmp_path / "taken-2"
    assert free_output(tmp_path / "new") == tmp_path / "new"
    monkeypatch.chdir(tmp_path / "taken")
    assert free_output(Path()) == tmp_path / "taken-2"
    with pytest.raises(InputError, match="exists already and is left as it is"):
        map_incremental(project_copy(matched=True).database, None, tmp_path / "taken")


def test_what_is_missing_for_a_reconstruction_is_said(project_copy: MakeProject) -> None:
    project = project_copy()
    with pytest.raises(InputError, match="make it with `colmap-netvlad pairs`"):
        reconstruct(project)
    project.pairs.write_text("# nothing\n")
    with pytest.raises(InputError, match="lists no pairs"):
        reconstruct(project)
    project.pairs.write_text("a.jpg b.jpg\n")
    with pytest.raises(InputError, match=r"a\.jpg"):
        reconstruct(project)
    result = CliRunner().invoke(
        cli, ["reconstruct", "--db", str(project.database), "--mapper", "magic"]
    )
    assert result.exit_code == 1 and "There is no mapper magic; choose" in result.stderr


def test_photos_that_do_not_overlap_are_said(project_copy: MakeProject) -> None:
    project = project_copy()
    names = image_names(project.database)
    noise = np.random.default_rng(0)
    with closing(sqlite3.connect(project.database)) as connection:
        (rows,) = connection.execute("SELECT rows FROM descriptors WHERE image_id = 1").fetchone()
        nothing = noise.integers(0, 256, (rows, 128), np.uint8).tobytes()
        connection.execute("UPDATE descriptors SET data = ? WHERE image_id = 1", (nothing,))
        connection.commit()
    project.pairs.write_text(f"{names[0]} {names[1]}\n")
    with pytest.raises(InputError, match="None of the 1 pairs could be verified"):
        reconstruct(project)
    assert not project.sparse.exists()


def test_images_left_out_are_counted_and_named(project_copy: MakeProject) -> None:
    project = project_copy()
    names = image_names(project.database)
    lines = [f"{a} {b}\n" for i, a in enumerate(names[:8]) for b in names[i + 1 : 8]]
    project.pairs.write_text("".join(lines))
    report = reconstruct(project)
    assert set(report.missing) >= set(names[8:])
    assert report.images == 12 and report.total.registered == 12 - len(report.missing)
    lines = report_lines(report)
    assert f"Not registered: {len(report.missing)} of 12 images: " in lines[-1]
    assert f"  4 alone: {', '.join(names[8:])}" in lines


def test_summaries_count_an_image_of_two_models_once(project_copy: MakeProject) -> None:
    (model,) = map_incremental(
        (project := project_copy(matched=True)).database, None, project.sparse
    )
    one, both = summarize(model), combine([model, model])
    assert one.registered == both.registered == len(registered_names([model])) == 12
    assert both.points == 2 * one.points and both.observations == 2 * one.observations
    assert both.mean_reprojection_error == pytest.approx(one.mean_reprojection_error)
    assert both.mean_track_length == pytest.approx(one.observations / one.points)
    assert 0 < one.mean_reprojection_error < 2 < one.mean_track_length
    empty = summarize(pycolmap.Reconstruction())
    assert empty.points == 0 and math.isnan(empty.mean_reprojection_error)
    assert combine([]).registered == 0


def test_the_report_shows_each_component_and_the_total(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model = ModelSummary(5, 1000, 0.5, 3.0, 3000)
    matched = MatchReport(requested=66, already=66, matched=0, verified=50, seconds=0.0)
    report = ReconstructReport(
        tmp_path,
        20,
        MatchingReport(matched, []),
        [model],
        model,
        [f"{i}.jpg" for i in range(15)],
        {"matching": 90.0},
    )
    assert models_table(report).row_count == 1
    assert models_table(replace(report, models=[model, model])).row_count == 3
    monkeypatch.setenv("COLUMNS", "60")
    print_models(replace(report, models=[model, model]))
    said = capsys.readouterr().out
    assert "Component" in said and "total" in said and "…" not in said
    text = "\n".join(report_lines(report))
    assert "15 of 20 images: 0.jpg" in text and "9.jpg, and 5 more." in text
    assert "10.jpg" not in text
    assert "matching 1.5" in text
