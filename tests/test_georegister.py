"""Any model in the world: `georegister`, and `reconstruct --georegister`."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner, Result
from PIL import Image

from colmap_netvlad.cli import cli
from colmap_netvlad.demo.exif import Exif, add_exif
from colmap_netvlad.demo.simulate import FRAME, SimulationOptions, simulate_flight
from colmap_netvlad.geo.frames import LocalFrame
from colmap_netvlad.geo.georeference import read_frame
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions

NOISE = 1.5
FLIGHT = SimulationOptions(lines=3, photos=6, features=150, partners=10, gps=NOISE)


@dataclass(frozen=True)
class Mapped:
    """A simulated flight with GPS, and its model in COLMAP's own frame."""

    folder: Path
    truth: dict[str, np.ndarray]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    folder = tmp_path_factory.mktemp("geo")
    truth = simulate_flight(folder / "database.db", FLIGHT)
    (model,) = map_incremental(
        folder / "database.db", None, folder / "sparse", MappingOptions(threads=1)
    )
    assert model.num_reg_images() == len(truth)
    return Mapped(folder, truth)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def errors(folder: Path, truth: dict[str, np.ndarray]) -> np.ndarray:
    """Return (N, 3) errors of camera centres, m, from the true ones, through WGS84."""
    model = pycolmap.Reconstruction(folder)
    frame = read_frame(folder)
    images = [model.image(i) for i in model.reg_image_ids()]
    found = frame.to_wgs84(np.array([image.projection_center() for image in images]))
    return FRAME.from_wgs84(found) - np.array([truth[image.name] for image in images])


def sentence(result: Result) -> str:
    """Return the error of a command that failed in one sentence, without a traceback."""
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output
    return result.output


def test_a_model_lies_where_its_gps_says(mapped: Mapped, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in (mapped.folder / "sparse/0").iterdir()}
    result = run("georegister", "--sparse", mapped.folder / "sparse", "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert np.sqrt((errors(tmp_path / "out/0", mapped.truth) ** 2).mean()) < NOISE
    told = json.loads((tmp_path / "out/0/georeference.json").read_text())
    assert told["epsg"] == 32630
    assert told["residuals"]["horizontal_rms"] == pytest.approx(NOISE * 2**0.5, rel=0.4)
    assert told["residuals"]["photos"] == len(told["photos"]) == len(mapped.truth)
    assert "EPSG 32630" in result.output
    assert "Heights are as the photos state them; no geoid model is applied." in result.output
    assert before == {path: path.read_bytes() for path in (mapped.folder / "sparse/0").iterdir()}


def test_distances_are_metres_and_reprojection_stays(mapped: Mapped, tmp_path: Path) -> None:
    run("georegister", "--sparse", mapped.folder / "sparse/0", "--output", tmp_path / "out")
    old, new = (pycolmap.Reconstruction(p) for p in (mapped.folder / "sparse/0", tmp_path / "out"))
    old.update_point_3d_errors()
    new.update_point_3d_errors()
    assert new.compute_mean_reprojection_error() == pytest.approx(
        old.compute_mean_reprojection_error(), rel=1e-6
    )
    true = np.array(list(mapped.truth.values()))
    found = {i.name: i.projection_center() for i in new.images.values()}
    same = np.array([found[name] for name in mapped.truth])
    assert np.linalg.norm(same[0] - same[-1]) == pytest.approx(
        np.linalg.norm(true[0] - true[-1]), rel=0.05
    )


def with_photos(folder: Path, truth: dict[str, np.ndarray], frame: LocalFrame) -> Path:
    """Write tiny photos with EXIF GPS of the true places in a frame."""
    tiny = folder / "tiny.jpg"
    Image.new("RGB", (16, 16)).save(tiny)
    images = folder / "fotos mit Umlaut ü"
    images.mkdir()
    for name, centre in truth.items():
        latitude, longitude, height = frame.to_wgs84(centre[None])[0].tolist()
        exif = Exif("A", "B", 28, latitude, longitude, height, "2024:01:01 00:00:00")
        (images / name).write_bytes(add_exif(tiny.read_bytes(), exif))
    return images


@pytest.mark.parametrize(
    ("frame", "epsg"),
    [
        (LocalFrame(-33.9, 18.4), 32734),  # southern hemisphere
        (LocalFrame(-17.0, 179.9999), 32760),  # across the antimeridian
        (LocalFrame(48.0, 11.9999), 32632),  # across the border of two UTM zones
        (LocalFrame(0.0, 6.5), 32632),  # at the equator
        (LocalFrame(-0.003, 6.5), 32732),
    ],
)
def test_everywhere_on_the_globe_without_a_database(
    mapped: Mapped, tmp_path: Path, frame: LocalFrame, epsg: int
) -> None:
    images = with_photos(tmp_path, mapped.truth, frame)
    shutil.copytree(mapped.folder / "sparse/0", tmp_path / "models/0")
    result = run("georegister", "--sparse", tmp_path / "models", "--images", images)
    assert result.exit_code == 0, result.output
    written = tmp_path / "models-georegistered/0"
    model, found = pycolmap.Reconstruction(written), read_frame(written)
    for image in model.images.values():
        back = frame.from_wgs84(found.to_wgs84(image.projection_center()[None]))[0]
        assert np.linalg.norm(back - mapped.truth[image.name]) < 0.5
    assert found.epsg in (epsg, {32632: 32633, 32760: 32701}.get(epsg))
    assert f"EPSG {found.epsg}" in result.output


@pytest.fixture
def change(mapped: Mapped, tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies the project and changes positions by SQL on (lat, lon, h)."""

    def changed(which: str) -> Path:
        shutil.copytree(mapped.folder, tmp_path / "project", dirs_exist_ok=True)
        with closing(sqlite3.connect(tmp_path / "project/database.db")) as database:
            rows = database.execute("SELECT pose_prior_id, position FROM pose_priors").fetchall()
            for number, (key, blob) in enumerate(rows):
                lat, lon, height = np.frombuffer(blob, np.float64).tolist()
                new = CHANGES[which](number, lat, lon, height)
                if new is None:
                    database.execute("DELETE FROM pose_priors WHERE pose_prior_id = ?", (key,))
                    continue
                database.execute(
                    "UPDATE pose_priors SET position = ? WHERE pose_prior_id = ?",
                    (np.array(new, np.float64).tobytes(), key),
                )
            database.commit()
        return tmp_path / "project/sparse"

    return changed


Position = tuple[float, float, float]
CHANGES: dict[str, Callable[[int, float, float, float], Position | None]] = {
    "zero": lambda i, lat, lon, h: (0, 0, 0) if i == 4 else (lat, lon, h),
    "missing": lambda i, lat, lon, h: None if i == 4 else (lat, lon, h),
    "wild": lambda i, lat, lon, h: (lat + 0.2, lon, h) if i == 4 else (lat, lon, h),
    "swapped": lambda i, lat, lon, h: (lon, lat, h) if i == 4 else (lat, lon, h),
    "off": lambda i, lat, lon, h: (lat, lon, h + 500) if i == 4 else (lat, lon, h),
    "equal": lambda i, lat, lon, h: (53.0, -1.0, 100.0),
    "two": lambda i, lat, lon, h: (lat, lon, h) if i < 2 else None,
    "none": lambda i, lat, lon, h: None,
}


@pytest.mark.parametrize(
    ("which", "said"),
    [
        ("zero", "latitude and longitude zero"),
        ("missing", ""),
        ("wild", "do not agree and had no say: 00004.jpg (22"),
        ("swapped", "swapped; put right"),
        ("off", "do not agree and had no say: 00004.jpg (5"),
    ],
)
def test_one_bad_position_disables_nothing(
    mapped: Mapped, change: Callable[[str], Path], which: str, said: str
) -> None:
    sparse = change(which)
    result = run("georegister", "--sparse", sparse)
    assert result.exit_code == 0, result.output
    assert said in result.output
    written = sparse.with_name("sparse-georegistered") / "0"
    assert np.sqrt((errors(written, mapped.truth) ** 2).mean()) < NOISE


@pytest.mark.parametrize("without", [1, 18])
def test_photos_without_heights(mapped: Mapped, tmp_path: Path, without: int) -> None:
    images = with_photos(tmp_path, mapped.truth, FRAME)
    for photo in sorted(images.iterdir())[:without]:
        with Image.open(photo) as opened:
            exif = opened.getexif()
            gps = exif.get_ifd(0x8825)
            exif[0x8825] = {tag: value for tag, value in gps.items() if tag not in (5, 6)}
            opened.load()
            opened.save(photo, exif=exif)
    shutil.copytree(mapped.folder / "sparse/0", tmp_path / "models/0")
    result = run("georegister", "--sparse", tmp_path / "models", "--images", images)
    assert result.exit_code == 0, result.output
    assert ("taken to be level" in result.output) == (without == 18)
    apart = errors(tmp_path / "models-georegistered/0", mapped.truth)
    assert np.sqrt((apart[:, :2] ** 2).mean()) < NOISE
    assert without == 18 or np.sqrt((apart[:, 2] ** 2).mean()) < NOISE


def test_names_with_spaces_and_umlauts(mapped: Mapped, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(mapped.folder / "sparse/0")
    for image in model.images.values():
        image.name = f"Flug ü 1/{image.name}"
    folder = tmp_path / "Modell ß"
    folder.mkdir()
    model.write(folder)
    truth = {f"Flug ü 1/{name}": place for name, place in mapped.truth.items()}
    images = with_photos(tmp_path, mapped.truth, FRAME)
    shutil.move(images, tmp_path / "images/Flug ü 1")
    result = run("georegister", "--sparse", folder, "--images", tmp_path / "images")
    assert result.exit_code == 0, result.output
    assert np.sqrt((errors(tmp_path / "Modell ß-georegistered", truth) ** 2).mean()) < NOISE


@pytest.mark.parametrize(
    ("which", "said"),
    [
        ("equal", "All known positions are equal"),
        ("two", "Only 2 photos of the model have a known position"),
        ("none", "No position is known of any of the 18 photos"),
    ],
)
def test_what_cannot_be_placed_is_one_sentence(
    change: Callable[[str], Path], which: str, said: str
) -> None:
    sparse = change(which)
    assert said in sentence(run("georegister", "--sparse", sparse))
    assert not sparse.with_name("sparse-georegistered").exists()


def test_ten_models_in_one_folder(mapped: Mapped, tmp_path: Path) -> None:
    for number in range(10):
        shutil.copytree(mapped.folder / "sparse/0", tmp_path / f"sparse/{number}")
    database = mapped.folder / "database.db"
    result = run("georegister", "--sparse", tmp_path / "sparse", "--db", database)
    assert result.exit_code == 0, result.output
    written = sorted((tmp_path / "sparse-georegistered").iterdir())
    assert len(written) == 10
    assert len({read_frame(folder) for folder in written}) == 1


@pytest.mark.parametrize("what", ["missing", "empty", "damaged"])
def test_no_model_is_one_sentence(tmp_path: Path, what: str) -> None:
    sparse = tmp_path / "sparse"
    if what != "missing":
        sparse.mkdir()
    if what == "damaged":
        for name in ("cameras.bin", "images.bin", "points3D.bin"):
            (sparse / name).write_bytes(b"x")
    said = sentence(run("georegister", "--sparse", sparse))
    assert ("damaged" if what == "damaged" else "holds no COLMAP model") in said


def test_positions_of_the_folder_above_are_another_flights(mapped: Mapped, tmp_path: Path) -> None:
    """Drones name the photos of every flight alike."""
    shutil.copytree(mapped.folder / "sparse", tmp_path / "flight/sparse")
    shutil.copy(mapped.folder / "database.db", tmp_path / "project.db")
    (tmp_path / "images").mkdir()
    said = sentence(run("georegister", "--sparse", tmp_path / "flight/sparse"))
    assert "No position is known" in said and "project.db" not in said
    for name in ("project.db", "images"):
        (tmp_path / name).rename(tmp_path / "flight" / name)
    for sparse in ("sparse", "sparse/0"):
        result = run("georegister", "--sparse", tmp_path / "flight" / sparse)
        assert f"Database, found beside the model: {tmp_path}/flight/project.db." in result.output
        assert f"Photos, found beside the model: {tmp_path}/flight/images." in result.output
    exported = run("export", "--sparse", tmp_path / "flight/sparse/0-georegistered")
    assert "Database, found beside the model" in exported.output


def test_a_database_of_other_features_is_used_only_where_it_is_named(
    mapped: Mapped, tmp_path: Path
) -> None:
    shutil.copytree(mapped.folder, tmp_path, dirs_exist_ok=True)
    database = tmp_path / "database.db"
    with closing(sqlite3.connect(database)) as opened:
        opened.execute("UPDATE keypoints SET rows = 0, data = x'' WHERE image_id = 3")
        opened.commit()
    said = sentence(run("georegister", "--sparse", tmp_path / "sparse"))
    assert f"{database} is put aside: its photos have other features than the model's" in said
    assert "name it as --db" in said and "No position is known" in said
    assert run("georegister", "--sparse", tmp_path / "sparse", "--db", database).exit_code == 0


@pytest.mark.parametrize(("given", "name"), [(".", "0"), ("..", "sparse")])
def test_the_folder_one_stands_in(
    mapped: Mapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, name: str
) -> None:
    shutil.copytree(mapped.folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path / "sparse/0")
    result = run("georegister", "--sparse", given)
    assert result.exit_code == 0, result.output
    assert "0: Georegistered in m" in result.output
    written = Path.cwd().parent if given == "." else tmp_path
    assert (written / f"{name}-georegistered").is_dir()
    monkeypatch.chdir(next(written.glob("*-georegistered")))
    assert run("export", "--sparse", ".", "--format", "csv").exit_code == 0
    assert (written / f"{name}-georegistered-export").is_dir()


def matched_project(mapped: Mapped, folder: Path) -> Path:
    shutil.copy(mapped.folder / "database.db", folder / "database.db")
    names = list(mapped.truth)
    (folder / "pairs.txt").write_text(f"{names[0]} {names[1]}\n")
    return folder / "database.db"


def test_reconstruct_brings_the_model_into_the_world(mapped: Mapped, tmp_path: Path) -> None:
    database = matched_project(mapped, tmp_path)
    result = run("reconstruct", "--db", database, "--mapper", "incremental", "--threads", 1)
    assert result.exit_code == 0, result.output
    assert "Georegistered in m east, north, up" in result.output
    assert np.sqrt((errors(tmp_path / "sparse/0", mapped.truth) ** 2).mean()) < NOISE
    assert [path.name for path in (tmp_path / "sparse").iterdir()] == ["0"]


def test_reconstruct_off_leaves_colmap_s_frame(mapped: Mapped, tmp_path: Path) -> None:
    database = matched_project(mapped, tmp_path)
    result = run("reconstruct", "--db", database, "--georegister", "off")
    assert result.exit_code == 0, result.output
    assert not (tmp_path / "sparse/0/georeference.json").exists()


def test_reconstruct_require_says_so_before_it_maps(
    mapped: Mapped, change: Callable[[str], Path], tmp_path: Path
) -> None:
    sparse = change("two")
    shutil.rmtree(sparse)
    matched_project(mapped, tmp_path)
    database = sparse.with_name("database.db")
    (database.parent / "pairs.txt").write_text("00000.jpg 00001.jpg\n")
    said = sentence(run("reconstruct", "--db", database, "--georegister", "require"))
    assert "2 of 18 photos have a usable position" in said
    assert not sparse.exists()
    assert run("reconstruct", "--db", database).exit_code == 0
