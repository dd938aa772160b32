"""What belongs to other features, other photos or another project is found by content."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from photos import save_jpeg, scene

from colmap_netvlad.cache.store import Store, remembered_images
from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.colmap.features import FeatureOptions
from colmap_netvlad.commands.features import import_photos
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import InputError

MakeProject = Callable[..., Project]
K3 = RetrievalOptions(k=3)


def extract_again(database: Path, images: int = 100) -> None:
    """Give images other features, as many as they had."""
    with closing(sqlite3.connect(database)) as connection:
        for table, dtype in (("keypoints", np.float32), ("descriptors", np.uint8)):
            for image, rows, cols, data in connection.execute(
                f"SELECT image_id, rows, cols, data FROM {table} WHERE image_id <= {images}"
            ).fetchall():
                order = np.random.default_rng(image).permutation(rows)
                other = np.frombuffer(data, dtype).reshape(rows, cols)[order]
                connection.execute(
                    f"UPDATE {table} SET data = ? WHERE image_id = ?", (other.tobytes(), image)
                )
        connection.commit()


def remove(database: Path, names: tuple[str, ...]) -> None:
    """Make a database of yesterday, when it did not have some photos yet."""
    with closing(sqlite3.connect(database)) as connection:
        for name in names:
            (image,) = connection.execute(
                "SELECT image_id FROM images WHERE name = ?", (name,)
            ).fetchone()
            for table in ("keypoints", "descriptors", "images"):
                connection.execute(f"DELETE FROM {table} WHERE image_id = ?", (image,))
        connection.commit()


@pytest.mark.parametrize("images", [1, 100])
def test_matches_of_features_that_were_extracted_again_are_refused(
    project_copy: MakeProject, images: int
) -> None:
    project = project_copy(matched=True)
    pairs = list(combinations(image_names(project.database), 2))
    assert match_pairs(project.database, pairs).already == len(pairs)
    extract_again(project.database, images)
    with pytest.raises(InputError, match="are not of the features that they have now"):
        match_pairs(project.database, pairs)


def test_pairs_that_are_not_asked_for_are_not_looked_at(project_copy: MakeProject) -> None:
    project = project_copy(matched=True)
    extract_again(project.database, 1)
    others = image_names(project.database)[1:]
    assert match_pairs(project.database, list(combinations(others, 2))).matched == 0


def test_words_of_other_features_are_learned_anew(project_copy: MakeProject) -> None:
    """A cache of another project of as many photos, with the same names."""
    project, other = project_copy(), project_copy(name="other")
    with closing(sqlite3.connect(other.database)) as connection:
        for image, data in connection.execute("SELECT image_id, data FROM descriptors").fetchall():
            connection.execute(
                "UPDATE descriptors SET data = ? WHERE image_id = ?", (data[::-1], image)
            )
        connection.commit()
    rank_project(project, "vlad", K3)
    fresh = rank_project(other, "vlad", K3)
    shutil.copy(project.cache, other.cache)
    ranking = rank_project(other, "vlad", K3)
    (learned,) = (note for note in ranking.notes if "codebook" in note)
    assert "in an earlier run" not in learned
    assert ranking.notes[0].startswith("12 of 12 descriptors computed")
    np.testing.assert_array_equal(ranking.partners, fresh.partners)
    np.testing.assert_array_equal(ranking.scores, fresh.scores)
    (learned,) = (note for note in rank_project(other, "vlad", K3).notes if "codebook" in note)
    assert "in an earlier run" in learned


def test_a_networks_descriptors_of_another_projects_photos_are_not_taken(
    project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project, other = project_copy(), project_copy(name="other", copy_photos=True)
    names = image_names(project.database)
    for name, photo in zip(names, reversed(names), strict=True):
        shutil.copy(project.need_images() / photo, other.need_images() / name)
    fresh = rank_project(other, tiny_checkpoint, K3)
    rank_project(project, tiny_checkpoint, K3)
    shutil.copy(project.cache, other.cache)
    ranking = rank_project(other, tiny_checkpoint, K3)
    assert ranking.notes[0].startswith("12 of 12 descriptors computed")
    np.testing.assert_array_equal(ranking.partners, fresh.partners)


@pytest.mark.parametrize("method", ["vlad", "deep"])
def test_with_the_database_of_yesterday_the_cache_of_today_changes_nothing(
    project_copy: MakeProject, tiny_checkpoint: Path, method: str
) -> None:
    chosen = tiny_checkpoint if method == "deep" else method
    project, fresh = project_copy(), project_copy(name="fresh")
    newest = image_names(project.database)[-3:]
    rank_project(project, chosen, K3)
    for one in (project, fresh):
        remove(one.database, newest)
    ranking, expected = (rank_project(one, chosen, K3) for one in (project, fresh))
    assert ranking.names == expected.names and len(ranking.names) == 9
    np.testing.assert_array_equal(ranking.partners, expected.partners)
    np.testing.assert_array_equal(ranking.scores, expected.scores)


def test_with_the_database_of_yesterday_the_pairs_of_today_are_refused(
    project_copy: MakeProject,
) -> None:
    project = project_copy()
    arguments = ["--db", str(project.database)]
    assert CliRunner().invoke(cli, ["pairs", *arguments, "--k", "3"]).exit_code == 0
    newest = image_names(project.database)[-1]
    remove(project.database, (newest,))
    result = CliRunner().invoke(cli, ["match", *arguments])
    assert result.exit_code == 1 and newest in result.stderr


def test_photos_that_were_replaced_since_their_features_are_named(tmp_path: Path) -> None:
    images, database = tmp_path / "images", tmp_path / "project.db"
    images.mkdir()
    for number in range(3):
        save_jpeg(images / f"{number}.jpg", scene(number))
    few = FeatureOptions(max_features=50)
    assert import_photos(images, database, few).bad == []
    assert import_photos(images, database, few).bad == []
    save_jpeg(images / "1.jpg", scene(7))
    for _ in range(2):  # said until it is mended
        ((name, reason),) = import_photos(images, database, few).bad
        assert name == "1.jpg" and "was replaced since its features were extracted" in reason
    with closing(sqlite3.connect(database)) as connection:
        for table in ("keypoints", "descriptors"):
            connection.execute(f"DELETE FROM {table} WHERE image_id = 2")
        connection.commit()
    report = import_photos(images, database, few)
    assert (report.extracted, report.bad) == (1, [])
    assert import_photos(images, database, few).bad == []


def test_a_cache_of_another_project_does_not_bring_its_photos(tmp_path: Path) -> None:
    there, here, photos = (tmp_path / name for name in ("there", "here", "photos"))
    for folder in (there, here, photos, there / "images"):
        folder.mkdir()
    cache = there / "project.netvlad.db"
    with Store(cache) as store:
        store.remember_images(photos)
    assert remembered_images(cache) == photos
    shutil.copy(cache, here)
    assert remembered_images(here / cache.name) is None
    with Store(cache) as store:
        store.remember_images(there / "images")
    shutil.copy(cache, here)
    assert remembered_images(here / cache.name) == here / "images"  # a workspace that was moved
