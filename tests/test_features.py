"""Photos -> SIFT features in a database."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from photos import BROKEN, HEIGHT, SOUND, WIDTH, save_jpeg, scene
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap import features as features_module
from colmap_netvlad.colmap.database import ImageRow, open_database
from colmap_netvlad.colmap.features import FeatureOptions, FeatureReport, extract_features
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.project import open_project
from colmap_netvlad.runtime.errors import EXIT_PARTIAL, InputError

FEW = {"max_features": 200, "threads": 1}


def extract(images: Path, **options: object) -> FeatureReport:
    return extract_features(
        images, images.parent / "project.db", FeatureOptions(**{**FEW, **options})
    )


def rows(images: Path) -> dict[str, ImageRow]:
    with open_database(images.parent / "project.db") as database:
        return {row.name: row for row in database.images()}


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    for i in range(3):
        save_jpeg(folder / f"{i}.jpg", scene(i))
    return folder


@pytest.mark.parametrize("camera", ["auto", "per-image"])
@pytest.mark.parametrize(("taken", "unit"), [(WIDTH, 2), (4 * WIDTH, 2), (2 * WIDTH, 3)])
def test_the_focal_length_is_that_of_the_file_also_where_photos_were_made_smaller(
    tmp_path: Path, camera: str, taken: int, unit: int
) -> None:
    """EXIF's focal plane is that of the photo as it was taken; COLMAP takes it for the file's."""
    resolution = {2: 1016, 3: 400}[unit] * taken // WIDTH
    plane = {0x920A: IFDRational(5), 0xA20E: IFDRational(resolution), 0xA210: unit}
    plane |= {0xA002: taken, 0xA003: taken * HEIGHT // WIDTH}
    images = tmp_path / "images"
    for i in range(2):
        save_jpeg(images / f"{i}.jpg", scene(i), make="Canon", model="S100", detail=plane)
    extract(images, camera=camera)
    with engine.opened(tmp_path / "project.db") as database:
        cameras = database.read_all_cameras()
    assert len(cameras) == (2 if camera == "per-image" else 1)
    for one in cameras:
        assert one.has_prior_focal_length
        assert one.mean_focal_length() == pytest.approx(200.0, rel=1e-3)


def test_a_photo_that_was_turned_or_cut_keeps_its_focal_length(tmp_path: Path) -> None:
    plane = {0x920A: IFDRational(5), 0xA20E: IFDRational(1016), 0xA210: 2}
    plane |= {0xA002: WIDTH, 0xA003: HEIGHT}
    turned, cut = np.rot90(scene()), scene()[:, : WIDTH // 2]
    for name, pixels in (("turned.jpg", turned), ("cut.jpg", cut)):
        pixels = np.ascontiguousarray(pixels)
        save_jpeg(tmp_path / "images" / name, pixels, make="Canon", model="S100", detail=plane)
    extract(tmp_path / "images", camera="per-image")
    with engine.opened(tmp_path / "project.db") as database:
        for camera in database.read_all_cameras():
            assert camera.mean_focal_length() == pytest.approx(200.0, rel=1e-3)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_name_that_is_no_text_is_left_out_and_stops_nothing(images: Path) -> None:
    (images / "2.jpg").rename(images / os.fsdecode(b"Fl\xe4che.jpg"))
    report = extract(images)
    assert report.bad == [("Fl?che.jpg", "has a name that is not UTF-8; rename it")]
    assert (report.photos, report.extracted) == (3, 2)


def test_photos_of_another_folder_are_not_imported_beside_the_databases(images: Path) -> None:
    extract(images)
    above = images.parent / "above"
    shutil.copytree(images, above / "images")
    with pytest.raises(InputError, match="holds none of the database's photos"):
        extract_features(above, images.parent / "project.db", FeatureOptions(**FEW))


def test_new_photos_join_their_camera_though_its_first_photo_is_gone(images: Path) -> None:
    extract(images)
    (images / "0.jpg").unlink()
    save_jpeg(images / "3.jpg", scene(3))
    extract(images)
    assert len({row.camera_id for row in rows(images).values()}) == 1


def test_sound_photos_of_every_kind_are_imported_and_broken_ones_listed(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name, write in SOUND.items():
        write(images / name)
    for name, (write, _) in BROKEN.items():
        write(images / name)
    arguments = ["features", "--images", str(images), "--db", str(tmp_path / "project.db")]
    result = CliRunner().invoke(cli, [*arguments, "--max-features", "200", "--threads", "1"])
    assert result.exit_code == EXIT_PARTIAL, result.output
    assert set(rows(images)) == set(SOUND)
    for name in BROKEN:
        assert f"Left out: {name} " in result.stderr
    assert f"{len(SOUND)} extracted now" in result.stdout
    assert "colmap-netvlad pairs --db" in result.stdout
    assert open_project(tmp_path / "project.db").images == images


def test_a_second_run_extracts_nothing_and_new_photos_share_the_camera(images: Path) -> None:
    assert extract(images).extracted == 3
    again = extract(images)
    assert (again.photos, again.already, again.extracted) == (3, 3, 0)
    save_jpeg(images / "new.jpg", scene(9))
    added = extract(images)
    assert (added.already, added.extracted, added.cameras) == (3, 1, 1)


def test_photos_with_and_without_exif_share_cameras_sensibly(tmp_path: Path) -> None:
    images = tmp_path / "images"
    dji = {"make": "DJI", "model": "FC300S", "focal": 20}
    save_jpeg(images / "x" / "1.jpg", scene(1), **dji)
    save_jpeg(images / "y" / "1.jpg", scene(2), **dji)
    save_jpeg(images / "y" / "zoomed.jpg", scene(3), **{**dji, "focal": 40})
    save_jpeg(images / "y" / "bare.jpg", scene(4))
    save_jpeg(images / "y" / "bare2.jpg", scene(5))
    save_jpeg(images / "z" / "bare.jpg", scene(6))
    save_jpeg(images / "z" / "tall.jpg", scene(7, HEIGHT, WIDTH))
    assert extract(images).cameras == 5
    cameras = {name: row.camera_id for name, row in rows(images).items()}
    assert cameras["x/1.jpg"] == cameras["y/1.jpg"] != cameras["y/zoomed.jpg"]
    assert cameras["y/bare.jpg"] == cameras["y/bare2.jpg"] != cameras["z/bare.jpg"]
    with open_database(tmp_path / "project.db") as database:
        assert len(database.images()) == 7


@pytest.mark.parametrize(
    ("mode", "cameras"), [("auto", 2), ("single", 1), ("per-folder", 2), ("per-image", 4)]
)
def test_camera_modes_share_cameras_as_they_say(mode: str, cameras: int, tmp_path: Path) -> None:
    images = tmp_path / "images"
    for i, name in enumerate(("a/1.jpg", "a/2.jpg", "b/1.jpg", "b/2.jpg")):
        save_jpeg(images / name, scene(i))
    assert extract(images, camera=mode).cameras == cameras
    assert set(rows(images)) == {"a/1.jpg", "a/2.jpg", "b/1.jpg", "b/2.jpg"}


def test_one_camera_for_two_sizes_is_refused_before_anything_is_written(images: Path) -> None:
    save_jpeg(images / "tall.jpg", scene(8, HEIGHT, WIDTH))
    with pytest.raises(InputError, match=r"192 x 144.*tall.jpg 144 x 192|tall.jpg has 144 x 192"):
        extract(images, camera="single")
    assert not (images.parent / "project.db").exists()


def test_names_with_spaces_hashes_umlauts_and_cjk_are_imported(tmp_path: Path) -> None:
    images = tmp_path / "my images"
    names = ["a b.jpg", "#1.jpg", "Höhe.jpg", "無人機/写真 1.jpg"]
    for i, name in enumerate(names):
        save_jpeg(images / name, scene(i))
    assert extract(images).extracted == 4
    assert set(rows(images)) == set(names)


def test_a_stopped_run_goes_on_with_the_next_photo(
    images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(features_module, "CHUNK_PHOTOS", 1)
    calls = []

    def stop_at_the_second(*arguments: object, **options: object) -> object:
        calls.append(options["image_names"])
        if len(calls) == 2:
            raise KeyboardInterrupt
        return call(*arguments, **options)

    call = engine.call
    monkeypatch.setattr(engine, "call", stop_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        extract(images)
    assert set(rows(images)) == {"0.jpg", "1.jpg"}, "the second is imported, not extracted"
    report = extract(images)
    assert (report.already, report.extracted, report.cameras) == (1, 2, 1)
    assert calls == [["0.jpg"], ["1.jpg"], ["1.jpg"], ["2.jpg"]]


def test_imported_images_without_features_get_them_and_keep_their_camera(images: Path) -> None:
    database = images.parent / "project.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, images, camera_mode=pycolmap.CameraMode.PER_IMAGE)
    before = {name: row.camera_id for name, row in rows(images).items()}
    assert len(set(before.values())) == 3
    assert extract(images).extracted == 3
    assert {name: row.camera_id for name, row in rows(images).items()} == before


def test_sift_is_not_put_beside_other_features(images: Path) -> None:
    extract(images)
    database = images.parent / "project.db"
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("UPDATE descriptors SET type = 1 WHERE image_id = 2")
        connection.commit()
    assert extract(images).already == 3, "nothing is to be extracted"
    save_jpeg(images / "new.jpg", scene(9))
    before = database.read_bytes()
    with pytest.raises(InputError, match=r"other local features than SIFT \(of 1\.jpg\)"):
        extract(images)
    assert database.read_bytes() == before


def test_features_are_the_same_twice(images: Path, tmp_path: Path) -> None:
    keypoints = []
    for name in ("one.db", "two.db"):
        extract_features(images, tmp_path / name, FeatureOptions(**FEW))
        with open_database(tmp_path / name) as database:
            keypoints.append([database.keypoints(row.image_id) for row in database.images()])
    for first, second in zip(*keypoints, strict=True):
        assert len(first) > 50
        assert np.array_equal(first, second)


def test_masked_areas_have_no_features_and_photos_without_a_mask_are_listed(images: Path) -> None:
    masks = images.parent / "masks"
    masks.mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, WIDTH // 2 :] = 255
    Image.fromarray(mask).save(masks / "0.jpg.png")
    Image.fromarray(mask).save(masks / "1.png")
    report = extract(images, masks=masks)
    assert [name for name, _ in report.bad] == ["2.jpg"]
    with open_database(images.parent / "project.db") as database:
        for row in database.images():
            x = database.keypoints(row.image_id)[:, 0]
            assert len(x) > 10 and x.min() >= WIDTH // 2 - 1


def test_max_image_size_and_max_features_are_heeded(images: Path) -> None:
    few = extract(images, max_features=20)
    small = extract_features(
        images, images.parent / "small.db", FeatureOptions(max_image_size=64, threads=1)
    )
    full = extract_features(images, images.parent / "full.db", FeatureOptions(threads=1))
    assert 0 < small.features < full.features / 2
    assert 0 < few.features < full.features / 2  # COLMAP keeps whole scales, so not exactly 20


def test_a_photo_without_texture_is_listed_and_stays(images: Path) -> None:
    save_jpeg(images / "sky.jpg", np.full((HEIGHT, WIDTH, 3), 200, np.uint8))
    report = extract(images)
    assert report.bad == [("sky.jpg", "has no features (blurred, or without texture)")]
    assert report.extracted == 3 and "sky.jpg" in rows(images)


def test_gps_of_photos_reaches_the_database(images: Path) -> None:
    exif = Image.Exif()
    place = {1: "N", 2: (47.0, 30.0, 0.0), 3: "E", 4: (8.0, 15.0, 0.0), 5: b"\0", 6: 420.0}
    exif[0x8825] = place
    Image.fromarray(scene(7)).save(images / "gps.jpg", exif=exif)
    extract(images)
    with open_database(images.parent / "project.db") as database:
        priors = database.pose_priors()
        ids = {row.name: row.image_id for row in database.images()}
    assert priors[ids["gps.jpg"]].position == pytest.approx((47.5, 8.25, 420.0))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"camera": "stereo"}, "`camera` is stereo; choose auto"),
        ({"camera_model": "LENS"}, "no camera model LENS"),
        ({"max_image_size": 0}, "`max_image_size` is 0"),
        ({"max_features": -1}, "`max_features` is -1"),
        ({"threads": 0}, "`threads` is 0"),
        ({"masks": Path("nowhere")}, "mask folder nowhere does not exist"),
    ],
)
def test_bad_options_are_one_sentence_and_write_nothing(
    options: dict[str, object], sentence: str, images: Path
) -> None:
    with pytest.raises(InputError, match=sentence):
        extract(images, **options)
    assert not (images.parent / "project.db").exists()


def test_a_folder_without_photos_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        extract(tmp_path / "images")
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "notes.txt").write_text("no photo")
    with pytest.raises(InputError, match="There are no photos in"):
        extract(tmp_path / "images")


def test_ids_follow_the_names_whatever_the_threads(flight: RenderedFlight, tmp_path: Path) -> None:
    for name, threads in (("one.db", 1), ("three.db", 3)):
        options = FeatureOptions(max_features=300, threads=threads)
        extract_features(flight.images, tmp_path / name, options)
    with open_database(tmp_path / "one.db") as one, open_database(tmp_path / "three.db") as three:
        assert [image.name for image in one.images()] == sorted(flight.names)
        assert one.images() == three.images()
        assert one.keypoint_counts() == three.keypoint_counts()
        assert one.feature_fingerprints() == three.feature_fingerprints()


HOLDER = """
import sqlite3, sys, time
database = sqlite3.connect(sys.argv[1], isolation_level=None)
database.execute("BEGIN IMMEDIATE")
print("held", flush=True)
time.sleep(0.3)
"""


def test_colmap_opens_a_database_that_another_process_holds_for_a_moment(tmp_path: Path) -> None:
    database = tmp_path / "project.db"
    engine.make_or_migrate(database)
    holder = [sys.executable, "-c", HOLDER, database]
    with subprocess.Popen(holder, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        engine.make_or_migrate(database)
