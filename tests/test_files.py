"""Files appear whole or not at all."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from colmap_netvlad.cli import cli
from colmap_netvlad.mapping.output import model_folder
from colmap_netvlad.runtime import files
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path, scratch_folder, write_atomically
from colmap_netvlad.runtime.shell import command_line


def test_content_replaces_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / "pairs.txt"
    target.write_text("old")
    write_atomically(target, "new\n")
    assert target.read_text() == "new\n"
    assert [p.name for p in tmp_path.iterdir()] == ["pairs.txt"]


def test_missing_folders_are_made(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a" / "b" / "c.bin", b"\x00\x01")
    assert (tmp_path / "a" / "b" / "c.bin").read_bytes() == b"\x00\x01"


@pytest.mark.parametrize("fault", [KeyboardInterrupt, RuntimeError])
def test_a_fault_while_writing_leaves_the_old_file(
    tmp_path: Path, fault: type[BaseException]
) -> None:
    target = tmp_path / "pairs.txt"
    target.write_text("old")
    with pytest.raises(fault), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise fault
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["pairs.txt"]


def test_a_full_disk_is_one_sentence_and_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "pairs.txt"
    target.write_text("old")

    def no_space(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", no_space)
    with pytest.raises(InputError, match=r"Cannot write .*pairs\.txt: No space left on device\."):
        write_atomically(target, "new")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["pairs.txt"]


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="Cannot write"):
        write_atomically(tmp_path / "file" / "pairs.txt", "x")


KILLED = """
import os, sys
from pathlib import Path
from colmap_netvlad.mapping.output import model_folder
from colmap_netvlad.runtime.files import atomic_path, scratch_folder
with model_folder(Path(sys.argv[1], "sparse")) as model, scratch_folder() as scratch:
    Path(model, "points3D.bin").touch()
    Path(scratch, "features.db").touch()
    with atomic_path(Path(sys.argv[1], "pairs.txt")):
        os.kill(os.getpid(), 9)
"""


def test_what_a_killed_process_left_goes_with_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, scratch = tmp_path / "work", tmp_path / "scratch"
    work.mkdir()
    scratch.mkdir()
    monkeypatch.setattr(files.tempfile, "tempdir", str(scratch))
    environment = {**os.environ, "TMPDIR": str(scratch)}
    subprocess.run([sys.executable, "-c", KILLED, work], env=environment, check=False)
    assert len(list(work.iterdir())) == 2 and len(list(scratch.iterdir())) == 1
    foreign = [work / ".sparse.clusters", work / ".sparse.other-machine-1-x", work / "sparse-1"]
    for folder in foreign:
        folder.mkdir()
    with atomic_path(work / "pairs.txt") as living:
        write_atomically(work / "pairs.txt", "a b\n")  # a living process keeps what it writes
        assert living.exists()
    with model_folder(work / "sparse"), scratch_folder():
        pass
    assert sorted(work.iterdir()) == sorted([*foreign, work / "sparse", work / "pairs.txt"])
    assert list(scratch.iterdir()) == []


def test_what_a_killed_process_left_goes_though_nothing_is_left_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files.tempfile, "tempdir", str(tmp_path))
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    with scratch_folder() as living:
        left = living.with_name(living.name.replace(f"-{os.getpid()}-", f"-{gone.pid}-"))
        left.mkdir()
        assert CliRunner().invoke(cli, ["methods"]).exit_code == 0
        assert living.is_dir() and not left.exists()


def test_hints_are_quoted_for_the_shell_at_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["colmap-netvlad", "pairs", "--db", "my flight.db"]
    assert command_line(words) == "colmap-netvlad pairs --db 'my flight.db'"
    monkeypatch.setattr(os, "name", "nt")
    assert command_line(words) == 'colmap-netvlad pairs --db "my flight.db"'


def test_a_scratch_folder_goes_though_something_writes_there_while_it_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP's threads go on for a moment when their caller is interrupted."""
    remove, tries = shutil.rmtree, []

    def written_to(folder: Path, ignore_errors: bool) -> None:
        remove(folder, ignore_errors=ignore_errors)
        if not tries:
            folder.mkdir()
            (folder / "features.db").touch()
        tries.append(folder)

    monkeypatch.setattr(files.shutil, "rmtree", written_to)
    with pytest.raises(KeyboardInterrupt), scratch_folder(tmp_path):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == [] and len(tries) == 2
