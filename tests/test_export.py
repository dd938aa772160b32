"""Exports: each opened by the library its users open it with, and held against the truth."""

from __future__ import annotations

import csv
import json
import math
import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner, Result
from pyproj import CRS, Proj, Transformer
from pyproj.transformer import TransformerGroup

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names
from colmap_netvlad.commands.georegister import georegister_in_place
from colmap_netvlad.demo.simulate import FRAME, SimulationOptions, simulate_flight
from colmap_netvlad.export.geojson import footprint
from colmap_netvlad.export.table import omega_phi_kappa
from colmap_netvlad.export.world import World
from colmap_netvlad.geo.frames import LocalFrame
from colmap_netvlad.geo.places import find_places
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions

FLIGHT = SimulationOptions(
    lines=3, photos=6, features=250, partners=10, noise=0.1, gps=0.01, focal_error=0
)
UTM = CRS.from_epsg(32630)


@dataclass(frozen=True)
class Exported:
    folder: Path
    truth: dict[str, np.ndarray]
    out: Path
    said: str


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    folder = tmp_path_factory.mktemp("export ü")
    database = folder / "database.db"
    truth = simulate_flight(database, FLIGHT)
    map_incremental(database, None, folder / "sparse", MappingOptions(threads=1))
    georegister_in_place(folder / "sparse", find_places(image_names(database), database, None))
    result = run("export", "--sparse", folder / "sparse/0", "--output", folder / "out")
    assert result.exit_code == 0, result.output
    return Exported(folder, truth, folder / "out", result.output)


def true_utm(truth: dict[str, np.ndarray], name: str) -> np.ndarray:
    return FRAME.to_crs(truth[name][None], UTM)[0]


def gdal(path: Path) -> tuple[dict, list[bytes], dict[str, np.ndarray]]:
    raw = pytest.importorskip("pyogrio.raw", reason="needs pyogrio (dev)")
    meta, _, geometry, columns = raw.read(path)
    return meta, list(geometry), dict(zip(meta["fields"], columns, strict=True))


def test_everything_is_written(exported: Exported) -> None:
    names = {path.name for path in exported.out.iterdir()}
    assert names == {
        "cameras.geojson", "footprints.geojson", "pairs.geojson", "shots.geojson", "cameras.csv",
        "points.las", "points.ply", "text",
    }  # fmt: skip
    assert "WGS 84 / UTM zone 30N" in exported.said


@pytest.mark.parametrize(
    ("file", "kind", "count"),
    [
        ("cameras.geojson", "Point", 18),
        ("shots.geojson", "Point", 18),
        ("footprints.geojson", "Polygon", 18),
        ("pairs.geojson", "LineString", None),
    ],
)
def test_gdal_reads_geojson(exported: Exported, file: str, kind: str, count: int | None) -> None:
    meta, geometry, _ = gdal(exported.out / file)
    assert meta["geometry_type"].startswith(kind)
    assert meta["crs"] in ("EPSG:4326", "EPSG:4979")  # with heights
    assert len(geometry) == count if count else len(geometry) > 30


def test_cameras_lie_at_their_longitude_and_latitude(exported: Exported) -> None:
    for one in json.loads((exported.out / "cameras.geojson").read_text("utf-8"))["features"]:
        longitude, latitude, height = one["geometry"]["coordinates"]
        true = exported.truth[one["properties"]["name"]]
        found = FRAME.from_wgs84(np.array([[latitude, longitude, height]]))[0]
        assert np.linalg.norm(found - true) < 0.2


def test_footprints_are_where_the_camera_looks(exported: Exported) -> None:
    width, height = 1000 / 800 * 100, 750 / 800 * 100
    to_utm = Transformer.from_crs(4326, 32630, always_xy=True)
    for one in json.loads((exported.out / "footprints.geojson").read_text("utf-8"))["features"]:
        ring = np.array([to_utm.transform(*place) for place in one["geometry"]["coordinates"][0]])
        assert ring[0].tolist() == ring[-1].tolist()
        x, y = ring[:-1].T
        area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        assert area == pytest.approx(width * height, rel=0.25)  # > 0: counterclockwise
        middle = ring[:-1].mean(axis=0)
        assert np.linalg.norm(middle - true_utm(exported.truth, one["properties"]["name"])[:2]) < 15


def test_pairs_are_the_verified_ones_and_weak_links_are_marked(exported: Exported) -> None:
    rows = json.loads((exported.out / "pairs.geojson").read_text("utf-8"))["features"]
    database = pycolmap.Database.open(exported.folder / "database.db")
    verified = sum(
        len(geometry.inlier_matches) > 0 for geometry in database.read_two_view_geometries()[1]
    )
    database.close()
    assert len(rows) == verified
    assert not any(row["properties"]["weak"] for row in rows)


def test_without_a_database_pairs_are_those_with_common_points(
    exported: Exported, tmp_path: Path
) -> None:
    shutil.copytree(exported.folder / "sparse/0", tmp_path / "model")
    result = run("export", "--sparse", tmp_path / "model", "--format", "pairs")
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "model-export/pairs.geojson").read_text("utf-8"))["features"]
    assert len(rows) > 30
    assert min(row["properties"]["matches"] for row in rows) >= 15


def test_the_table_holds_easting_northing_and_angles(exported: Exported) -> None:
    model = pycolmap.Reconstruction(exported.folder / "sparse/0")
    by_name = {image.name: image for image in model.images.values()}
    with (exported.out / "cameras.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 18
    for row in rows:
        place = np.array([float(row[key]) for key in ("easting", "northing", "height")])
        assert np.linalg.norm(place - true_utm(exported.truth, row["name"])) < 0.2
        # An image's angles are small, or kappa is half a turn, on lines flown back.
        omega, phi, kappa = (float(row[key]) for key in ("omega", "phi", "kappa"))
        assert abs(omega) < 8 and abs(phi) < 8
        assert min(abs(kappa), abs(abs(kappa) - 180)) < 10
        frame_angles = omega_phi_kappa(
            by_name[row["name"]].cam_from_world().rotation.matrix()[None]
        )
        # Grid north is not the local frame's north.
        convergence = Proj(UTM).get_factors(-1.4701, 53.3811).meridian_convergence
        turned = (kappa - frame_angles[0, 2] - convergence + 180) % 360 - 180
        assert abs(turned) < 0.02


def test_angles_rebuild_the_rotation() -> None:
    rng = np.random.default_rng(0)
    for omega, phi, kappa in rng.uniform([-180, -89, -180], [180, 89, 180], (50, 3)):
        o, p, k = np.radians([omega, phi, kappa])
        about_x = np.array(
            [[1, 0, 0], [0, math.cos(o), -math.sin(o)], [0, math.sin(o), math.cos(o)]]
        )
        about_y = np.array(
            [[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]]
        )
        about_z = np.array(
            [[math.cos(k), -math.sin(k), 0], [math.sin(k), math.cos(k), 0], [0, 0, 1]]
        )
        world_from_photo = about_x @ about_y @ about_z
        colmap = np.diag([1.0, -1.0, -1.0]) @ world_from_photo.T
        assert omega_phi_kappa(colmap[None])[0] == pytest.approx([omega, phi, kappa], abs=1e-9)


def test_laspy_reads_the_points_with_their_system(exported: Exported) -> None:
    import laspy

    cloud = laspy.read(exported.out / "points.las")
    model = pycolmap.Reconstruction(exported.folder / "sparse/0")
    assert len(cloud) == model.num_points3D()
    assert cloud.header.parse_crs().to_epsg() == 32630
    centre = np.median(np.array([true_utm(exported.truth, n) for n in exported.truth]), axis=0)
    middle = np.array([np.median(cloud.x), np.median(cloud.y), np.median(cloud.z)])
    assert np.abs(middle[:2] - centre[:2]).max() < 15
    assert -10 < middle[2] < 20  # on the ground
    assert cloud.z.max() < 30


def test_ply_and_text_are_read(exported: Exported) -> None:
    plyfile = pytest.importorskip("plyfile", reason="needs plyfile (dev)")
    model = pycolmap.Reconstruction(exported.folder / "sparse/0")
    points = plyfile.PlyData.read(str(exported.out / "points.ply"))["vertex"]
    assert len(points) == model.num_points3D()
    text = pycolmap.Reconstruction(exported.out / "text")
    assert text.num_reg_images() == 18


def test_shots_are_in_opendronemap_s_layout(exported: Exported) -> None:
    import cv2

    rows = json.loads((exported.out / "shots.geojson").read_text("utf-8"))["features"]
    for row in rows:
        said = row["properties"]
        assert set(said) == {"filename", "focal", "width", "height", "translation", "rotation"}
        assert (said["width"], said["height"]) == (1000, 750)
        assert said["focal"] == pytest.approx(0.8, rel=0.01)
        true = true_utm(exported.truth, said["filename"])
        assert np.linalg.norm(np.array(said["translation"]) - true) < 0.2
        matrix, _ = cv2.Rodrigues(np.array(said["rotation"]))
        # A point below the camera is ahead of it, as in OpenSfM.
        assert (matrix @ np.array([0, 0, -1.0]))[2] > 0.98


def test_another_system(exported: Exported, tmp_path: Path) -> None:
    arguments = ("--format", "csv", "--crs", "EPSG:27700", "--output", tmp_path / "osgb")
    result = run("export", "--sparse", exported.folder / "sparse/0", *arguments)
    assert result.exit_code == 0, result.output
    with (tmp_path / "osgb/cameras.csv").open() as file:
        row = next(csv.DictReader(file))
    latitude, longitude, _ = FRAME.to_wgs84(exported.truth[row["name"]][None])[0]
    east, north = Transformer.from_crs(4326, 27700, always_xy=True).transform(longitude, latitude)
    assert math.hypot(float(row["easting"]) - east, float(row["northing"]) - north) < 0.2
    said = "OSGB36 / British National Grid is good to 2 m: PROJ lacks uk_os_OSTN15"
    assert (said in result.output) != finds_all_grids("EPSG:27700")
    assert "PROJ" not in exported.said  # UTM needs no grid


def finds_all_grids(system: str) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return TransformerGroup("EPSG:4326", system).best_available


def test_ten_models_have_a_folder_each(exported: Exported, tmp_path: Path) -> None:
    for number in range(10):
        shutil.copytree(exported.folder / "sparse/0", tmp_path / f"sparse/{number}")
    result = run("export", "--sparse", tmp_path / "sparse", "--format", "cameras")
    assert result.exit_code == 0, result.output
    assert len(list((tmp_path / "sparse-export").glob("*/cameras.geojson"))) == 10


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--crs", "EPSG:1"), "is not known"),
        (("--crs", "EPSG:4326"), "is in degrees"),
        (("--crs", "EPSG:2193"), "is for another part of the world (New Zealand"),
        (("--output", "OUT"), "exists already"),
    ],
)
def test_bad_input_is_one_sentence(
    exported: Exported, arguments: tuple[str, ...], said: str
) -> None:
    given = [str(exported.out) if one == "OUT" else one for one in arguments]
    result = run("export", "--sparse", exported.folder / "sparse/0", *given)
    assert result.exit_code == 1
    assert said in result.output


def test_a_model_that_is_not_in_the_world_says_what_to_do(
    exported: Exported, tmp_path: Path
) -> None:
    pycolmap.Reconstruction(exported.folder / "sparse/0").write(tmp_path)
    result = run("export", "--sparse", tmp_path, "--output", tmp_path / "out")
    assert result.exit_code == 1
    assert "run `colmap-netvlad georegister" in result.output
    plain = run("export", "--sparse", tmp_path, "--output", tmp_path / "out", "--format", "ply")
    assert plain.exit_code == 0, plain.output


def test_a_photo_to_the_horizon_has_no_footprint(exported: Exported) -> None:
    model = pycolmap.Reconstruction(exported.folder / "sparse/0")
    image = model.image(model.reg_image_ids()[0])
    assert footprint(model, image) is not None
    pose = image.cam_from_world()
    tilt = pycolmap.Rotation3d(np.array([math.radians(70), 0, 0]))
    about = pycolmap.Rigid3d(tilt, np.zeros(3))
    image.frame.set_cam_from_world(image.camera_id, about * pose)
    assert footprint(model, image) is None


def test_a_lens_without_rays_in_the_corners_has_no_footprint(exported: Exported) -> None:
    model = pycolmap.Reconstruction(exported.folder / "sparse/0")
    image = model.image(model.reg_image_ids()[0])
    camera = model.camera(image.camera_id)
    camera.params = [*camera.params[:3], -1.2]  # an action camera's k1
    assert np.isnan(camera.cam_from_img([[0.0, 0.0]])).all()
    assert footprint(model, image) is None


@pytest.mark.parametrize("latitude", [-33.9, 0.0, 61.0])
def test_frames_and_systems_there_and_back(latitude: float) -> None:
    frame = LocalFrame(latitude, 18.4)
    places = np.random.default_rng(0).uniform(-2000, 2000, (20, 3))
    system = CRS.from_epsg(frame.epsg)
    assert frame.from_crs(frame.to_crs(places, system), system) == pytest.approx(places, abs=1e-4)
    assert frame.from_wgs84(frame.to_wgs84(places)) == pytest.approx(places, abs=1e-6)


FOOT = 1200 / 3937
"""m of a US survey foot."""


@pytest.mark.parametrize(
    ("system", "metres"),
    [
        ("EPSG:2263", FOOT),
        ("EPSG:2263+6360", FOOT),
        ("EPSG:2263+5703", 1.0),
        ("EPSG:32618", 1.0),
        ("EPSG:4326", 1.0),
    ],
)
def test_heights_are_in_the_unit_of_the_system(system: str, metres: float) -> None:
    frame, crs = LocalFrame(40.8, -73.1), CRS.from_user_input(system)
    places = np.array([[0.0, 0.0, 30.0], [200.0, -100.0, 0.0]])
    there = frame.to_crs(places, crs)
    assert there[0, 2] == pytest.approx(30 / metres, abs=1e-6)
    assert frame.from_crs(there, crs) == pytest.approx(places, abs=1e-4)
    plain = Transformer.from_crs(4326, CRS.from_user_input(system.split("+")[0]), always_xy=True)
    assert there[0, :2] == pytest.approx(plain.transform(-73.1, 40.8), abs=1e-6)


def test_outlines_do_not_go_around_the_globe(exported: Exported) -> None:
    model = pycolmap.Reconstruction(exported.folder / "sparse/0")
    world = World(model, LocalFrame(-17.0, 179.9999), CRS.from_epsg(32760))
    assert np.ptp(world.wgs84[:, 1]) < 0.01
