"""A rendered flight, its features and its matches, shared by all tests.

Each is made once a test run, also under pytest-xdist: the first worker makes it beside the
others' folders and renames it into place. Tests get copies of what they may change.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pycolmap
import pytest

from colmap_netvlad.demo.render import FlightOptions, RenderedFlight, read_flight, render_flight
from colmap_netvlad.project import Project

FLIGHT = FlightOptions(rows=3, columns=4, width=400, height=300, altitude=45.0)

pycolmap.logging.minloglevel = 2


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all workers of this test run."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base


def make_once(target: Path, make: Callable[[Path], None]) -> Path:
    """Run `make(folder)` in one worker only and rename its folder to `target`."""
    lock = target.with_suffix(".lock")
    try:
        lock.mkdir(parents=True)
    except FileExistsError:
        for _ in range(3000):
            if target.exists():
                return target
            time.sleep(0.1)
        raise TimeoutError(f"another worker did not finish {target}") from None
    draft = target.with_suffix(".draft")
    make(draft)
    draft.rename(target)
    return target


@pytest.fixture(scope="session")
def flight(shared_folder: Path) -> RenderedFlight:
    """12 photos of 400 x 300 px: 3 lines of 4, every second line flown backwards. Read only."""
    return read_flight(make_once(shared_folder / "flight", lambda to: _render(to)))


def _render(folder: Path) -> None:
    render_flight(folder, FLIGHT)


@pytest.fixture(scope="session")
def flight_database(flight: RenderedFlight, shared_folder: Path) -> Path:
    """A database with the flight's SIFT features and no matches. Read only: do not open it with
    pycolmap; take `project_copy`."""

    def make(folder: Path) -> None:
        folder.mkdir()
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = 2
        options.sift.max_num_features = 1500
        database = folder / "project.db"
        pycolmap.Database.open(database).close()
        # Apart from the extraction, whose threads would number the photos as they finish.
        names = sorted(flight.names)
        pycolmap.import_images(database, flight.images, pycolmap.CameraMode.SINGLE, names)
        pycolmap.extract_features(
            database,
            flight.images,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        _settle(database)

    return make_once(shared_folder / "features", make) / "project.db"


@pytest.fixture(scope="session")
def matched_database(flight_database: Path, shared_folder: Path) -> Path:
    """The same with every pair matched and verified. Read only, as `flight_database`."""

    def make(folder: Path) -> None:
        folder.mkdir()
        shutil.copy(flight_database, folder / "project.db")
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = 2
        pycolmap.set_random_seed(0)
        pycolmap.match_exhaustive(
            folder / "project.db", matching_options=options, device=pycolmap.Device.cpu
        )
        _settle(folder / "project.db")

    return make_once(shared_folder / "matches", make) / "project.db"


@pytest.fixture
def project_copy(
    flight: RenderedFlight, flight_database: Path, request: pytest.FixtureRequest, tmp_path: Path
) -> Callable[..., Project]:
    """A factory of projects of the test's own, to change at will.

    `project_copy()` has features, `project_copy(matched=True)` matches too; the photos are hard
    links, or copies with `copy_photos=True` where the test writes into them; `name` is the
    workspace's folder.
    """

    def make(
        *, matched: bool = False, copy_photos: bool = False, name: str = "workspace"
    ) -> Project:
        source = request.getfixturevalue("matched_database") if matched else flight_database
        folder = tmp_path / name
        images = folder / "images"
        images.mkdir(parents=True)
        for photo in flight.names:
            if copy_photos:
                shutil.copy(flight.images / photo, images / photo)
            else:
                os.link(flight.images / photo, images / photo)
        shutil.copy(source, folder / "project.db")
        return Project(folder / "project.db", images)

    return make


@pytest.fixture
def legacy_database(flight_database: Path, tmp_path: Path) -> Path:
    """The flight's features in a database of COLMAP 3.9's schema; its image priors are set to
    0.5, 0.25, i for image i (cartesian)."""
    path = tmp_path / "legacy" / "project.db"
    path.parent.mkdir()
    make_legacy_database(flight_database, path)
    return path


def make_legacy_database(source: Path, target: Path) -> None:
    """Copy cameras, images, features and matches of a COLMAP 4 database into 3.9's schema."""
    with closing(sqlite3.connect(target)) as legacy:
        legacy.executescript(LEGACY_SCHEMA)
        legacy.execute("ATTACH ? AS modern", (str(source),))
        legacy.executescript(
            """
            INSERT INTO cameras SELECT camera_id, model, width, height, params,
                prior_focal_length FROM modern.cameras;
            INSERT INTO images SELECT image_id, name, camera_id, 1, 0, 0, 0, 0.5, 0.25, image_id
                FROM modern.images;
            INSERT INTO keypoints SELECT image_id, rows, cols, data FROM modern.keypoints;
            INSERT INTO descriptors SELECT image_id, rows, cols, data FROM modern.descriptors;
            INSERT INTO matches SELECT pair_id, rows, cols, data FROM modern.matches;
            INSERT INTO two_view_geometries SELECT pair_id, rows, cols, data, config, F, E, H,
                qvec, tvec FROM modern.two_view_geometries;
            """
        )
        legacy.commit()


LEGACY_SCHEMA = """
PRAGMA user_version = 3900;
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB,
    prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
    prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL,
    prior_tx REAL, prior_ty REAL, prior_tz REAL,
    CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
    FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
CREATE UNIQUE INDEX index_name ON images(name);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB,
    qvec BLOB, tvec BLOB);
"""


def _settle(database: Path) -> None:
    """Fold the write-ahead log into the file, so that copying the file copies everything."""
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real flights beside the checkout; skips the test where it is absent."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real flights are not here ({folder})")
    return folder


@pytest.fixture(scope="session")
def tiny_checkpoint(shared_folder: Path) -> Path:
    """A descriptor model with random weights, 64 px: small and fast, but a real one."""

    def make(folder: Path) -> None:
        import torch

        from colmap_netvlad.models.aggregation import build_aggregation
        from colmap_netvlad.models.backbones import build_trunk
        from colmap_netvlad.models.checkpoint import save_checkpoint
        from colmap_netvlad.models.network import GlobalDescriptor

        folder.mkdir()
        torch.manual_seed(0)
        trunk = build_trunk("efficientnet-lite0-stage5")
        network = GlobalDescriptor(trunk, build_aggregation(trunk.channels, {"kind": "gem"}))
        card = {"name": "tiny", "long_side": 64, "rotations": 1}
        save_checkpoint(folder / "tiny.safetensors", network, card)

    return make_once(shared_folder / "model", make) / "tiny.safetensors"
