"""Bad input: one clear sentence, exit code not 0, nothing changed, nothing half-written."""

from __future__ import annotations

import errno
import hashlib
import shutil
import sqlite3
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from photos import save_jpeg, scene

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.matching import colmap as matching
from colmap_netvlad.project import Project
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically

MakeProject = Callable[..., Project]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def content(folder: Path) -> dict[str, str]:
    """Digest of every file; sqlite's lock files beside a database carry no content."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.endswith(("-shm", "-wal"))
    }


def assert_one_sentence(result: Result, sentence: str) -> None:
    assert result.exit_code == 1, (result.output, result.exception)
    assert isinstance(result.exception, SystemExit)  # not a traceback
    message = result.stderr.strip()
    assert message.startswith("Error: ") and message.endswith(".")
    assert "Traceback" not in message
    assert sentence in message.replace("\n", " ")


def _not_sqlite(path: Path) -> None:
    path.write_bytes(b"not a database" * 1000)


def _empty_file(path: Path) -> None:
    path.write_bytes(b"")


def _not_colmap(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE songs (name TEXT)")


@pytest.mark.parametrize("command", ["features", "pairs", "reconstruct"])
@pytest.mark.parametrize("make", [_not_sqlite, _not_colmap, _empty_file])
def test_a_file_that_is_no_colmap_database_is_said_and_kept(
    command: str, make: Callable[[Path], None], tmp_path: Path
) -> None:
    save_jpeg(tmp_path / "images" / "a.jpg", scene())
    make(tmp_path / "project.db")
    (tmp_path / "pairs.txt").write_text("a.jpg b.jpg\n")
    before = content(tmp_path)
    arguments = [command, "--db", tmp_path / "project.db", "--images", tmp_path / "images"]
    assert_one_sentence(run(*arguments), "is not a COLMAP database")
    assert content(tmp_path) == before


@pytest.mark.parametrize("command", ["pairs", "reconstruct"])
def test_a_missing_database_or_photo_folder_is_said(
    command: str, project_copy: MakeProject
) -> None:
    project = project_copy()
    project.pairs.write_text("a b\n")
    before = content(project.folder)
    gone = project.folder / "gone"
    assert_one_sentence(run(command, "--db", gone), "does not exist; mend --db")
    assert_one_sentence(run(command, "--db", project.folder), "is a folder")
    assert_one_sentence(
        run(command, "--db", project.database, "--images", gone), "does not exist; mend --images"
    )
    assert content(project.folder) == before


@pytest.mark.parametrize("images", [0, 1])
def test_a_database_of_no_or_one_image_has_no_pairs(images: int, project_copy: MakeProject) -> None:
    project = project_copy()
    with closing(sqlite3.connect(project.database)) as connection:
        for table in ("keypoints", "descriptors", "images"):
            connection.execute(f"DELETE FROM {table} WHERE image_id > {images}")
        connection.commit()
    before = content(project.folder)
    assert_one_sentence(run("pairs", "--db", project.database), f"has {images} image")
    project.pairs.write_text("")
    assert_one_sentence(run("reconstruct", "--db", project.database), "lists no pairs")
    assert content(project.folder).items() >= before.items()
    assert not project.sparse.exists()


def test_a_database_without_features_cannot_be_reconstructed(project_copy: MakeProject) -> None:
    project = project_copy()
    with closing(sqlite3.connect(project.database)) as connection:
        connection.execute("DELETE FROM keypoints")
        connection.execute("DELETE FROM descriptors")
        connection.commit()
    a, b = image_names(project.database)[:2]
    project.pairs.write_text(f"{a} {b}\n")
    before = content(project.folder)
    result = run("reconstruct", "--db", project.database)
    assert_one_sentence(result, "No image in")
    assert content(project.folder) == before


@pytest.mark.parametrize("k", [0, -3])
def test_k_below_one_is_said(k: int, project_copy: MakeProject) -> None:
    project = project_copy()
    assert_one_sentence(run("pairs", "--db", project.database, "--k", k), f"--k is {k}")


def test_pairs_lists_that_are_none_are_said(project_copy: MakeProject) -> None:
    project = project_copy()
    before = content(project.database.parent)
    for text, sentence in (
        ("one two three\n", "is not a pairs list: line 1 has 3 names"),
        ("gone.jpg lost.jpg\n", "names 2 images that the database does not have"),
    ):
        project.pairs.write_text(text)
        assert_one_sentence(run("reconstruct", "--db", project.database), sentence)
    (project.folder / "pairs.json").write_text("{]")
    result = run("reconstruct", "--db", project.database, "--pairs", project.folder / "pairs.json")
    assert_one_sentence(result, "is not a pairs list")
    assert content(project.folder).items() >= before.items()


@pytest.mark.parametrize("command", ["features", "reconstruct"])
def test_a_database_locked_by_another_process_is_said(
    command: str, project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "LOCK_SECONDS", 0.1)
    project = project_copy(copy_photos=True)
    save_jpeg(project.need_images() / "new.jpg", scene())
    a, b = image_names(project.database)[:2]
    project.pairs.write_text(f"{a} {b}\n")
    code = (
        "import sqlite3, sys; c = sqlite3.connect(sys.argv[1], isolation_level=None);"
        "c.execute('BEGIN IMMEDIATE'); print('locked', flush=True); sys.stdin.read()"
    )
    locker = subprocess.Popen(
        [sys.executable, "-c", code, str(project.database)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert locker.stdout is not None
        assert locker.stdout.readline() == b"locked\n"
        before = content(project.folder)
        result = run(command, "--db", project.database, "--images", project.need_images())
        assert_one_sentence(result, "is locked by another process")
        assert content(project.folder) == before
    finally:
        locker.communicate(timeout=10)


def test_a_folder_that_cannot_be_written_is_said(project_copy: MakeProject) -> None:
    project = project_copy()
    blocker = project.folder / "file"
    blocker.touch()
    images = project.need_images()
    before = content(project.folder)
    below = blocker / "below"
    assert_one_sentence(
        run("features", "--images", images, "--db", below / "project.db"), "Cannot write in"
    )
    a, b = image_names(project.database)[:2]
    project.pairs.write_text(f"{a} {b}\n")
    with pytest.raises(InputError, match="Cannot write"):
        write_atomically(below / "pairs.txt", "a b\n")
    result = run("reconstruct", "--db", project.database, "--output", below / "sparse")
    assert_one_sentence(result, "Cannot write")
    assert content(project.folder).keys() == {*before, "pairs.txt", "project.netvlad.db"} - (
        {"project.netvlad.db"} - set(content(project.folder))
    )


@pytest.mark.parametrize("command", ["features", "reconstruct"])
def test_a_full_disk_is_said_before_colmap_meets_it(
    command: str, project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy(copy_photos=True)
    save_jpeg(project.need_images() / "new.jpg", scene())
    a, b = image_names(project.database)[:2]
    project.pairs.write_text(f"{a} {b}\n")
    before = content(project.folder)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9, 1000))
    result = run(command, "--db", project.database, "--images", project.need_images())
    assert_one_sentence(result, "is full")
    assert content(project.folder) == before


def test_a_disk_that_fills_up_during_the_work_stops_it_cleanly(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy()
    usage = namedtuple("usage", "total used free")
    asked = iter([10**12, 10**12])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**12, 0, next(asked, 1000)))
    monkeypatch.setattr(engine, "WATCH_SECONDS", 0.01)
    names = image_names(project.database)
    monkeypatch.setattr(matching, "FIRST_CHUNK", 4)
    lines = (f"{a} {b}\n" for i, a in enumerate(names) for b in names[i + 1 :])
    project.pairs.write_text("".join(lines))
    assert_one_sentence(run("reconstruct", "--db", project.database), "goes on where it stopped")
    monkeypatch.undo()
    with open_database(project.database) as database:
        assert len(database.matched_pairs()) < 66
    assert run("reconstruct", "--db", project.database).exit_code == 0


def test_a_full_disk_leaves_no_half_written_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "pairs.txt"
    target.write_text("old")

    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_atomically(target, "new")
    monkeypatch.undo()
    assert content(tmp_path) == {"pairs.txt": hashlib.sha256(b"old").hexdigest()}


# Ctrl-C. The process sends SIGINT to itself from inside the stage, so that no test waits for
# the right moment: the stage's function starts a timer and, once done, waits for the signal.
INTERRUPT = """
import functools, importlib, os, signal, sys, threading, time
module, name = sys.argv[1].rsplit(":", 1)
module = importlib.import_module(module)
*path, name = name.split(".")
holder = functools.reduce(getattr, path, module)
real = getattr(holder, name)

def stage(*arguments, **options):
    if threading.current_thread() is threading.main_thread():
        os.kill(os.getpid(), signal.SIGINT)
    else:
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    result = real(*arguments, **options)
    time.sleep(1)
    return result

setattr(holder, name, stage)
from colmap_netvlad.cli import cli
cli(sys.argv[2:])
"""


def interrupted(stage: str, *arguments: object) -> None:
    """Run a command that gets Ctrl-C inside the function `module:name`, and check its exit."""
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPT, stage, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1, done.stderr
    assert "Aborted!" in done.stderr
    assert "Traceback" not in done.stderr and "***" not in done.stderr


def assert_no_leftovers(folder: Path) -> None:
    assert [path for path in folder.rglob(".*") if path.is_file() or path.is_dir()] == []


@pytest.mark.parametrize(
    "stage", ["colmap_netvlad.colmap.features:read_header", "pycolmap:extract_features"]
)
def test_ctrl_c_in_features_is_clean_and_the_next_run_completes(stage: str, tmp_path: Path) -> None:
    images, database = tmp_path / "images", tmp_path / "project.db"
    for i in range(4):
        save_jpeg(images / f"{i}.jpg", scene(i))
    arguments = ("features", "--images", images, "--db", database, "--threads", 1)
    interrupted(stage, *arguments)
    assert_no_leftovers(tmp_path)
    assert run(*arguments).exit_code == 0
    with open_database(database) as colmap:
        assert len(colmap.images_with_features()) == 4


def test_sigterm_stops_as_ctrl_c_does(project_copy: MakeProject) -> None:
    project = project_copy()
    script = INTERRUPT.replace("SIGINT", "SIGTERM").replace(
        "from colmap_netvlad.cli import cli\ncli(sys.argv[2:])",
        "from colmap_netvlad.cli import main\nsys.argv[1:] = sys.argv[2:]\nmain()",
    )
    arguments = ["pairs", "--db", str(project.database), "--method", "bow", "--k", "3"]
    stage = "colmap_netvlad.runtime.processes:wait"
    done = subprocess.run(
        [sys.executable, "-c", script, stage, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1 and done.stderr.strip() == "Aborted!", done.stderr
    assert_no_leftovers(project.folder)


def test_ctrl_c_while_a_vocabulary_tree_is_built_is_clean(project_copy: MakeProject) -> None:
    project = project_copy()
    arguments = ("pairs", "--db", project.database, "--method", "bow", "--k", 3)
    before = content(project.folder)
    interrupted("colmap_netvlad.runtime.processes:wait", *arguments)  # in its own process
    assert_no_leftovers(project.folder)
    assert content(project.folder).items() >= before.items()
    assert run(*arguments).exit_code == 0 and project.pairs.exists()


@pytest.mark.parametrize(
    "stage, matcher",
    [
        ("pycolmap:match_image_pairs", "colmap"),
        ("pycolmap:estimate_two_view_geometry", "guided"),
        ("pycolmap:incremental_mapping", "colmap"),
    ],
)
def test_ctrl_c_in_reconstruct_is_clean_and_the_next_run_completes(
    stage: str, matcher: str, project_copy: MakeProject
) -> None:
    project = project_copy(matched="mapping" in stage)
    names = image_names(project.database)
    lines = (f"{a} {b}\n" for i, a in enumerate(names) for b in names[i + 1 : i + 6])
    project.pairs.write_text("".join(lines))
    arguments = ("reconstruct", "--db", project.database, "--matcher", matcher)
    interrupted(stage, *arguments)
    assert_no_leftovers(project.folder)
    assert not project.sparse.exists()
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    assert "12 of 12" in result.stdout


def test_ctrl_c_in_pairs_is_clean_and_the_next_run_completes(project_copy: MakeProject) -> None:
    project = project_copy()
    arguments = ("pairs", "--db", project.database, "--method", "vlad", "--k", 3)
    before = content(project.folder)
    interrupted("colmap_netvlad.colmap.database:Database.sift_descriptors", *arguments)
    assert_no_leftovers(project.folder)
    assert not project.pairs.exists()
    assert content(project.folder).items() >= before.items()
    assert run(*arguments).exit_code == 0 and project.pairs.exists()


def _sqlite_full() -> sqlite3.OperationalError:
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.execute("PRAGMA max_page_count = 1")
        try:
            connection.execute("CREATE TABLE much (data)")
            connection.execute("INSERT INTO much VALUES (zeroblob(99999))")
        except sqlite3.OperationalError as fault:
            return fault
    raise AssertionError


@pytest.mark.parametrize(
    "fault", [OSError(errno.ENOSPC, "No space left on device", "/tmp/a"), _sqlite_full()]
)
def test_a_disk_that_is_full_at_any_write_is_one_sentence(
    fault: Exception, monkeypatch: pytest.MonkeyPatch, project_copy: Callable[..., Project]
) -> None:
    def write(*arguments: object, **options: object) -> None:
        raise fault

    monkeypatch.setattr("colmap_netvlad.commands.pairs.make_pairs", write)
    result = CliRunner().invoke(cli, ["pairs", "--db", str(project_copy().database)])
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert (
        "Error: A disk is full (" in result.stderr and "goes on where it stopped" in result.stderr
    )
