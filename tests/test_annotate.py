"""Annotation: what is saved, what is not done twice, what is left out and said."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.commands import annotate as module
from colmap_netvlad.commands.annotate import AnnotateOptions, annotate, find_scenes, table_lines
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.matching.options import MatchReport
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import EXIT_PARTIAL, InputError
from colmap_netvlad.training.scenes import (
    ANNOTATION,
    VERSION,
    Scene,
    find_annotations,
    load_annotation,
    load_dataset,
    save_annotation,
)


@pytest.fixture(scope="module")
def dataset(flight: RenderedFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one scene, the rendered flight. Read only."""
    folder = tmp_path_factory.mktemp("dataset")
    _link(flight, folder / "village")
    return folder


def _link(flight: RenderedFlight, scene: Path) -> None:
    (scene / "images").mkdir(parents=True)
    for name in flight.names:
        os.link(flight.images / name, scene / "images" / name)


def _carry(annotated: Path, scene: Path, output: Path) -> None:
    """Write the flight's annotation as that of a copy of its photos, in `scene`."""
    annotation = load_annotation(annotated / "village" / ANNOTATION)
    carried = dataclasses.replace(annotation, name=scene.name, images=scene / "images")
    save_annotation(carried, output / ANNOTATION)


@pytest.fixture(scope="module")
def annotated(
    dataset: Path, matched_database: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The annotations of that dataset. Read only."""
    databases = tmp_path_factory.mktemp("databases")
    shutil.copy(matched_database, databases / "village.db")
    before = hashlib.sha256((databases / "village.db").read_bytes()).digest()
    output = tmp_path_factory.mktemp("annotations")
    report = annotate([dataset], AnnotateOptions(output=output, databases=databases))
    assert not report.left_out
    after = hashlib.sha256((databases / "village.db").read_bytes()).digest()
    assert before == after, "a given database stays as it is"
    return output


def test_similarity_is_the_number_of_common_points_of_the_model(annotated: Path) -> None:
    """Eq. 4 against a literal count over the tracks of the saved model."""
    scene = load_annotation(annotated / "village" / ANNOTATION)
    model = pycolmap.Reconstruction(annotated / "village" / "sparse" / "0")
    names = {image_id: image.name for image_id, image in model.images.items()}
    sees: dict[str, set[int]] = {name: set() for name in scene.names}
    for point_id, point in model.points3D.items():
        for element in point.track.elements:
            sees[names[element.image_id]].add(point_id)
    similarity = scene.common_points.toarray()
    for i, a in enumerate(scene.names):
        for j, b in enumerate(scene.names):
            assert similarity[i, j] == (len(sees[a] & sees[b]) if i != j else 0)
    assert scene.points == model.num_points3D() and scene.method == "exhaustive"
    assert scene.registered == model.num_reg_images() == len(scene)
    assert scene.observations is not None
    for i, name in enumerate(scene.names):
        points, at = scene.observations.of(i)
        assert len(points) == len(sees[name]) and np.abs(at).max() <= 0.5


def test_without_a_mapper_tracks_of_verified_matches_stand_for_points(
    dataset: Path, matched_database: Path, annotated: Path, tmp_path: Path
) -> None:
    """Tracks against a literal union of matched keypoints; GS goes with the reconstruction's."""
    (tmp_path / "databases").mkdir()
    shutil.copy(matched_database, tmp_path / "databases" / "village.db")
    options = AnnotateOptions(
        output=tmp_path / "out", databases=tmp_path / "databases", mapper="none"
    )
    (scene,) = annotate([dataset], options).scenes
    parent: dict[tuple[int, int], tuple[int, int]] = {}

    def root(key: tuple[int, int]) -> tuple[int, int]:
        while parent.setdefault(key, key) != key:
            key = parent[key]
        return key

    with open_database(matched_database) as opened:
        ids = {row.name: row.image_id for row in opened.images()}
        for (a, b), count in opened.verified_matches().items():
            if count > 15:
                for i, j in opened.inlier_matches(a, b).tolist():
                    parent[root((a, i))] = root((b, j))
    members: dict[tuple[int, int], list[int]] = {}
    for key in list(parent):
        members.setdefault(root(key), []).append(key[0])
    consistent = [set(images) for images in members.values() if len(images) == len(set(images))]
    assert scene.points == len(consistent)
    similarity = scene.common_points.toarray()
    for i, a in enumerate(scene.names):
        for j, b in enumerate(scene.names[:i]):
            assert similarity[i, j] == sum({ids[a], ids[b]} <= track for track in consistent)
    reconstructed = load_annotation(annotated / "village" / ANNOTATION).common_points.toarray()
    assert np.corrcoef(similarity.ravel(), reconstructed.ravel())[0, 1] > 0.9


def test_poses_are_those_of_the_model(annotated: Path) -> None:
    scene = load_annotation(annotated / "village" / ANNOTATION)
    model = pycolmap.Reconstruction(annotated / "village" / "sparse" / "0")
    for name, pose in zip(scene.names, scene.poses, strict=True):
        image = next(image for image in model.images.values() if image.name == name)
        w, x, y, z = pose[:4]
        rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
        expected = image.cam_from_world()
        assert np.allclose(rotation.matrix(), expected.rotation.matrix(), atol=1e-6)
        assert np.allclose(pose[4:], expected.translation)


def test_an_annotation_reads_back_as_it_was_written(annotated: Path, tmp_path: Path) -> None:
    scene = load_annotation(annotated / "village" / ANNOTATION)
    save_annotation(scene, tmp_path / ANNOTATION)
    again = load_annotation(tmp_path / ANNOTATION)
    for item in dataclasses.fields(Scene):
        one, other = getattr(scene, item.name), getattr(again, item.name)
        if item.name in ("common_points", "matches"):
            assert (one != other).nnz == 0
        elif item.name == "observations":
            assert all(np.array_equal(getattr(one, k), getattr(other, k)) for k in ("first", "at"))
        elif isinstance(one, np.ndarray):
            assert np.array_equal(one, other, equal_nan=True)
        else:
            assert one == other, item.name


def test_bow_pairs_annotate_a_scene_from_its_photos_alone(dataset: Path, tmp_path: Path) -> None:
    report = annotate(
        [dataset / "village"], AnnotateOptions(output=tmp_path, retrieval=RetrievalOptions(k=5))
    )
    assert not report.left_out
    (scene,) = report.scenes
    assert scene.method == "bow" and scene.registered >= 10
    tried = len(scene) * (len(scene) - 1) // 2
    assert 0 < len(scene.correct_pairs()) < tried


def test_a_scene_says_which_method_its_pairs_came_from(
    dataset: Path,
    flight_database: Path,
    tiny_checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The model that ranked, not the method that it ranked instead of."""
    monkeypatch.setattr(
        "colmap_netvlad.colmap.features.extract_features",
        lambda images, database: shutil.copy(flight_database, database),
    )
    monkeypatch.setattr("colmap_netvlad.matching.run.match_pairs", lambda *arguments: None)
    (folder,) = find_scenes([dataset / "village"])
    retrieval = RetrievalOptions(k=3, model=tiny_checkpoint, rerank=0, exact=True)
    options = AnnotateOptions("bow", retrieval)
    assert module._matched_database(folder, tmp_path / "database.db", options) == "tiny"


def test_what_is_annotated_is_not_done_again_unless_photos_came(
    flight: RenderedFlight,
    annotated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _link(flight, tmp_path / "data" / "village")
    _carry(annotated, tmp_path / "data" / "village", tmp_path / "out" / "village")
    options = AnnotateOptions(output=tmp_path / "out")
    made: list[str] = []

    def work(folder: module.SceneFolder, *rest: object) -> str:
        made.append(folder.name)
        raise InputError("worked on")

    monkeypatch.setattr(module, "_matched_database", work)
    assert len(annotate([tmp_path / "data"], options).scenes) == 1 and not made
    (tmp_path / "data" / "village" / "images" / "broken.jpg").write_bytes(b"nothing")
    assert len(annotate([tmp_path / "data"], options).scenes) == 1 and not made
    cv2.imwrite(
        str(tmp_path / "data" / "village" / "images" / "new.jpg"), np.zeros((90, 120, 3), np.uint8)
    )
    annotate([tmp_path / "data"], options)
    assert made == ["village"]


def test_a_killed_run_goes_on_with_the_pairs_already_matched(
    project_copy: Callable[..., Project],
    dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The matched database and half a model of a killed run are there."""
    work = tmp_path / "out" / "village"
    work.mkdir(parents=True)
    shutil.copy(project_copy(matched=True).database, work / "database.db")
    (work / "sparse" / "0").mkdir(parents=True)
    (work / "sparse" / "0" / "half").write_text("")
    from colmap_netvlad.matching import run as matching

    reports = []
    original = matching.match_pairs

    def counted(*arguments: object) -> MatchReport:
        reports.append(original(*arguments))  # type: ignore[arg-type]
        return reports[-1]

    monkeypatch.setattr(matching, "match_pairs", counted)
    report = annotate(
        [dataset], AnnotateOptions(output=tmp_path / "out", retrieval=RetrievalOptions(k=4))
    )
    assert not report.left_out and report.scenes[0].registered >= 10
    assert reports[0].matched == 0 and reports[0].already > 0


def test_a_scene_that_does_not_reconstruct_is_named_and_left_out(
    dataset: Path, annotated: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    shutil.copytree(dataset / "village", data / "village")
    rng = np.random.default_rng(0)
    (data / "noise").mkdir()
    for number in range(4):
        photo = rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)
        cv2.imwrite(str(data / "noise" / f"{number}.jpg"), photo)
    _carry(annotated, data / "village", tmp_path / "out" / "village")
    arguments = ["annotate", str(data), "--output", str(tmp_path / "out")]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == EXIT_PARTIAL, result.output
    assert "Scene noise is left out: it does not reconstruct (0 of 4 photos" in result.output
    assert "village" in result.stdout and not (tmp_path / "out" / "noise" / ANNOTATION).exists()


def test_equal_photos_in_two_scenes_are_found_by_content(
    flight: RenderedFlight, annotated: Path, tmp_path: Path
) -> None:
    for name in ("one", "two"):
        _link(flight, tmp_path / "data" / name)
        _carry(annotated, tmp_path / "data" / name, tmp_path / "out" / name)
    report = annotate([tmp_path / "data"], AnnotateOptions(output=tmp_path / "out"))
    assert [scene.name for scene in report.scenes] == ["one"]
    assert "two is left out" in report.left_out[0] and "is also" in report.left_out[0]
    with pytest.raises(InputError, match="must not be its own negative"):
        load_dataset([tmp_path / "out"])
    (one,) = load_dataset([tmp_path / "out"], leave_out=["two"])
    (two,) = load_dataset([tmp_path / "out"], validation=[one])
    assert (one.name, two.name) == ("one", "two")


def test_a_scene_to_be_left_out_that_is_none_is_refused_with_those_there_are(
    annotated: Path, tmp_path: Path
) -> None:
    """A typo would train on the scene that was to be held out."""
    with pytest.raises(InputError, match=r"`leave_out` names 'vilage', .*: there are village"):
        load_dataset([annotated], leave_out=["vilage"])
    arguments = ["train", str(annotated), "--output", str(tmp_path), "--leave-out", "vilage"]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 1 and "--leave-out names 'vilage'" in result.output
    elsewhere = dataclasses.replace(load_dataset([annotated])[0], name="elsewhere")
    assert len(load_dataset([annotated], validation=[elsewhere])) == 1


def test_a_missing_folder_of_databases_is_refused_before_any_work(
    dataset: Path, tmp_path: Path
) -> None:
    options = AnnotateOptions(output=tmp_path / "out", databases=tmp_path / "absent")
    with pytest.raises(InputError, match=r"matched databases .*absent does not exist"):
        annotate([dataset], options)
    assert not any(tmp_path.iterdir())


def test_an_annotation_of_another_version_is_refused_and_left_alone(
    dataset: Path, annotated: Path, tmp_path: Path
) -> None:
    path = tmp_path / "village" / ANNOTATION
    path.parent.mkdir()
    with np.load(annotated / "village" / ANNOTATION) as archive:
        tables = dict(archive)
    card = json.loads(str(tables["card"]))
    tables["card"] = np.array(json.dumps({**card, "version": VERSION + 1}))
    np.savez(path, **tables)
    content = path.read_bytes()
    with pytest.raises(InputError, match=rf"version {VERSION + 1}, this program reads version"):
        load_annotation(path)
    report = annotate([dataset], AnnotateOptions(output=tmp_path))
    assert "of version" in report.left_out[0] and path.read_bytes() == content
    path.write_bytes(content[:200])
    with pytest.raises(InputError, match="not an annotation of colmap-netvlad, or damaged"):
        load_annotation(path)
    tables["card"] = np.array(json.dumps(card))
    np.savez(path, **{**tables, "poses": tables["poses"][:3]})
    with pytest.raises(InputError, match="different lengths"):
        load_annotation(path)


def test_an_annotation_of_other_photos_is_left_alone(
    flight: RenderedFlight, annotated: Path, tmp_path: Path
) -> None:
    """Two datasets with a scene of one name, annotated into one folder."""
    _link(flight, tmp_path / "other" / "village")
    report = annotate([tmp_path / "other"], AnnotateOptions(output=annotated))
    assert "the annotation of other photos" in report.left_out[0]


def test_photos_that_are_gone_are_said(annotated: Path, tmp_path: Path) -> None:
    scene = load_annotation(annotated / "village" / ANNOTATION)
    moved = dataclasses.replace(scene, images=tmp_path / "gone")
    save_annotation(moved, tmp_path / ANNOTATION)
    with pytest.raises(InputError, match="The photos of scene village are gone"):
        load_annotation(tmp_path / ANNOTATION)


def test_folders_without_scenes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        find_scenes([tmp_path / "absent"])
    with pytest.raises(InputError, match="holds no scenes"):
        find_scenes([tmp_path])
    with pytest.raises(InputError, match="holds no annotated scene"):
        find_annotations([tmp_path])
    for folder in ("a/x", "b/x"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "1.jpg").write_bytes(b"")
    with pytest.raises(InputError, match="Two scenes are named x"):
        find_scenes([tmp_path / "a", tmp_path / "b"])


def test_an_unknown_method_or_mapper_is_refused_before_any_work(
    dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="retrieval method 'bov'"):
        annotate([dataset], AnnotateOptions(method="bov", output=tmp_path))
    with pytest.raises(InputError, match="No mapper is called 'fast'"):
        annotate([dataset], AnnotateOptions(mapper="fast", output=tmp_path))
    assert not any(tmp_path.iterdir())


def test_the_table_sums_up_the_scenes(annotated: Path) -> None:
    scene = load_annotation(annotated / "village" / ANNOTATION)
    lines = table_lines([scene, dataclasses.replace(scene, name="other")])
    assert len(lines) == 4 and lines[1].split()[:3] == ["village", "12", "12"]
    assert lines[-1].split()[:2] == ["all", "24"]
    assert table_lines([]) == []


def test_train_runs_from_the_command_line_on_annotations(annotated: Path, tmp_path: Path) -> None:
    """One scene alone is refused in a sentence; the settings of a recipe are used."""
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('mining = "nontrivial"\nepochs = 1\niterations = 1\nclusters = 4\n')
    arguments = [
        "train",
        str(annotated),
        "--output",
        str(tmp_path / "run"),
        "--recipe",
        str(recipe),
    ]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 1
    assert "one usable scene only (village)" in result.output
    far = CliRunner().invoke(cli, [*arguments, "--momentum", "1.5"])
    assert far.exit_code == 1 and "--momentum is 1.5; it must be at least 0" in far.output
    wrong = CliRunner().invoke(cli, [*arguments, "--loss", "softest"])
    assert wrong.exit_code == 2 and "'softest' is not one of" in wrong.output
