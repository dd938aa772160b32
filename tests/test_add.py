"""New photos cost what is new, and nothing old is lost."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_netvlad.colmap.database import image_names, images_of_pair, open_database
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.commands import add
from colmap_netvlad.commands.add import (
    AddOptions,
    add_lines,
    add_photos,
    newest_model,
    priors_of,
)
from colmap_netvlad.commands.georegister import georegister_in_place
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.geo.georeference import read_frame, read_place
from colmap_netvlad.geo.places import DEFAULT_DEVIATIONS, find_places
from colmap_netvlad.graph.verified import mapped_names
from colmap_netvlad.mapping import contradicted as contradicted_module
from colmap_netvlad.mapping.contradicted import mapping_database, moves_of
from colmap_netvlad.mapping.extend import read_model
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.summary import registered_names
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError

OPTIONS = AddOptions("vlad", RetrievalOptions(k=5), features=FeatureOptions(max_features=1500))
NEW = 3


@pytest.fixture(scope="module")
def built(flight: RenderedFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reconstructed workspace of all but the last three photos. Read only."""
    folder = tmp_path_factory.mktemp("built")
    images = folder / "images"
    images.mkdir()
    for name in flight.names[:-NEW]:
        shutil.copy(flight.images / name, images / name)
    project = Project(folder / "project.db", images)
    extract_features(images, project.database, OPTIONS.features)
    match_pairs(project.database, list(combinations(image_names(project.database), 2)))
    map_incremental(project.database, images, project.sparse, MappingOptions(min_model_size=3))
    return folder


@pytest.fixture
def reconstructed(
    built: Path, flight: RenderedFlight, tmp_path: Path
) -> tuple[Project, list[Path]]:
    """A copy of the workspace, and the three photos it does not have."""
    folder = Path(shutil.copytree(built, tmp_path / "workspace"))
    photos = [flight.images / name for name in flight.names[-NEW:]]
    return Project(folder / "project.db", folder / "images"), photos


def test_new_photos_join_the_model_and_only_their_pairs_are_matched(
    reconstructed: tuple[Project, list[Path]],
) -> None:
    project, photos = reconstructed
    old = image_names(project.database)
    with open_database(project.database) as database:
        matched_before = database.matched_pairs()
    model_before = (project.sparse / "0" / "images.bin").read_bytes()
    assert project.images is not None
    for photo in photos:
        shutil.copy(photo, project.images / photo.name)

    guided = replace(OPTIONS, matching=MatchOptions("guided"))
    report = add_photos(project, newest_model(project), guided)

    assert report.new == sorted(photo.name for photo in photos)
    assert report.unregistered == [] and report.matches.matcher == "guided"
    assert report.after.registered == report.before.registered + NEW
    assert report.matches.matched <= NEW * OPTIONS.retrieval.k
    with open_database(project.database) as database:
        ids = {image.name: image.image_id for image in database.images()}
        added = database.matched_pairs() - matched_before
    new_ids = {ids[name] for name in report.new}
    old_ids = {ids[name] for name in old}
    assert added
    assert all(len({a, b} & new_ids) == 1 and len({a, b} & old_ids) == 1 for a, b in added)
    assert (project.sparse / "0" / "images.bin").read_bytes() == model_before
    assert newest_model(project) == report.output / "0"

    with pytest.raises(InputError, match="no new photos"):
        add_photos(project, newest_model(project), OPTIONS)


def test_photos_that_were_imported_but_never_matched_are_new(
    reconstructed: tuple[Project, list[Path]],
) -> None:
    project, photos = reconstructed
    assert project.images is not None
    for photo in photos:
        shutil.copy(photo, project.images / photo.name)
    extract_features(project.images, project.database, OPTIONS.features)
    report = add_photos(project, None, OPTIONS)
    assert report.new == sorted(photo.name for photo in photos)
    assert report.features.extracted == 0 and report.unregistered == []
    with pytest.raises(InputError, match="no new photos"):
        add_photos(project, None, OPTIONS)


def centres(folder: Path) -> dict[str, np.ndarray]:
    model = pycolmap.Reconstruction(folder)
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image.projection_center() for image in images}


def points(folder: Path) -> dict[tuple[str, int], np.ndarray]:
    """Each observation's point in the world, by the photo's name and the feature."""
    model = pycolmap.Reconstruction(folder)
    return {
        (model.image(seen.image_id).name, seen.point2D_idx): point.xyz
        for point in model.points3D.values()
        for seen in point.track.elements
    }


@pytest.mark.parametrize("adjusted", [False, True])
def test_a_model_in_the_world_stays_there(
    reconstructed: tuple[Project, list[Path]], flight: RenderedFlight, adjusted: bool
) -> None:
    """The rendered photos' EXIF positions are exact, and those of new photos lie to one side.

    A flight that looks straight down hardly tells its focal length, so that more photos change it
    and with it their height over the ground: adjusted with positions, the photos stay, and without,
    the ground does.
    """
    project, photos = reconstructed
    assert project.images is not None
    places = find_places(image_names(project.database), project.database, project.images)
    (placed,) = georegister_in_place(project.sparse, places)
    assert placed.georeference is not None
    gps_std = (0.5, 1.0) if adjusted else None
    stated = replace(placed.georeference, adjusted=adjusted, gps_std=gps_std)
    stated.write(project.sparse / "0")
    frame = read_frame(project.sparse / "0")
    before = points(project.sparse / "0")
    for photo in photos:
        shutil.copy(photo, project.images / photo.name)

    report = add_photos(project, newest_model(project), OPTIONS)

    assert read_frame(report.output / "0") == frame
    photographed = centres(report.output / "0")
    known = find_places(list(photographed), None, project.images, frame)
    apart = np.array(list(photographed.values())) - known.metres
    if not adjusted:
        after = points(report.output / "0")
        both = before.keys() & after.keys()
        moved = [np.linalg.norm(after[seen] - before[seen]) for seen in both]
        assert len(moved) > len(before) / 2 and np.median(moved) < 0.5
        apart -= np.median(apart, axis=0)
    assert len(apart) == len(flight.names) and np.linalg.norm(apart, axis=1).max() < 1.0
    told = json.loads((report.output / "0/georeference.json").read_text())
    assert told["adjusted_with_positions"] is adjusted
    place = read_place(report.output / "0")
    assert place is not None and place.gps_std == gps_std
    assert tuple(priors_of(project, place).deviations[0]) == (
        (0.5, 0.5, 1.0) if adjusted else DEFAULT_DEVIATIONS
    )
    assert set(told["photos"]) == set(flight.names)
    said = "\n".join(add_lines(report))
    stayed = "by their positions, in the same frame" if adjusted else "and the old ground stayed"
    assert f"Photos were added, {stayed}." in said
    assert [path.name for path in report.output.iterdir()] == ["0"]


def test_photos_in_a_folder_of_their_own_are_refused_before_anything_is_written(
    reconstructed: tuple[Project, list[Path]], tmp_path: Path
) -> None:
    project, photos = reconstructed
    elsewhere = tmp_path / "card"
    elsewhere.mkdir()
    shutil.copy(photos[0], elsewhere / photos[0].name)
    before = project.database.read_bytes()
    with pytest.raises(InputError, match="beside the old ones"):
        add_photos(Project(project.database, elsewhere), newest_model(project), OPTIONS)
    assert project.database.read_bytes() == before


def without_pairs(project: Project, *, of: str | None = None) -> None:
    """Take the matches of one photo, or all, out of a database."""
    with closing(sqlite3.connect(project.database)) as connection:
        row = connection.execute("SELECT image_id FROM images WHERE name = ?", (of,)).fetchone()
        for table in ("matches", "two_view_geometries"):
            for (pair,) in connection.execute(f"SELECT pair_id FROM {table}").fetchall():
                if row is None or row[0] in images_of_pair(pair):
                    connection.execute(f"DELETE FROM {table} WHERE pair_id = ?", (pair,))
        connection.commit()


def refusal(project: Project, photo: Path) -> str:
    """Return why a photo cannot be added, which must not write the database."""
    assert project.images is not None
    shutil.copy(photo, project.images / photo.name)
    before = project.database.read_bytes()
    with pytest.raises(InputError) as refused:
        add_photos(project, newest_model(project), OPTIONS)
    assert project.database.read_bytes() == before
    return refused.value.message


def test_a_registered_photo_without_a_verified_pair_is_named_before_anything_is_written(
    reconstructed: tuple[Project, list[Path]],
) -> None:
    project, photos = reconstructed
    without_pairs(project, of="DJI_0003.JPG")
    said = refusal(project, photos[0])
    assert (
        "no verified pair of photos" in said and "(DJI_0003.JPG)" in said and "then `match`" in said
    )


def test_a_model_whose_matches_are_in_a_copy_names_the_copy(
    reconstructed: tuple[Project, list[Path]],
) -> None:
    project, photos = reconstructed
    shutil.copy(project.database, project.folder / "project.copy.db")
    without_pairs(project)
    assert "project.copy.db; name that as `database`" in refusal(project, photos[0])


def test_a_model_of_another_extraction_is_refused_before_anything_is_written(
    reconstructed: tuple[Project, list[Path]],
) -> None:
    project, photos = reconstructed
    with closing(sqlite3.connect(project.database)) as connection:
        for table, size in (("keypoints", "4 * cols"), ("descriptors", "cols")):
            connection.execute(
                f"UPDATE {table} SET rows = 900, data = substr(data, 1, 900 * {size})"
                " WHERE image_id = 2"
            )
        connection.commit()
    assert "made of other features than those in" in refusal(project, photos[0])
    with closing(sqlite3.connect(project.database)) as connection:
        connection.execute("UPDATE images SET name = 'other.jpg' WHERE image_id = 2")
        connection.commit()
    assert "project.db does not have (DJI_0002.JPG)" in refusal(project, photos[0])


def test_a_registered_photo_keeps_its_pairs_where_all_are_contradicted(
    reconstructed: tuple[Project, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP goes on from no model of which it passes over a photo."""
    project, _ = reconstructed
    lone, *others = sorted(image_names(project.database))
    contradicted = [*((lone, other) for other in others), (others[0], others[1])]
    monkeypatch.setattr(contradicted_module, "contradicted_pairs", lambda *_: contradicted)
    model = read_model(newest_model(project))
    with mapping_database(project, moves_of(project), model) as (database, dropped):
        assert dropped == [(others[0], others[1])]
        assert mapped_names(database) >= registered_names([model]) >= {lone}
    with mapping_database(project, moves_of(project)) as (database, dropped):
        assert dropped == contradicted and lone not in mapped_names(database)


def test_a_broken_new_photo_is_one_sentence(reconstructed: tuple[Project, list[Path]]) -> None:
    project, _ = reconstructed
    assert project.images is not None
    (project.images / "broken.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"None of the 1 new photos .*broken\.jpg"):
        add_photos(project, newest_model(project), OPTIONS)


def test_of_several_models_the_largest_is_extended(
    reconstructed: tuple[Project, list[Path]],
) -> None:
    project, _ = reconstructed
    model = pycolmap.Reconstruction(project.sparse / "0")
    (project.sparse / "1").mkdir()
    model.write(project.sparse / "1")
    model.deregister_frame(model.reg_frame_ids()[0])
    model.write(project.sparse / "0")
    assert newest_model(project) == project.sparse / "1"


def test_the_newest_model_is_the_first_of_the_highest_number(
    project_copy: Callable[..., Project],
) -> None:
    project = project_copy()
    for name in ("sparse", "sparse-2", "sparse-10", "sparse-export-11", "sparse-backup"):
        for number in (*range(3), 10):
            folder = project.folder / name / str(number)
            folder.mkdir(parents=True)
            pycolmap.Reconstruction().write(folder)
    assert newest_model(project) == project.folder / "sparse-10" / "0"


def test_without_a_model_it_is_one_sentence(project_copy: Callable[..., Project]) -> None:
    with pytest.raises(InputError, match="no model in"):
        newest_model(project_copy())
    project = project_copy(name="other")
    project.sparse.joinpath("0").mkdir(parents=True)
    assert project.images is not None
    shutil.copy(project.images / "DJI_0001.JPG", project.images / "new.jpg")
    with pytest.raises(InputError, match="is not a COLMAP model"):
        add_photos(project, newest_model(project), OPTIONS)


def stop_an_addition(
    project: Project, photos: Sequence[Path], step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Add photos, and press Ctrl-C where a step of it begins."""
    assert project.images is not None
    for photo in photos:
        shutil.copy(photo, project.images / photo.name)

    def stop(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(add, step, stop)
        with pytest.raises(KeyboardInterrupt):
            add_photos(project, None, OPTIONS)


def test_a_stopped_addition_goes_on_with_the_same_photos(
    reconstructed: tuple[Project, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    project, photos = reconstructed
    # The database has the new photos by then.
    stop_an_addition(project, photos, "match_pairs", monkeypatch)
    report = add_photos(project, newest_model(project), OPTIONS)
    assert report.new == sorted(photo.name for photo in photos)
    assert report.after.registered == report.before.registered + NEW
    with pytest.raises(InputError, match="There are no new photos"):
        add_photos(project, newest_model(project), OPTIONS)


def test_an_addition_stopped_before_its_page_makes_no_other_model(
    reconstructed: tuple[Project, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    project, photos = reconstructed
    stop_an_addition(project, photos, "report_models", monkeypatch)
    extended = project.folder / "sparse-2" / "0"
    made = (extended / "images.bin").read_bytes()
    assert newest_model(project) == extended and not (extended / "report.html").exists()

    report = add_photos(project, None, OPTIONS)
    assert report.output == extended.parent and not (project.folder / "sparse-3").exists()
    assert (extended / "images.bin").read_bytes() == made and (extended / "report.html").exists()
    assert report.new == sorted(photo.name for photo in photos)
    assert report.after.registered == report.before.registered + NEW
    with pytest.raises(InputError, match="There are no new photos"):
        add_photos(project, None, OPTIONS)


def test_an_addition_stopped_after_its_page_is_done(
    reconstructed: tuple[Project, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next photos join the model that it made, and not the one before."""
    project, photos = reconstructed
    # Its last step: the page is written, and the cache still says that it is being added.
    stop_an_addition(project, photos[:-1], "registered_names", monkeypatch)
    with pytest.raises(InputError, match="There are no new photos"):
        add_photos(project, None, OPTIONS)
    assert project.images is not None
    shutil.copy(photos[-1], project.images / photos[-1].name)
    report = add_photos(project, None, OPTIONS)
    assert report.new == [photos[-1].name]
    assert report.output.name == "sparse-3"
    assert (
        report.after.registered == report.before.registered + 1 == len(centres(report.output / "0"))
    )
