"""Multispectral shots are paired once a shot, and each band with its own kind."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from photos import scene
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from schemas import add_images, make_database

from colmap_netvlad.cache.ranking import NO_PARTNER
from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.photos.bands import find_shots, named_band
from colmap_netvlad.photos.files import read_header
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.progress import Step, report_to, silent


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("IMG_0007_1.tif", ("IMG_0007", "1")),
        ("000/IMG_0007_2.tif", ("000/IMG_0007", "Green")),
        ("IMG_0007_10.TIF", ("IMG_0007", "10")),
        ("IMG_160914_155525_0000_REG.TIF", ("IMG_160914_155525_0000", "RedEdge")),
        ("IMG_160914_155525_0000_RGB.JPG", ("IMG_160914_155525_0000", "RGB")),
        ("Flug ü/DJI_20230601120000_0001_MS_NIR.TIF", ("Flug ü/DJI_20230601120000_0001", "NIR")),
        ("DJI_20230601120000_0001_D.JPG", ("DJI_20230601120000_0001", "RGB")),
        ("DJI_0010.JPG", ("DJI_001", "RGB")),
        ("DJI_0014.TIF", ("DJI_001", "RedEdge")),
        ("DJI_0014.JPG", None),  # a photo of any other DJI drone
        ("DJI_0017.TIF", None),
        ("DJI_20230601120000_0001_T.JPG", None),
        ("IMG_0007.tif", None),
        ("map_1.tif", None),
    ],
)
def test_names_state_shot_and_band(name: str, said: tuple[str, str] | None) -> None:
    assert named_band(name) == said


def test_bands_of_a_shot_are_found_by_name(tmp_path: Path) -> None:
    names = ["a/IMG_0000_1.tif", "a/IMG_0000_2.tif", "b/IMG_0000_1.tif", "b/IMG_0000_2.tif"]
    assert find_shots([*names, "c/DJI_0010.JPG"], None) == [
        {"1": names[0], "Green": names[1]},
        {"1": names[2], "Green": names[3]},
    ]


@pytest.mark.parametrize(
    "names",
    [
        ["DJI_0010.JPG", "DJI_0011.JPG", "DJI_0020.JPG"],
        ["DJI_0010.JPG", "DJI_0020.JPG", "ortho.tif"],
        ["flight_1.tif", "flight_2.tif", "flight_3.tif"],
        [],
    ],
)
def test_other_flights_have_no_shots_of_several_bands(names: list[str], tmp_path: Path) -> None:
    assert find_shots(names, None) == find_shots(names, tmp_path) == []


def tiff(path: Path, seed: int, xmp: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = ImageFileDirectory_v2()
    tags[700] = f"<rdf:RDF>{xmp}</rdf:RDF>".encode()
    tags.tagtype[700] = 1
    Image.fromarray(scene(seed)[..., 1]).save(path, tiffinfo=tags)


MICASENSE = "<MicaSense:CaptureId>{}</MicaSense:CaptureId><Camera:BandName>{}</Camera:BandName>"
DJI = '<rdf:Description drone-dji:CaptureUUID="{}" Camera:BandName="{}"/>'
PARROT = '<rdf:Description Camera:CaptureUUID="{}" Camera:BandName="{}"/>'


@pytest.mark.parametrize("block", [MICASENSE, DJI, PARROT])
def test_xmp_tells_where_files_were_renamed(tmp_path: Path, block: str) -> None:
    for shot in "ab":
        for band in ("Blue", "Red edge"):
            tiff(tmp_path / band / f"{shot}.tif", 0, block.format(f"id-{shot}", band))
    header = read_header(tmp_path / "Red edge/a.tif")
    assert (header.exposure, header.band) == ("id-a", "Red edge")
    names = ["Blue/a.tif", "Blue/b.tif", "Red edge/a.tif", "Red edge/b.tif"]
    assert find_shots(names, tmp_path) == [
        {"Blue": names[0], "Rededge": names[2]},
        {"Blue": names[1], "Rededge": names[3]},
    ]


def test_a_copy_of_a_band_is_of_another_shot(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        for band in ("Blue", "NIR"):
            tiff(tmp_path / folder / f"{band}.tif", 0, DJI.format("same", band))
    names = ["one/Blue.tif", "one/NIR.tif", "two/Blue.tif", "two/NIR.tif"]
    shots = find_shots(names, tmp_path)
    assert shots == [{"Blue": names[0], "NIR": names[1]}, {"Blue": names[2], "NIR": names[3]}]


BANDS = {"D.JPG": None, "MS_G.TIF": 1, "MS_R.TIF": 0}


@pytest.fixture(scope="module")
def multispectral(flight: RenderedFlight, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """The flight as a Mavic 3 Multispectral's: a colour photo, and two of its channels."""
    folder = tmp_path_factory.mktemp("multispectral ü")
    images = folder / "images"
    images.mkdir()
    for number, name in enumerate(flight.names):
        colour = Image.open(flight.images / name)
        for suffix, channel in BANDS.items():
            target = images / f"DJI_20240501120000_{number:04d}_{suffix}"
            if channel is None:
                shutil.copy(flight.images / name, target)
            else:
                colour.getchannel(channel).save(target)
    extract_features(images, folder / "project.db", FeatureOptions(max_features=1000))
    return Project(folder / "project.db", images)


def split(name: str) -> tuple[str, str]:
    shot, _, band = name.removeprefix("DJI_20240501120000_").partition("_")
    return shot, band


@pytest.mark.parametrize("method", ["vlad", "bow", "spatial"])
def test_bands_follow_their_shot(multispectral: Project, method: str) -> None:
    ranking = rank_project(multispectral, method, RetrievalOptions(k=4))
    names = ranking.names
    place = {name: i for i, name in enumerate(names)}
    assert len(names) == 36 and sorted(names) == sorted(place)
    assert ranking.notes[0].startswith("12 multispectral shots (Green, RGB, Red), ranked by")
    for name, row in zip(names, ranking.partners, strict=True):
        shot, band = split(name)
        partners = [split(names[j]) for j in row[row != NO_PARTNER]]
        colour = ranking.partners[place[name.replace(band, "D.JPG")]]
        own = [split(names[j])[0] for j in colour[colour != NO_PARTNER]]
        if band != "D.JPG":
            assert partners.pop(0) == (shot, "D.JPG")
        assert {b for _, b in partners} == {band}
        assert [s for s, _ in partners] == own[: len(partners)] and shot not in own


def test_the_command_pairs_same_bands_and_says_so(multispectral: Project, tmp_path: Path) -> None:
    arguments = ["pairs", "--db", str(multispectral.database), "--method", "vlad", "--k", "4"]
    result = CliRunner().invoke(cli, [*arguments, "--output", str(tmp_path / "pairs.txt")])
    assert result.exit_code == 0, result.output
    assert "12 multispectral shots" in result.output
    kinds: Counter[str] = Counter()
    for line in (tmp_path / "pairs.txt").read_text().splitlines():
        (shot1, band1), (shot2, band2) = (split(name) for name in line.split())
        assert (band1 == band2) != (shot1 == shot2)
        kinds["shot" if shot1 == shot2 else band1] += 1
    assert kinds["shot"] == 24  # each band with the colour photo of its own shot
    assert kinds["MS_G.TIF"] == kinds["MS_R.TIF"] <= kinds["D.JPG"]


def test_one_shot_has_no_pairs(tmp_path: Path) -> None:
    database = tmp_path / "project.db"
    make_database(database, "4.2")
    add_images(database, [f"IMG_0000_{band}.tif" for band in range(1, 6)])
    with pytest.raises(InputError, match=r"All 5 images .* bands of one multispectral shot"):
        rank_project(Project(database, None), "vlad")


def test_looking_for_shots_is_a_step(tmp_path: Path) -> None:
    steps: list[tuple[str, int]] = []

    @contextmanager
    def watch(title: str, total: int) -> Iterator[Step]:
        steps.append((title, total))
        with silent(title, total) as bar:
            yield bar

    with report_to(watch):
        find_shots(["a.tif", "b.jpg"], tmp_path)
    assert steps == [("Looking for multispectral shots", 2)]


def test_exhaustive_stays_exhaustive(multispectral: Project) -> None:
    ranking = rank_project(multispectral, "exhaustive")
    assert ranking.partners.shape == (36, 35)


def test_a_photo_without_features_represents_nobody(multispectral: Project, tmp_path: Path) -> None:
    images = tmp_path / "images"
    shutil.copytree(multispectral.images or Path(), images)
    (images / "DJI_20240501120000_0003_D.JPG").write_bytes(b"broken")
    names = sorted(path.name for path in images.iterdir())[:18]
    for path in images.iterdir():
        if path.name not in names:
            path.unlink()
    extract_features(images, tmp_path / "project.db", FeatureOptions(max_features=300))
    ranking = rank_project(Project(tmp_path / "project.db", images), "vlad", RetrievalOptions(k=3))
    assert "ranked by the band Green or RGB" in ranking.notes[0]
    place = ranking.names.index("DJI_20240501120000_0003_MS_R.TIF")
    assert ranking.names[ranking.partners[place, 0]] == "DJI_20240501120000_0003_MS_G.TIF"


def test_each_band_is_a_camera(multispectral: Project, tmp_path: Path) -> None:
    import pycolmap

    database = pycolmap.Database.open(multispectral.database)
    cameras = {image.camera_id: split(image.name)[1] for image in database.read_all_images()}
    database.close()
    assert sorted(cameras.values()) == ["D.JPG", "MS_G.TIF", "MS_R.TIF"]


def test_scores_fall(multispectral: Project) -> None:
    ranking = rank_project(multispectral, "vlad", RetrievalOptions(k=4))
    assert (np.diff(np.where(np.isfinite(ranking.scores), ranking.scores, -9.0)) <= 0).all()
