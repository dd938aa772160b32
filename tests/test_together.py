"""Models of several flights put together: one solve for all, nothing doubled, nothing lost."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from scipy.spatial import KDTree

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.copies import copy_images
from colmap_netvlad.commands import merge as command
from colmap_netvlad.commands.merge import MergeOptions, merge_lines, merge_models, pairs_across
from colmap_netvlad.demo.simulate import SimulationOptions, simulate_flight
from colmap_netvlad.mapping import parallel
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.merge import SubModel, read_sub_model
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.together import database_cameras, matches_across, put_together
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError

FLIGHT = SimulationOptions(lines=6, photos=8, features=200, partners=14)
OPTIONS = MappingOptions(threads=1)


@dataclass(frozen=True)
class Flights:
    """Three models of two lines each that share no photo, and one model of all."""

    database: Path
    truth: dict[str, np.ndarray]
    models: list[Path]
    whole: pycolmap.Reconstruction

    @property
    def project(self) -> Project:
        return Project(self.database, None)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Flights:
    folder = tmp_path_factory.mktemp("flights")
    database = folder / "database.db"
    truth = simulate_flight(database, FLIGHT)
    names = list(truth)
    models = []
    for number in range(3):
        target = folder / f"flight {number} ü"
        target.mkdir()
        own = names[16 * number : 16 * (number + 1)]
        parallel.map_cluster(lambda count: None, database, target, own, OPTIONS, 1)
        models.append(target / "0")
    (whole,) = map_incremental(database, None, folder / "whole", OPTIONS)
    return Flights(database, truth, models, whole)


@pytest.fixture
def own(flights: Flights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Flights:
    """The flights with a database of their own, and neighbours in space as ranking."""

    def neighbours(project: Project, options: MergeOptions) -> Ranking:
        names = tuple(flights.truth)
        centres = np.array(list(flights.truth.values()))
        distance, nearest = KDTree(centres).query(centres, 40)
        return Ranking(names, nearest[:, 1:].astype(np.int32), -distance[:, 1:], "test")

    monkeypatch.setattr(command, "_ranking", neighbours)
    shutil.copy(flights.database, tmp_path / "database.db")
    return Flights(tmp_path / "database.db", flights.truth, flights.models, flights.whole)


def errors(model: pycolmap.Reconstruction, truth: dict[str, np.ndarray]) -> np.ndarray:
    """Return (N,) errors of camera centres after the best similarity, m."""
    images = [model.image(i) for i in model.reg_image_ids()]
    found = np.array([image.projection_center() for image in images])
    true = np.array([truth[image.name] for image in images])
    matrix = pycolmap.estimate_sim3d(found, true).matrix()
    return np.linalg.norm(found @ matrix[:, :3].T + matrix[:, 3] - true, axis=1)


def sub_models(flights: Flights) -> list[SubModel]:
    return [read_sub_model(str(path), pycolmap.Reconstruction(path)) for path in flights.models]


def test_three_flights_become_one_as_good_as_made_at_once(own: Flights, tmp_path: Path) -> None:
    before = [(path / "images.bin").read_bytes() for path in own.models]
    report = merge_models(own.project, own.models, tmp_path / "out", MergeOptions(across=8))
    assert [len(members) for members in report.members] == [3]
    model = pycolmap.Reconstruction(tmp_path / "out/0")
    assert model.num_reg_images() == len(own.truth)
    extent = np.ptp(np.array(list(own.truth.values())), axis=0).max()
    assert errors(model, own.truth).max() < 1.5 * errors(own.whole, own.truth).max()
    assert errors(model, own.truth).max() < 5e-3 * extent
    assert before == [(path / "images.bin").read_bytes() for path in own.models]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["0"]


def test_a_model_whose_name_another_run_took_meanwhile_gets_the_next(
    own: Flights, monkeypatch: pytest.MonkeyPatch
) -> None:
    def while_another_ends(project: Project, *_: object) -> list[object]:
        (project.sparse / "0").mkdir(parents=True)
        return []

    monkeypatch.setattr(command, "_georegister", while_another_ends)
    report = merge_models(own.project, own.models, options=MergeOptions(across=8))
    assert report.output == own.project.folder / "sparse-2"
    assert pycolmap.Reconstruction(report.output / "0").num_reg_images() == len(own.truth)


def test_nothing_is_doubled(own: Flights, tmp_path: Path) -> None:
    """Matched points are one point: tracks run across flights as in the model made at once."""
    merge_models(own.project, own.models, tmp_path / "out", MergeOptions(across=8))
    merged = pycolmap.Reconstruction(tmp_path / "out/0")
    home = {name: number // 16 for number, name in enumerate(own.truth)}

    def crossing(model: pycolmap.Reconstruction) -> int:
        names = {i: model.image(i).name for i in model.reg_image_ids()}
        return sum(
            len({home[names[element.image_id]] for element in point.track.elements}) > 1
            for point in model.points3D.values()
        )

    assert crossing(merged) > 0.95 * crossing(own.whole)
    assert merged.num_points3D() == pytest.approx(own.whole.num_points3D(), rel=0.02)
    assert merged.compute_mean_track_length() == pytest.approx(
        own.whole.compute_mean_track_length(), rel=0.02
    )


def test_all_similarities_are_solved_at_once(flights: Flights) -> None:
    """Before any adjustment the joined model is better than its worst link alone would make it."""
    models = sub_models(flights)
    homes = [set(model.poses) for model in models]
    (joined,) = put_together(models, matches_across(flights.database, homes))
    assert len(joined.members) == 3
    assert (
        joined.members[0] == max(models, key=lambda model: (len(model.poses), len(model.xyz))).name
    )
    names = {image.image_id: image.name for image in flights.whole.images.values()}
    found = np.array([-p.matrix()[:, :3].T @ p.matrix()[:, 3] for p in joined.model.poses.values()])
    true = np.array([flights.truth[names[i]] for i in joined.model.poses])
    matrix = pycolmap.estimate_sim3d(found, true).matrix()
    apart = np.linalg.norm(found @ matrix[:, :3].T + matrix[:, 3] - true, axis=1)
    assert apart.max() < 2.0


def test_a_model_that_does_not_fit_stays_and_is_named(own: Flights, tmp_path: Path) -> None:
    bent = pycolmap.Reconstruction(own.models[2])
    rng = np.random.default_rng(0)
    for point in bent.points3D.values():
        point.xyz = point.xyz + rng.normal(0, 5, 3)
    (tmp_path / "bent").mkdir()
    bent.write(tmp_path / "bent")
    report = merge_models(
        own.project, [*own.models[:2], tmp_path / "bent"], tmp_path / "out", MergeOptions(across=8)
    )
    assert sorted(len(members) for members in report.members) == [1, 2]
    said = "\n".join(merge_lines(report))
    assert f"Not joined: {tmp_path / 'bent'}:" in said
    assert "unchanged" in said
    kept = pycolmap.Reconstruction(tmp_path / "out/1")
    assert kept.num_reg_images() == 16
    assert kept.num_points3D() == bent.num_points3D()


def test_models_without_a_match_across_stay(own: Flights, tmp_path: Path) -> None:
    import sqlite3
    from contextlib import closing

    with closing(sqlite3.connect(own.database)) as database:
        database.execute("UPDATE two_view_geometries SET rows = 0, data = NULL")
        database.commit()
    report = merge_models(own.project, own.models[:2], tmp_path / "out", MergeOptions(across=8))
    assert [len(members) for members in report.members] == [1, 1]
    assert "no verified match joins it" in "\n".join(merge_lines(report))


def test_models_of_two_projects_in_one_database(flights: Flights, tmp_path: Path) -> None:
    """COLMAP's database_merger numbers images and cameras anew: each keeps its own lens."""
    models, halves = [], [list(flights.truth)[:16], list(flights.truth)[16:32]]
    for number, names in enumerate(halves):
        copy_images(flights.database, tmp_path / f"{number}.db", names)
        model = pycolmap.Reconstruction(flights.models[number])
        model.cameras[1].params = [700.0 + number, *model.cameras[1].params[1:]]
        models.append(model)
    opened = [pycolmap.Database.open(tmp_path / f"{i}.db") for i in (0, 1)]
    together = pycolmap.Database.open(tmp_path / "together.db")
    pycolmap.Database.merge(*opened, together)
    camera_of = {image.image_id: image.camera_id for image in together.read_all_images()}
    assert len(set(camera_of.values())) == 2
    for number, model in enumerate(models):
        model.transcribe_image_ids_to_database(together)
        ((camera_id, (params, count)),) = database_cameras(model, camera_of).items()
        assert (params[0], count) == (700 + number, 16)
        assert camera_id == camera_of[next(iter(model.reg_image_ids()))]
    for database in (*opened, together):
        database.close()


def test_only_pairs_across_are_asked_for() -> None:
    partners = np.array([[1, 2, 3], [0, 2, 3], [3, 0, 1], [2, 0, 1]], np.int32)
    ranking = Ranking(("a", "b", "c", "d"), partners, np.zeros((4, 3)), "test")
    assert pairs_across(ranking, [{"a", "b"}, {"c"}], 1) == [("a", "c"), ("b", "c")]
    assert pairs_across(ranking, [{"a", "b"}, {"b", "c", "d"}], 1) == [("a", "c"), ("a", "d")]


@pytest.mark.parametrize("which", ["one", "stranger", "namesake", "none"])
def test_bad_input_is_one_sentence(own: Flights, tmp_path: Path, which: str) -> None:
    sparse = {"one": own.models[:1], "none": [tmp_path / "x", tmp_path / "y"]}.get(which)
    said = {
        "one": "One model alone",
        "none": "holds no COLMAP model",
        "stranger": "not in",
        "namesake": "Put photos with equal names into two folders of one",
    }[which]
    if sparse is None:
        model = pycolmap.Reconstruction(own.models[0])
        image = next(iter(model.images.values()))
        image.name = "other.jpg" if which == "stranger" else list(own.truth)[-1]
        (tmp_path / "strange").mkdir()
        model.write(tmp_path / "strange")
        sparse = [tmp_path / "strange", own.models[1]]
    arguments = [part for path in sparse for part in ("--sparse", str(path))]
    result = CliRunner().invoke(cli, ["merge", "--db", str(own.database), *arguments])
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    assert said in result.output
    with pytest.raises(InputError):
        merge_models(own.project, sparse, tmp_path / "out")
    assert not (tmp_path / "out").exists()
