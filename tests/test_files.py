"""Files appear whole or not at all."""

from pathlib import Path

import pytest

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path, write_atomically


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
