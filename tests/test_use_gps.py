"""Positions in the adjustment: against drift and bend, incremental and in parallel."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from PIL import Image

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.commands.georegister import georegister_in_place
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.demo.simulate import (
    FOCAL,
    FRAME,
    SimulationOptions,
    simulate_flight,
    write_gps,
)
from colmap_netvlad.geo.georeference import read_frame
from colmap_netvlad.geo.places import DEFAULT_DEVIATIONS, Places, find_deviations, find_places
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.parallel import map_parallel
from colmap_netvlad.mapping.priors import PositionPriors, write_priors
from colmap_netvlad.mapping.settle import best_similarity
from colmap_netvlad.photos.accuracy import read_deviations
from colmap_netvlad.project import Project

RTK = 0.02
SHARP = SimulationOptions(
    lines=2, photos=8, features=1000, partners=12, noise=0.2, gps=RTK, focal_error=0
)
CORRIDOR = SimulationOptions(lines=2, photos=30, features=150, partners=12, gps=RTK, focal_error=0)


@dataclass(frozen=True)
class Corridor:
    database: Path
    truth: dict[str, np.ndarray]
    places: Places
    priors: PositionPriors


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Corridor:
    database = tmp_path_factory.mktemp("corridor") / "database.db"
    truth = simulate_flight(database, CORRIDOR)
    places = find_places(tuple(truth), database, None)
    priors = PositionPriors(places.names, places.metres, np.full(places.metres.shape, RTK))
    return Corridor(database, truth, places, priors)


def errors(output: Path, corridor: Corridor) -> np.ndarray:
    """Return (N, 3) errors of the camera centres in the world, m."""
    model, frame = pycolmap.Reconstruction(output / "0"), read_frame(output / "0")
    images = [model.image(i) for i in model.reg_image_ids()]
    assert len(images) == len(corridor.truth)
    found = FRAME.from_wgs84(frame.to_wgs84(np.array([i.projection_center() for i in images])))
    return found - np.array([corridor.truth[image.name] for image in images])


@pytest.mark.parametrize("mapper", [map_incremental, map_parallel])
def test_rtk_keeps_a_corridor_within_five_centimetres(
    corridor: Corridor, tmp_path: Path, mapper: object
) -> None:
    before = corridor.database.read_bytes()
    options = MappingOptions(threads=1, cluster_size=25, priors=corridor.priors)
    assert callable(mapper)
    mapper(corridor.database, None, tmp_path / "in", options)
    georegister_in_place(tmp_path / "in", corridor.places, adjusted=True)
    assert np.sqrt((errors(tmp_path / "in", corridor) ** 2).mean(axis=0)).max() < 0.05
    (camera,) = pycolmap.Reconstruction(tmp_path / "in/0").cameras.values()
    assert abs(camera.params[0] / FOCAL - 1) < 2e-3
    assert corridor.database.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize(("noise", "within"), [(2.0, 1.5 * 2.0), (RTK, 0.05)])
def test_rendered_photos_lie_within_the_noise_of_their_gps(
    noise: float,
    within: float,
    flight: RenderedFlight,
    project_copy: Callable[..., Project],
    tmp_path: Path,
) -> None:
    database = project_copy(matched=True).database
    opened = pycolmap.Database.open(database)
    with pycolmap.DatabaseTransaction(opened):
        opened.clear_pose_priors()
        write_gps(opened, list(flight.names), flight.centres, noise, seed=1)
    opened.close()
    places = find_places(flight.names, database, None)
    priors = PositionPriors(places.names, places.metres, np.full(places.metres.shape, noise))
    map_incremental(database, None, tmp_path / "in", MappingOptions(threads=1, priors=priors))
    georegister_in_place(tmp_path / "in", places, adjusted=True)
    truth = dict(zip(flight.names, flight.centres, strict=True))
    error = errors(tmp_path / "in", Corridor(database, truth, places, priors))
    assert np.sqrt((error**2).mean(axis=0)).max() < within


@pytest.mark.parametrize("mapper", [map_incremental, map_parallel])
def test_wrong_matches_do_not_pull_a_camera_from_its_rtk(tmp_path: Path, mapper: object) -> None:
    """A shift and a tilt that make up for each other move what is near the edges by some pixels."""
    database = tmp_path / "database.db"
    truth = simulate_flight(database, SHARP)
    with closing(pycolmap.Database.open(database)) as opened, pycolmap.DatabaseTransaction(opened):
        image = opened.read_image_with_name(list(truth)[4])
        width = opened.read_camera(image.camera_id).width
        keypoints = opened.read_keypoints(image.image_id).copy()
        edge = np.flatnonzero(abs(keypoints[:, 0] - width / 2) > width / 4)
        wrong = np.random.default_rng(0).choice(edge, len(keypoints) // 5, replace=False)
        keypoints[wrong, 0] += 3
        opened.update_keypoints(image.image_id, keypoints)
    places = find_places(tuple(truth), database, None)
    priors = PositionPriors(places.names, places.metres, np.full(places.metres.shape, RTK))
    assert callable(mapper)
    mapper(
        database, None, tmp_path / "in", MappingOptions(threads=1, cluster_size=8, priors=priors)
    )
    georegister_in_place(tmp_path / "in", places, adjusted=True)
    assert np.abs(errors(tmp_path / "in", Corridor(database, truth, places, priors))).max() < 0.06


def test_the_best_similarity_brings_a_moved_model_back() -> None:
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=10))
    images = [model.image(i) for i in model.reg_image_ids()]
    centres = np.array([image.projection_center() for image in images])
    known = centres.copy()
    known[3] += [40, 0, 0]
    known[4] = np.nan
    known[5, 2] = np.nan
    names = tuple(image.name for image in images)
    deviations = np.full(known.shape, 0.1)
    turn = pycolmap.Rotation3d(np.array([0.02, -0.01, 0.03]))
    model.transform(pycolmap.Sim3d(1.02, turn, np.array([0.3, -0.2, 0.1])))
    model.transform(best_similarity(model, PositionPriors(names, known, deviations)))
    found = np.array([image.projection_center() for image in images])
    assert found == pytest.approx(centres, abs=0.01)
    stays = best_similarity(model, PositionPriors(names[:2], known[:2], deviations[:2]))
    assert (stays.matrix() == pycolmap.Sim3d().matrix()).all()


def test_without_priors_in_the_adjustment_the_corridor_bends(
    corridor: Corridor, tmp_path: Path
) -> None:
    map_incremental(corridor.database, None, tmp_path / "after", MappingOptions(threads=1))
    georegister_in_place(tmp_path / "after", corridor.places)
    assert np.abs(errors(tmp_path / "after", corridor)).max() > 0.1


def test_wild_priors_have_little_say(corridor: Corridor, tmp_path: Path) -> None:
    metres = corridor.priors.metres.copy()
    metres[7] += [30, -20, 15]
    metres[8] = np.nan
    metres[9, 2] = np.nan
    priors = replace(corridor.priors, metres=metres)
    map_incremental(
        corridor.database, None, tmp_path / "in", MappingOptions(threads=1, priors=priors)
    )
    georegister_in_place(tmp_path / "in", replace(corridor.places, metres=metres), adjusted=True)
    assert np.abs(errors(tmp_path / "in", corridor)).max() < 0.25


def test_other_priors_are_other_clusters(corridor: Corridor) -> None:
    other = replace(corridor.priors, deviations=corridor.priors.deviations * 2)
    assert other.fingerprint() != corridor.priors.fingerprint()
    assert replace(corridor.priors).fingerprint() == corridor.priors.fingerprint()


def test_the_command_says_what_it_took_for_accuracy(corridor: Corridor, tmp_path: Path) -> None:
    shutil.copy(corridor.database, tmp_path / "database.db")
    first, second = list(corridor.truth)[:2]
    (tmp_path / "pairs.txt").write_text(f"{first} {second}\n")
    asked = ["reconstruct", "--db", str(tmp_path / "database.db"), "--use-gps", "--threads", "1"]
    result = CliRunner().invoke(cli, [*asked, "--gps-std", "0.02", "0.03"])
    assert result.exit_code == 0, result.output
    assert "standard deviation 0.02 m horizontally, 0.03 m vertically" in result.output
    assert np.sqrt((errors(tmp_path / "sparse", corridor) ** 2).mean(axis=0)).max() < 0.05


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--use-gps", "--mapper", "global"], "The mapper global cannot adjust with positions"),
        (["--gps-std", "1", "2"], "--use-gps"),
        (["--use-gps", "--gps-std", "0", "2"], "0"),
    ],
)
def test_what_does_not_go_together_is_said(
    corridor: Corridor, arguments: list[str], said: str
) -> None:
    result = CliRunner().invoke(cli, ["reconstruct", "--db", str(corridor.database), *arguments])
    assert result.exit_code != 0
    assert said in result.output


def test_accuracy_comes_from_the_database_then_the_photo_then_the_default(
    corridor: Corridor, tmp_path: Path
) -> None:
    database = tmp_path / "database.db"
    shutil.copy(corridor.database, database)
    names = list(corridor.truth)
    write_priors(database, replace(corridor.priors, names=(names[0],), **_first(corridor)))
    with open_database(database) as opened:
        assert list(opened.position_deviations().values()) == [pytest.approx((RTK, RTK, RTK))]
    photo(tmp_path / names[1], RTK_ATTRIBUTES)
    photo(tmp_path / names[2], RTK_ELEMENTS)
    photo(tmp_path / names[3], "")
    found, stating = find_deviations(names[:4], database, tmp_path)
    assert stating == 3
    assert found[0] == pytest.approx((RTK, RTK, RTK))
    assert found[1].tolist() == [0.011, 0.012, 0.025]
    assert found[2].tolist() == [0.021, 0.022, 0.035]
    assert found[3].tolist() == list(DEFAULT_DEVIATIONS)
    given, _ = find_deviations(names[:4], database, tmp_path, (0.5, 1.0))
    assert given.tolist() == [[0.5, 0.5, 1.0]] * 4


def _first(corridor: Corridor) -> dict[str, np.ndarray]:
    return {"metres": corridor.priors.metres[:1], "deviations": corridor.priors.deviations[:1]}


RTK_ATTRIBUTES = (
    '<rdf:Description drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.01100" '
    'drone-dji:RtkStdLat="0.01200" drone-dji:RtkStdHgt="0.02500"/>'
)
RTK_ELEMENTS = (
    "<drone-dji:RtkStdLon>0.021</drone-dji:RtkStdLon><drone-dji:RtkStdLat>0.022"
    "</drone-dji:RtkStdLat><drone-dji:RtkStdHgt>0.035</drone-dji:RtkStdHgt>"
)


def photo(path: Path, properties: str) -> None:
    block = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF>{properties}</rdf:RDF></x:xmpmeta>'
    Image.new("RGB", (32, 32)).save(path, xmp=block.encode())


@pytest.mark.parametrize("content", [b"", b"no photo"])
def test_a_photo_that_states_nothing_readable_has_the_default(
    tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    assert read_deviations(tmp_path / "a.jpg") is None
    assert read_deviations(tmp_path / "missing.jpg") is None


def test_exif_s_positioning_error_counts(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8825)[31] = 0.4
    Image.new("RGB", (32, 32)).save(tmp_path / "a.jpg", exif=exif)
    assert read_deviations(tmp_path / "a.jpg") == pytest.approx((0.4, 0.4, 0.6))
