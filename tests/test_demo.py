"""The rendered flight, and the fixtures that the other tests stand on."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.commands.demo import run_demo
from colmap_netvlad.demo.check import align, check_against_truth
from colmap_netvlad.demo.country import Country
from colmap_netvlad.demo.overlap import true_overlaps, true_pairs
from colmap_netvlad.demo.render import (
    SEEN_FILE,
    FlightOptions,
    RenderedFlight,
    render_flight,
    to_wgs84,
)
from colmap_netvlad.runtime.errors import InputError


def test_flight_reconstructs_whole_and_within_one_percent(
    flight: RenderedFlight, project_copy, tmp_path
):
    project = project_copy(matched=True)
    pycolmap.set_random_seed(0)
    models = pycolmap.incremental_mapping(project.database, project.images, tmp_path)
    assert len(models) == 1
    model = models[0]
    assert model.num_reg_images() == len(flight.names)
    estimated = {i.name: i.projection_center() for i in model.images.values()}
    centres = np.array([estimated[name] for name in flight.names])
    aligned = pycolmap.estimate_sim3d(centres, flight.centres)
    moved = np.array([aligned * c for c in centres])
    error = np.linalg.norm(moved - flight.centres, axis=1)
    assert error.max() < 0.01 * flight.extent


def test_photos_carry_focal_length_and_true_position(flight: RenderedFlight, project_copy):
    project = project_copy()
    with open_database(project.database) as database:
        priors = database.pose_priors()
        ids = {image.name: image.image_id for image in database.images()}
    for name, centre in zip(flight.names, flight.centres, strict=True):
        latitude, longitude, altitude = to_wgs84(centre)
        found = priors[ids[name]].position
        assert found[:2] == pytest.approx((latitude, longitude), abs=1e-7)
        assert found[2] == pytest.approx(altitude, abs=0.002)
    camera = pycolmap.infer_camera_from_image(flight.images / flight.names[0])
    assert camera.has_prior_focal_length
    assert camera.focal_length == pytest.approx(flight.focal, rel=1e-4)


def test_same_seed_gives_same_photos_and_another_gives_other_land(tmp_path: Path):
    options = FlightOptions(rows=1, columns=1, width=160, height=120)
    photos = []
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        made = render_flight(tmp_path / folder, FlightOptions(**{**vars(options), "seed": seed}))
        photos.append((made.images / made.names[0]).read_bytes())
    assert photos[0] == photos[1]
    assert photos[0] != photos[2]


@pytest.mark.parametrize("ground", ["village", "plantation", "bare"])
def test_each_ground_renders_a_photo_with_contrast(ground, tmp_path: Path):
    made = render_flight(
        tmp_path, FlightOptions(rows=1, columns=1, width=200, height=150, ground=ground)
    )
    pixels = cv2.imread(str(made.images / made.names[0]))
    assert pixels.shape == (150, 200, 3)
    assert pixels.std() > 3


def test_blocks_are_separate_flights(tmp_path: Path):
    made = render_flight(tmp_path, FlightOptions(rows=1, columns=2, width=120, height=90, blocks=2))
    assert made.blocks.tolist() == [0, 0, 1, 1]
    assert len(set(made.names)) == 4
    assert np.linalg.norm(made.centres[0] - made.centres[2]) > 500


def test_country_is_the_same_wherever_a_piece_of_it_begins():
    one, other = (Country((west, 0), (west + 2, 1), cell=1.0, seed=3) for west in (0, 1))
    side = one.shape[0]
    for grid in ("height", "ground", "colour"):
        # Shadows end at a piece's border.
        mine = getattr(one, grid)[20:-20, side + 20 : -20]
        theirs = getattr(other, grid)[20:-20, 20 : side - 20]
        assert np.abs(mine - theirs).max() < 1e-3
    assert one.colour.std() > 0.05


def test_country_elsewhere_is_another_one():
    grounds = [Country((west, 0), (west + 1, 1), cell=1.0, seed=3).colour for west in (0, 1, 2)]
    assert not np.allclose(grounds[0], grounds[1])
    assert not np.allclose(grounds[1], grounds[2])


def test_large_flight_has_the_photos_asked_for_and_knows_which_overlap(tmp_path: Path):
    options = FlightOptions.large(40, width=80, height=60, seed=1)
    made = render_flight(tmp_path / "a", options)
    assert len(made.names) == len(list(made.images.iterdir())) == 40
    overlaps = true_overlaps(made).toarray()
    assert (overlaps == overlaps.T).all()
    assert not overlaps.diagonal().any()
    steps = np.diff(made.centres[:, :2], axis=0)
    along = np.flatnonzero(np.linalg.norm(steps, axis=1) < 30)
    # 70 % forward by plan; drift, tilt and relief move it.
    assert np.mean([overlaps[i, i + 1] for i in along]) == pytest.approx(0.66, abs=0.06)
    far = np.linalg.norm(made.centres[:, None, :2] - made.centres[None, :, :2], axis=2) > 140
    assert not overlaps[far].any()
    much = np.argwhere(np.triu(overlaps >= 0.2)).tolist()
    assert true_pairs(made) == [(made.names[i], made.names[j]) for i, j in much]
    again = render_flight(tmp_path / "b", options)
    for name in made.names:
        assert (made.images / name).read_bytes() == (again.images / name).read_bytes()


def test_flight_without_what_its_photos_show_is_rendered_again(tmp_path: Path):
    options = FlightOptions(rows=1, columns=2, width=80, height=60)
    made = render_flight(tmp_path, options)
    (tmp_path / SEEN_FILE).unlink()
    with pytest.raises(InputError, match="render the flight again"):
        true_overlaps(made)


@pytest.mark.parametrize("photos", ["0", "3", "10000", "many"])
def test_demo_names_a_bad_number_of_photos_in_one_sentence(photos: str, tmp_path: Path):
    output = tmp_path / "demo"
    result = CliRunner().invoke(cli, ["demo", "--photos", photos, "--output", str(output)])
    assert result.exit_code != 0
    assert "--photos" in result.output
    assert "Traceback" not in result.output
    assert not output.exists()


def test_legacy_database_has_the_schema_of_colmap_3_9(
    legacy_database: Path, flight: RenderedFlight
):
    with closing(sqlite3.connect(legacy_database)) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (3900,)
        tables = {r[0] for r in connection.execute("SELECT name FROM sqlite_master")}
    assert not tables & {"pose_priors", "rigs", "frames"}
    with open_database(legacy_database) as database:
        assert {image.name for image in database.images()} == set(flight.names)
        assert min(database.keypoint_counts().values()) > 100


def test_check_is_blind_to_frame_and_scale_but_not_to_a_moved_camera(flight: RenderedFlight):
    true = dict(zip(flight.names, flight.centres, strict=True))
    turn = flight.rotations[0]
    found = {name: 0.1 * turn @ centre + 5 for name, centre in true.items()}
    moved, target = align(found, true)
    assert np.allclose(moved, target, atol=1e-6)
    found[flight.names[3]] = found[flight.names[3]] + 0.1 * 0.05 * flight.extent
    moved, target = align(found, true)
    assert np.linalg.norm(moved - target, axis=1).max() > 0.03 * flight.extent


def test_check_fails_without_a_model(flight: RenderedFlight):
    check = check_against_truth([], flight)
    assert not check.passed
    assert check.registered == 0


def test_demo_refuses_a_folder_with_something_else_in_it(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("precious")
    result = CliRunner().invoke(cli, ["demo", "--output", str(tmp_path)])
    assert result.exit_code == 1
    assert "holds something else" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_demo_reconstructs_checks_draws_and_runs_again(tmp_path: Path):
    options = FlightOptions(rows=3, columns=4, width=360, height=270, altitude=45.0)
    lines: list[object] = []
    first = run_demo(tmp_path / "demo", "vlad", options, lines.append)
    assert first.passed
    assert first.registered == 12
    assert any("passed" in str(line) for line in lines)
    picture = cv2.imread(str(tmp_path / "demo" / "result.png"))
    assert picture.std() > 20
    again = run_demo(tmp_path / "demo", "vlad", options, lines.append)
    assert again.passed
    assert np.allclose(again.errors, first.errors, atol=0.01 * first.extent)
