"""A command reads a project once, and nothing a second time that has not changed."""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_netvlad.cache import photos as cache_photos
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import Database, image_names
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.flight import open_flight
from colmap_netvlad.pairs.rules import PartnerRules
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import InputError

MakeProject = Callable[..., Project]


@contextmanager
def counted_opens(monkeypatch: pytest.MonkeyPatch) -> Iterator[Counter[str]]:
    """Count the files that are opened through sqlite3, by name."""
    opened: Counter[str] = Counter()
    connect = sqlite3.connect

    def counting(path: object, *arguments: object, **options: object) -> sqlite3.Connection:
        opened[Path(str(path).split("?")[0]).name] += 1
        return connect(path, *arguments, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", counting)
        yield opened


@pytest.mark.parametrize("method", ["vlad", "hybrid", "spatial", "random"])
@pytest.mark.parametrize("rules", [PartnerRules(), PartnerRules(other_cameras=0.5, sequential=2)])
def test_pairs_opens_database_and_cache_once(
    method: str,
    rules: PartnerRules,
    project_copy: MakeProject,
    tiny_checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    project = project_copy()
    options = RetrievalOptions(k=3, model=tiny_checkpoint if method == "hybrid" else None)
    with counted_opens(monkeypatch) as opened:
        make_pairs(project, method, options, rules=rules)
    assert opened == {"project.db": 1, "project.netvlad.db": 1}


def test_a_second_run_reads_no_descriptor_and_no_photo(
    project_copy: MakeProject, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy()
    options = RetrievalOptions(k=3, model=tiny_checkpoint, gps="auto")
    first = make_pairs(project, "hybrid", options)

    def refuse(*arguments: object) -> None:
        pytest.fail(f"read again: {arguments}")

    monkeypatch.setattr(Database, "sift_descriptors", refuse)
    monkeypatch.setattr(cache_photos, "photo_fingerprint", refuse)
    monkeypatch.setattr(cache_photos, "read_gps", refuse)
    second = make_pairs(project, "hybrid", options)
    assert second.pairs == first.pairs


def test_ten_new_photos_cost_ten_photos(
    project_copy: MakeProject, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy(copy_photos=True)
    options = RetrievalOptions(k=3, model=tiny_checkpoint, gps="auto")
    make_pairs(project, "hybrid", options)
    changed = image_names(project.database)[:3]
    for name in changed:
        photo = cv2.imread(str(project.need_images() / name))
        cv2.imwrite(str(project.need_images() / name), 255 - photo)
    read: Counter[str] = Counter()
    whole = cache_photos.photo_fingerprint

    def counting(path: Path) -> str:
        read["photo_fingerprint"] += 1
        return whole(path)

    monkeypatch.setattr(cache_photos, "photo_fingerprint", counting)
    report = make_pairs(project, "hybrid", options)
    assert read == {"photo_fingerprint": 3}
    assert any("3 of 12 descriptors computed" in note for note in report.ranking.notes)


def test_a_touched_photo_is_read_again_and_not_described_again(
    project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    project = project_copy(copy_photos=True)
    rank_project(project, tiny_checkpoint, RetrievalOptions(k=3))
    os.utime(project.need_images() / image_names(project.database)[0])
    again = rank_project(project, tiny_checkpoint, RetrievalOptions(k=3))
    assert again.notes[0].startswith("0 of 12 descriptors computed")


def test_features_extracted_anew_with_the_same_count_are_aggregated_anew(
    project_copy: MakeProject,
) -> None:
    project = project_copy()
    rank_project(project, "vlad", RetrievalOptions(k=3))
    with sqlite3.connect(project.database) as connection:
        image, data = connection.execute("SELECT image_id, data FROM descriptors").fetchone()
        connection.execute(
            "UPDATE descriptors SET data = ? WHERE image_id = ?", (data[::-1], image)
        )
    again = rank_project(project, "vlad", RetrievalOptions(k=3))
    assert again.notes[0].startswith("1 of 12 descriptors computed")


def test_photos_seen_through_masks_are_kept_beside_the_whole_ones(
    project_copy: MakeProject, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    project, masks = project_copy(), tmp_path / "masks"
    masks.mkdir()
    for name in image_names(project.database):
        mask = np.full((60, 80), 255, np.uint8)
        mask[:, :40] = 0
        cv2.imwrite(str(masks / f"{name}.png"), mask)
    whole, masked = RetrievalOptions(k=3), RetrievalOptions(k=3, masks=masks)
    rank_project(project, tiny_checkpoint, whole)
    rank_project(project, tiny_checkpoint, masked)
    for options in (whole, masked):
        ranking = rank_project(project, tiny_checkpoint, options)
        assert ranking.notes[0].startswith("0 of 12 descriptors computed")


def test_photos_without_a_mask_are_counted_and_a_folder_of_none_is_refused(
    project_copy: MakeProject, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    project, masks = project_copy(), tmp_path / "masks"
    options = RetrievalOptions(k=3, masks=masks)
    with pytest.raises(InputError, match=r"mask folder .* does not exist; mend `masks`"):
        rank_project(project, tiny_checkpoint, options)
    masks.mkdir()
    with pytest.raises(InputError, match=r"None of the 12 photos has a mask in .*; mend `masks`"):
        rank_project(project, tiny_checkpoint, options)
    for name in image_names(project.database)[1:]:
        cv2.imwrite(str(masks / f"{name}.png"), np.full((60, 80), 255, np.uint8))
    ranking = rank_project(project, tiny_checkpoint, options)
    assert "1 of 12 photos have no mask: described whole" in ranking.notes
    assert not ranking.left_out


def test_positions_come_from_the_database_first(project_copy: MakeProject) -> None:
    project = project_copy()
    with open_flight(project) as flight:
        assert flight.positions.known.all()
        assert flight.names == image_names(project.database)
        assert len(flight.features) == len(flight.images)


def test_a_ranking_is_deep_enough_for_what_follows(project_copy: MakeProject) -> None:
    ranking = rank_project(project_copy(), "vlad", RetrievalOptions(k=3))
    assert ranking.depth == 11, "all others of a small flight, though k is 3"


def test_the_photo_folder_is_remembered(project_copy: MakeProject) -> None:
    project = project_copy()
    with open_flight(project):
        pass
    with Store(project.cache) as store:
        assert store.setting("images") == "images"
