"""`import colmap_netvlad as cn`: what a user of the library types."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

import colmap_netvlad as cn
from colmap_netvlad.cache.store import Store
from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project

MakeProject = Callable[..., Project]


def run(*arguments: object) -> object:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_the_readme_s_snippet_works_as_written(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = project_copy()
    monkeypatch.chdir(workspace.folder)
    (workspace.folder / "images").rename(workspace.folder / "photos")

    project = cn.open_project("project.db", images="photos")
    pairs = cn.make_pairs(project, k=30)
    model = cn.reconstruct(project, pairs)
    page = cn.compare(project, methods=["vlad", "netvlad-o-lite"], k=[3, 5])

    assert len(pairs.pairs) == 66, "k is lowered to the 11 others"
    assert model.total.registered == 12
    assert page.comparison.ks == (3, 5) and page.page.is_file()


@pytest.mark.parametrize("name", cn.__all__)
def test_every_public_name_is_there_and_explained(name: str) -> None:
    value = getattr(cn, name)
    assert inspect.getdoc(value), name
    if inspect.isfunction(value):
        signature = inspect.signature(value)
        unannotated = [p.name for p in signature.parameters.values() if p.annotation is p.empty]
        assert not unannotated and signature.return_annotation is not signature.empty


def test_the_face_is_small_and_loads_nothing_by_itself() -> None:
    assert len(cn.__all__) <= 12
    code = (
        "import sys, colmap_netvlad as cn; dir(cn);"
        "print([n for n in ('torch', 'pycolmap', 'cv2', 'faiss', 'numpy') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.skipif(sys.platform != "linux", reason="only GNU's OpenMP prints what it heeds")
@pytest.mark.parametrize(
    ("wanted", "heeded"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")]
)
def test_torch_s_threads_sleep_where_they_wait_unless_told_otherwise(
    wanted: dict[str, str], heeded: str
) -> None:
    others = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", "import colmap_netvlad, torch"],
        env={**others, "OMP_DISPLAY_ENV": "TRUE", **wanted},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"OMP_WAIT_POLICY = '{heeded}'" in done.stderr


@pytest.mark.parametrize("first", ["pycolmap", "colmap_netvlad"])
def test_importing_before_or_after_pycolmap_makes_no_difference(first: str, tmp_path: Path) -> None:
    """OpenCV crashed on PNG files where pycolmap came first."""
    from PIL import Image

    pixels = np.random.default_rng(0).integers(0, 255, (64, 96, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    code = (
        f"import {first}, pycolmap, colmap_netvlad\n"
        "from pathlib import Path\n"
        "from colmap_netvlad.photos.decode import decode_photo\n"
        f"for _ in range(50): decode_photo(Path({str(tmp_path / 'photo.png')!r}), 96)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]


@pytest.mark.parametrize(
    ("arguments", "refused"),
    [
        (["match", "--k", 5], "--k would be ignored"),
        (["match", "--method", "vlad", "--gps", "auto"], "--method, --gps would be ignored"),
        (["reconstruct", "--budget", 50], "--budget would be ignored"),
        (["reconstruct", "--rounds", 2, "--pairs", "pairs.txt"], "--pairs would be ignored"),
        (["pairs", "--method", "vlad", "--descriptors", "d.h5"], "--method would be ignored"),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(
    arguments: list[object], refused: str, project_copy: MakeProject, tmp_path: Path
) -> None:
    project = project_copy()
    (tmp_path / "d.h5").touch()
    command = [str(a).replace("d.h5", str(tmp_path / "d.h5")) for a in arguments]
    result = run(command[0], "--db", project.database, *command[1:])
    assert result.exit_code == 2 and refused in result.output, result.output


def test_reports_are_printed_as_json(project_copy: MakeProject) -> None:
    project = project_copy()
    pairs = run("pairs", "--db", project.database, "--k", 4, "--method", "vlad", "--json")
    report = json.loads(pairs.stdout)
    assert report["images"] == 12 and report["k"] == 4 and report["method"] == "vlad"
    assert report["pairs"] == len(project.pairs.read_text().splitlines())
    matched = json.loads(run("match", "--db", project.database, "--json").stdout)
    assert matched["matches"]["requested"] == report["pairs"] and matched["rounds"] == []
    rebuilt = json.loads(run("reconstruct", "--db", project.database, "--json").stdout)
    assert rebuilt["registered"] == 12 and Path(rebuilt["output"], "0").is_dir()
    assert rebuilt["matches"]["already"] == report["pairs"]
    graph = json.loads(run("viewgraph", "--db", project.database, "--json").stdout)
    assert graph["images"] == 12
    methods = json.loads(run("methods", "--json").stdout)
    assert {"vlad", "bow"} <= {method["name"] for method in methods}


# Descriptors of others, in hloc's HDF5 layout


def hloc_file(path: Path, names: tuple[str, ...], dim: int = 16) -> np.ndarray:
    """Write descriptors as hloc's extract_features does: a group an image, float16."""
    vectors = np.random.default_rng(0).normal(size=(len(names), dim)).astype(np.float16)
    with h5py.File(path, "a", libver="latest") as file:
        for name, vector in zip(names, vectors, strict=True):
            group = file.create_group(name)
            group.create_dataset("global_descriptor", data=vector)
    return vectors.astype(np.float32)


def test_descriptors_of_others_rank_and_are_compared_place_by_place(
    project_copy: MakeProject, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    project = project_copy()
    names = image_names(project.database)
    vectors = hloc_file(tmp_path / "megaloc.h5", names)
    plain = rank_project(project, tmp_path / "megaloc.h5", RetrievalOptions(k=11, rerank=0))
    hdf = (tmp_path / "megaloc.h5").rename(tmp_path / "megaloc.hdf")
    same = rank_project(project, hdf, RetrievalOptions(k=11, rerank=0))
    assert same.partners.tolist() == plain.partners.tolist()
    hdf.rename(tmp_path / "megaloc.h5")
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    cosines = unit @ unit.T
    np.fill_diagonal(cosines, -np.inf)
    assert plain.partners.tolist() == np.argsort(-cosines, axis=1)[:, :11].tolist()
    assert plain.method == "megaloc" and not plain.compared
    options = RetrievalOptions(k=11, model=tiny_checkpoint)
    assert rank_project(project, tmp_path / "megaloc.h5", options).compared


def test_images_without_a_descriptor_are_listed(project_copy: MakeProject, tmp_path: Path) -> None:
    project = project_copy()
    names = image_names(project.database)
    hloc_file(tmp_path / "some.h5", names[1:])
    result = run(
        "pairs", "--db", project.database, "--descriptors", tmp_path / "some.h5", "--rerank", 0
    )
    assert result.exit_code == 3
    assert f"Left out: {names[0]} has no descriptor in some.h5" in result.output


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not hdf5", "is not an HDF5 file"),
        ("others", "of none of the 12 images"),
        ("lengths", "one file holds one model's"),
    ],
)
def test_an_unusable_file_of_descriptors_is_said(
    content: bytes | str, message: str, project_copy: MakeProject, tmp_path: Path
) -> None:
    project, file = project_copy(), tmp_path / "d.h5"
    names = image_names(project.database)
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content == "others":
        hloc_file(file, ("other.jpg",))
    else:
        hloc_file(file, names[:6], 8)
        hloc_file(file, names[6:], 9)
    result = run("pairs", "--db", project.database, "--descriptors", file, "--rerank", 0)
    assert result.exit_code == 1 and message in result.output
    assert "Traceback" not in result.output and not project.pairs.exists()


def test_ours_are_exported_as_hloc_reads_them(
    project_copy: MakeProject, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    project, file = project_copy(), tmp_path / "ours.h5"
    names = image_names(project.database)
    result = run(
        "pairs", "--db", project.database, "--model", tiny_checkpoint, "--export", file, "--k", 3
    )
    assert result.exit_code == 0, result.output
    # hloc.pairs_from_retrieval: list_h5_names, then file[name]["global_descriptor"].__array__()
    found: list[str] = []
    with h5py.File(file, "r", libver="latest") as content:
        content.visititems(
            lambda _, item: (
                found.append(item.parent.name.strip("/"))
                if isinstance(item, h5py.Dataset)
                else None
            )
        )
        vectors = np.stack([content[n]["global_descriptor"].__array__() for n in names])
    assert sorted(set(found)) == sorted(names)
    with Store(project.cache) as store:
        (key,) = {row[0] for row in store._db.execute("SELECT DISTINCT model FROM descriptors")}
        np.testing.assert_array_equal(vectors, np.float16(store.read_vectors(key, names)))
    again = rank_project(project, file, RetrievalOptions(k=3, rerank=0)).top(3)
    ours = rank_project(project, tiny_checkpoint, RetrievalOptions(k=3, rerank=0, exact=True)).top(
        3
    )
    np.testing.assert_allclose(again.scores, ours.scores, atol=2e-3)


def test_a_method_without_a_model_has_nothing_to_export(
    project_copy: MakeProject, tmp_path: Path
) -> None:
    project, file = project_copy(), tmp_path / "vlad.h5"
    result = run("pairs", "--db", project.database, "--method", "vlad", "--export", file)
    assert result.exit_code == 1 and "no deep descriptors to export" in result.output
    assert not file.exists()
    assert not project.cache.exists()  # it was refused before the work


def test_where_no_photo_is_described_there_is_nothing_to_export(
    project_copy: MakeProject, tmp_path: Path
) -> None:
    project, file = project_copy(), tmp_path / "ours.h5"
    hloc_file(tmp_path / "others.h5", image_names(project.database))
    others = ("--descriptors", tmp_path / "others.h5", "--rerank", 0)
    result = run("pairs", "--db", project.database, *others, "--export", file)
    assert result.exit_code == 1 and "nothing to --export" in result.output
    assert not file.exists() and not project.pairs.exists()
