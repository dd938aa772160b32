"""A project is found where COLMAP keeps it."""

from pathlib import Path

import pytest

from colmap_netvlad.cache.store import Store
from colmap_netvlad.project import open_project
from colmap_netvlad.runtime.errors import InputError


@pytest.mark.parametrize("name", ["project.db", "database.db"])
def test_a_workspace_in_the_current_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / name).touch()
    (tmp_path / "images").mkdir()
    monkeypatch.chdir(tmp_path)
    project = open_project(None)
    assert project.database == tmp_path / name
    assert project.images == tmp_path / "images"
    assert project.cache.name == Path(name).stem + ".netvlad.db"


def test_the_remembered_photo_folder_comes_before_images_beside_the_database(
    tmp_path: Path,
) -> None:
    (tmp_path / "project.db").touch()
    (tmp_path / "images").mkdir()
    remembered = tmp_path / "elsewhere"
    remembered.mkdir()
    with Store(tmp_path / "project.netvlad.db") as store:
        store.remember_images(remembered)
    assert open_project(tmp_path / "project.db").images == remembered
    remembered.rmdir()
    project = open_project(tmp_path / "project.db")
    assert project.images == tmp_path / "images"


def test_without_photos_a_project_opens_and_says_so_when_they_are_needed(tmp_path: Path) -> None:
    (tmp_path / "project.db").touch()
    project = open_project(tmp_path / "project.db")
    with pytest.raises(InputError, match="`images`"):
        project.need_images()


@pytest.mark.parametrize(
    ("database", "images", "message"),
    [
        (None, None, "name one with `database`"),
        ("absent.db", None, r"absent\.db does not exist"),
        (".", None, "is a folder"),
        ("there.db", "nowhere", "photo folder .*nowhere does not exist"),
    ],
)
def test_what_is_not_there_is_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    database: str | None,
    images: str | None,
    message: str,
) -> None:
    (tmp_path / "there.db").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        open_project(
            None if database is None else tmp_path / database,
            None if images is None else tmp_path / images,
        )
