"""Files of strangers are read and never run."""

from __future__ import annotations

import ast
import json
import pickle
import zipfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

import colmap_netvlad
from colmap_netvlad.models import netvlad_matlab
from colmap_netvlad.models.backbones import read_pth
from colmap_netvlad.models.checkpoint import METADATA_KEY, load_model, read_metadata
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training.scenes import load_annotation

PACKAGE = Path(colmap_netvlad.__file__).parent


class Hostile:
    """What a pickle makes: unpickled, it creates a folder."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[..., None], tuple[str]]:
        return Path.mkdir, (self.trace,)  # type: ignore[return-value]


def as_pickle(hostile: Hostile) -> bytes:
    return pickle.dumps(hostile, protocol=2)  # PyTorch's


def as_torch(hostile: Hostile) -> bytes:
    target = BytesIO()
    torch.save({"weights": hostile, "version": 1}, target)
    return target.getvalue()


def as_numpy(hostile: Hostile) -> bytes:
    target = BytesIO()
    np.savez(target, card=np.array(hostile, dtype=object))
    return target.getvalue()


WRITERS = [as_pickle, as_torch, as_numpy]


@pytest.fixture
def trace(tmp_path: Path) -> Iterator[Path]:
    """A folder that code in a file would make."""
    yield tmp_path / "was-run"
    assert not (tmp_path / "was-run").exists()


@pytest.mark.parametrize("write", [as_pickle, as_torch])
def test_these_files_do_run_where_they_are_trusted(
    tmp_path: Path, write: Callable[[Hostile], bytes]
) -> None:
    """Else the tests below could not fail."""
    data = write(Hostile(tmp_path / "was-run"))
    if write is as_pickle:
        pickle.loads(data)
    else:
        torch.load(BytesIO(data), weights_only=False)
    assert (tmp_path / "was-run").is_dir()


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("weights.pth", read_pth),
        ("model.safetensors", load_model),
        ("model.safetensors", read_metadata),
        ("netvlad.mat", netvlad_matlab.load),
        ("scene.npz", load_annotation),
    ],
)
def test_code_in_a_file_is_not_run(
    name: str,
    read: Callable[[Path], object],
    write: Callable[[Hostile], bytes],
    tmp_path: Path,
    trace: Path,
) -> None:
    (tmp_path / name).write_bytes(write(Hostile(trace)))
    with pytest.raises(InputError):
        read(tmp_path / name)


@pytest.mark.parametrize("write", WRITERS)
def test_code_in_a_file_of_descriptors_is_not_run(
    write: Callable[[Hostile], bytes],
    project_copy: Callable[..., Project],
    tmp_path: Path,
    trace: Path,
) -> None:
    file = tmp_path / "descriptors.h5"
    file.write_bytes(write(Hostile(trace)))
    with pytest.raises(InputError):
        rank_project(project_copy(), file, RetrievalOptions(k=3))


def test_a_checkpoints_metadata_are_text(tiny_checkpoint: Path) -> None:
    with safe_open(tiny_checkpoint, "pt") as file:
        metadata = file.metadata()
    assert all(isinstance(value, str) for value in metadata.values())
    assert json.loads(metadata[METADATA_KEY])["name"]
    assert not zipfile.is_zipfile(tiny_checkpoint)  # as PyTorch's own files are, with pickles


def test_nothing_unpickles() -> None:
    """By name: a new reader has to say that it loads data alone."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                modules = [getattr(node, "module", None), *(name.name for name in node.names)]
                assert not {"pickle", "joblib", "shelve", "marshal", "dill"} & set(modules), path
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            keywords = {word.arg: ast.unparse(word.value) for word in node.keywords}
            assert keywords.get("allow_pickle", "False") == "False", path
            if called == "torch.load":
                assert keywords.get("weights_only") == "True", path
            assert called not in ("eval", "exec", "yaml.load"), path
