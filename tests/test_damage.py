"""Damaged and hostile input: databases, pairs lists, names and links."""

from __future__ import annotations

import codecs
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from photos import save_jpeg, scene

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names, open_database, pair_id
from colmap_netvlad.graph.lookalikes import read_moves
from colmap_netvlad.graph.verified import verified_by_name
from colmap_netvlad.graph.viewgraph import read_view_graph
from colmap_netvlad.pairs.lists import read_pairs
from colmap_netvlad.photos import files
from colmap_netvlad.photos.decode import decode_photo, load_batches
from colmap_netvlad.photos.files import BadPhoto, find_photos, leaves_folder, read_header
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.training.tracks import tracks

MakeProject = Callable[..., Project]


def execute(database: Path, *statements: str) -> None:
    with closing(sqlite3.connect(database)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


def test_matches_of_images_that_are_gone_are_passed_over(project_copy: MakeProject) -> None:
    project = project_copy(matched=True)
    execute(
        project.database,
        *(f"DELETE FROM {table} WHERE image_id = 1" for table in ("keypoints", "images")),
    )
    names = set(image_names(project.database))
    verified = verified_by_name(project.database)
    assert len(verified) == 11 * 10 // 2
    assert {name for pair in verified for name in pair} == names
    assert len(read_view_graph(project.database).names) == 11
    assert tracks(project.database)[1] > 0
    with open_database(project.database) as database:
        assert {i for pair in database.matched_pairs() for i in pair} == set(range(2, 13))


@pytest.mark.parametrize(
    ("change", "table"),
    [
        ("UPDATE keypoints SET data = x'00' WHERE image_id = 3", "keypoints"),
        ("UPDATE keypoints SET rows = 'many' WHERE image_id = 3", "keypoints"),
        ("UPDATE keypoints SET cols = 0 WHERE image_id = 3", "keypoints"),
        ("UPDATE descriptors SET data = 'text' WHERE image_id = 3", "descriptors"),
        ("UPDATE descriptors SET rows = -1 WHERE image_id = 3", "descriptors"),
        ("UPDATE descriptors SET rows = 4611686018427387904 WHERE image_id = 3", "descriptors"),
        ("UPDATE images SET name = x'00ff' WHERE image_id = 3", "images"),
        ("UPDATE cameras SET width = 'wide'", "images"),
    ],
)
def test_a_damaged_row_is_one_sentence_that_says_which(
    change: str, table: str, project_copy: MakeProject
) -> None:
    project = project_copy()
    execute(project.database, change)
    before = project.database.read_bytes()
    result = CliRunner().invoke(
        cli, ["pairs", "--db", str(project.database), "--method", "vlad", "--k", "3"]
    )
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert f"project.db is damaged: what table {table} has of image" in result.stderr
    assert "restore the database from a copy" in result.stderr
    assert project.database.read_bytes() == before


def test_damaged_matches_are_one_sentence_that_says_whose(project_copy: MakeProject) -> None:
    project = project_copy(matched=True)
    pair = pair_id(1, 2)
    execute(project.database, f"UPDATE two_view_geometries SET data = x'00' WHERE pair_id = {pair}")
    with pytest.raises(InputError, match=r"two_view_geometries has of image 1 \(.*\) and image 2 "):
        verified_by_name(project.database)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("DELETE FROM keypoints WHERE image_id = 3", r"has matches of keypoint \d+ of image 3 "),
        ("UPDATE two_view_geometries SET config = '/etc/passwd'", "two_view_geometries has of"),
        ("UPDATE descriptors SET type = 'SIFT'", "descriptors has of"),
    ],
)
def test_what_does_not_go_together_is_one_sentence(
    change: str, said: str, project_copy: MakeProject
) -> None:
    project = project_copy(matched=True)
    execute(project.database, change)
    with open_database(project.database) as database, pytest.raises(InputError, match=said):
        database.has_sift()
        read_moves(database)


def test_kinds_of_geometry_that_colmap_does_not_know_are_no_fault(
    project_copy: MakeProject,
) -> None:
    project = project_copy(matched=True)
    execute(project.database, "UPDATE two_view_geometries SET config = 99")
    with open_database(project.database) as database:
        assert np.isnan(read_moves(database).tilt).all()


def test_a_small_file_that_says_it_is_huge_is_not_decoded(tmp_path: Path) -> None:
    save_jpeg(tmp_path / "a.jpg", scene(0))
    data = (tmp_path / "a.jpg").read_bytes()
    start = data.index(b"\xff\xc0")
    huge = data[: start + 5] + struct.pack(">HH", 30_000, 30_000) + data[start + 9 :]
    (tmp_path / "a.jpg").write_bytes(huge)
    with pytest.raises(BadPhoto, match="says 30000 x 30000 pixels, but is too small a file"):
        decode_photo(tmp_path / "a.jpg", 64)


@pytest.mark.parametrize(
    "name", ["../../etc/passwd", "/etc/passwd", "a/../../b.jpg", "a\0.jpg", ""]
)
def test_a_name_never_leads_out_of_the_photo_folder(name: str, project_copy: MakeProject) -> None:
    assert leaves_folder(name)
    project = project_copy()
    with closing(sqlite3.connect(project.database)) as connection:
        connection.execute("UPDATE images SET name = ? WHERE image_id = 1", (name,))
        connection.commit()
    with pytest.raises(InputError, match="leads out of the photo folder"):
        image_names(project.database)
    (batch,) = load_batches(project.need_images(), [name], 64, 1)
    assert batch.bad == [(name, "has a name that leads out of the photo folder")]


def test_names_with_dots_are_names() -> None:
    assert not any(map(leaves_folder, ["a.jpg", "flight..2/a.jpg", "...jpg", "a/b/c d.jpg", "-k"]))


def test_links_back_into_the_photos_are_not_followed(tmp_path: Path) -> None:
    root, other = tmp_path / "images", tmp_path / "card"
    for path in (root / "a.jpg", root / "day" / "b.jpg", other / "c.jpg"):
        save_jpeg(path, scene())
    (root / "day" / "up").symlink_to(root)
    (root / "day" / "above").symlink_to(tmp_path)
    (root / "again").symlink_to(root / "day")
    (root / "card").symlink_to(other)
    (root / "card2").symlink_to(other)
    (other / "loop").symlink_to(other)
    (root / "linked.jpg").symlink_to(root / "a.jpg")
    assert find_photos(root) == ["a.jpg", "card/c.jpg", "day/b.jpg", "linked.jpg"]


def test_the_header_check_reads_head_and_tail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = tmp_path / "a.jpg"
    save_jpeg(photo, scene())
    data = photo.read_bytes()
    read = 0
    real = files.parse_header

    class Counting:
        def __init__(self, file) -> None:
            self._file = file

        def read(self, count: int = -1) -> bytes:
            nonlocal read
            found = self._file.read(count)
            read += len(found)
            return found

        def __getattr__(self, name: str):
            return getattr(self._file, name)

    monkeypatch.setattr(files, "parse_header", lambda file: real(Counting(file)))
    photo.write_bytes(data[:-2] + bytes(2**22) + data[-2:])
    read_header(photo)
    assert 0 < read < 2**20
    read = 0
    photo.write_bytes(data + bytes(2**22))  # something behind the end: only then whole
    read_header(photo)
    assert read > 2**22


LISTS = {
    "BOM": codecs.BOM_UTF8 + b"a.jpg b.jpg\n",
    "UTF-16": "a.jpg\tb.jpg\r\n".encode("utf-16"),
    "Windows": b"a.jpg b.jpg\r\n\r\n# no pair\r\n",
    "tabs": b"a.jpg\tb.jpg\n",
    "quotes": b'"a.jpg" "b.jpg"\n',
    "doubled": b"a.jpg b.jpg\nb.jpg a.jpg\na.jpg b.jpg\na.jpg a.jpg\n",
}


@pytest.mark.parametrize("kind", LISTS)
def test_pairs_lists_as_spreadsheets_and_windows_write_them(kind: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.txt").write_bytes(LISTS[kind])
    assert read_pairs(tmp_path / "pairs.txt", ["a.jpg", "b.jpg"]) == [("a.jpg", "b.jpg")]


def test_names_with_spaces_in_quotes_and_names_like_options(tmp_path: Path) -> None:
    (tmp_path / "pairs.txt").write_text('"c d.jpg" --help\n-k a"b.jpg\n')
    names = ["c d.jpg", "--help", "-k", 'a"b.jpg']
    expected = [("c d.jpg", "--help"), ("-k", 'a"b.jpg')]
    assert read_pairs(tmp_path / "pairs.txt", names) == expected


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv_of_any_spreadsheet(delimiter: str, tmp_path: Path) -> None:
    rows = [["name1", "name2", "score"], ["a.jpg", "c d.jpg", "1"]]
    text = "\r\n".join(delimiter.join(row) for row in rows)
    (tmp_path / "pairs.CSV").write_bytes(codecs.BOM_UTF8 + text.encode())
    assert read_pairs(tmp_path / "pairs.CSV", ["a.jpg", "c d.jpg"]) == [("a.jpg", "c d.jpg")]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("pairs.json", "7"),
        ("pairs.json", "[1]"),
        ("pairs.json", '[{"name1": ["a.jpg"], "name2": 2}]'),
        ("pairs.json", "[" * 100_000),
        ("pairs.csv", "name1,name2\na.jpg\n"),
        ("pairs.csv", "first,second\na.jpg,b.jpg\n"),
        ("pairs.csv", f"name1,name2\n{'a' * 200_000},b.jpg\n"),
    ],
)
def test_lists_that_are_none_are_one_sentence(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match="is not a pairs list: "):
        read_pairs(tmp_path / name, ["a.jpg", "b.jpg"])


def test_what_colmap_refuses_is_one_sentence(project_copy: MakeProject) -> None:
    project = project_copy(matched=True)
    execute(project.database, "UPDATE two_view_geometries SET tvec = x'000000' WHERE rows > 0")
    a, b = image_names(project.database)[:2]
    project.pairs.write_text(f"{a} {b}\n")
    arguments = ["reconstruct", "--db", str(project.database), "--mapper", "incremental"]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert "Error: COLMAP stopped: " in result.stderr and "restore it from a copy" in result.stderr
    assert not project.sparse.exists()


@pytest.mark.parametrize(
    ("change", "method"),
    [
        ("UPDATE codebooks SET dim = x'00'", "vlad"),
        ("UPDATE codebooks SET images = 'many'", "vlad"),
        ("UPDATE codebooks SET words = x'00'", "vlad"),
        ("UPDATE codebooks SET seconds = 'many'", "vlad"),
        ("UPDATE descriptors SET vector = x'0000' WHERE rowid = 2", "vlad"),
        ("UPDATE photos SET stamp = 7, gps = x'00'", "hybrid"),
        ("UPDATE settings SET value = x'00'", "random"),
    ],
)
def test_a_damaged_cache_is_one_sentence_that_says_to_delete_it(
    change: str, method: str, project_copy: MakeProject
) -> None:
    project = project_copy()
    arguments = ["pairs", "--db", str(project.database), "--method", "vlad", "--k", "3"]
    assert CliRunner().invoke(cli, arguments).exit_code == 0
    execute(
        project.cache,
        "INSERT OR REPLACE INTO photos VALUES ('a', '1 1', NULL, NULL)",
        "INSERT OR REPLACE INTO settings VALUES ('images', 'images')",
        change,
    )
    result = CliRunner().invoke(cli, [*arguments[:4], method, "--k", "3"])
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit), result.output
    assert "is damaged" in result.stderr and "delete it: descriptors are computed" in result.stderr
