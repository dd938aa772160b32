"""Files that appear whole or not at all."""

from __future__ import annotations

import glob
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from colmap_netvlad.runtime.errors import InputError

REMOVAL_PAUSES = (0.0, 0.05, 0.2, 0.5, 1.0)
"""Before each try to remove a folder, seconds."""


def check_output(path: Path, argument: str) -> None:
    """Make sure, before long work, that a file can be written; nothing is made.

    Args:
        argument: what the user names the file with.

    Raises:
        InputError: it is a folder, or its folder can be neither written nor made.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file with `{argument}`.")
    # Folders that are missing are made with the file.
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(
            f"Cannot write {path}: {folder} is no folder that can be written; name a file "
            f"elsewhere with `{argument}`."
        )


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` that becomes `path` when the block succeeds.

    A fault or Ctrl-C in the block leaves `path` as it was and the temporary file gone.

    Raises:
        InputError: the folder cannot be written, or the disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=temporary_prefix(path), dir=path.parent)
        os.close(handle)
    except OSError as fault:
        raise InputError(f"Cannot write {path}: {fault.strerror or fault}.") from fault
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as fault:
        raise InputError(f"Cannot write {path}: {fault.strerror or fault}.") from fault
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write text (UTF-8) or bytes whole or not at all.

    Raises:
        InputError: the folder cannot be written, or the disk is full.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def temporary_prefix(path: Path) -> str:
    """Return how the name of a temporary file or folder beside `path` begins.

    It says which process of which machine made it. What processes that are gone (killed: nobody
    tidied up after them) have left of the same `path` is removed.
    """
    _remove_left(path)
    return f"{_prefix(path)}{os.getpid()}-"


@contextmanager
def scratch_folder(place: Path | None = None) -> Iterator[Path]:
    """Yield an empty folder in `place`, which is gone after the block.

    Those of processes that were killed go with the next one, or with `remove_scratch`.

    Args:
        place: None: the system's temporary disk.

    Raises:
        InputError: `place` cannot be written.
    """
    base = _scratch(place)
    try:
        folder = tempfile.mkdtemp(prefix=temporary_prefix(base), dir=base.parent)
    except OSError as fault:
        raise InputError(f"Cannot write in {base.parent}: {fault.strerror or fault}.") from fault
    try:
        yield Path(folder)
    finally:
        remove_folder(Path(folder))


@contextmanager
def claimed(path: Path) -> Iterator[bool]:
    """Yield whether no other process of this machine is in such a block for `path` as well.

    Two that enter at the same moment may both be told that they are not alone.
    """
    own = path.with_name(f"{temporary_prefix(path)}claim")
    own.touch()
    try:
        claims = path.parent.glob(f"{glob.escape(_prefix(path))}*-claim")
        yield all(claim == own for claim in claims)
    finally:
        own.unlink(missing_ok=True)


def remove_folder(folder: Path) -> None:
    """Remove a folder of ours, in several tries: a thread of COLMAP's that an interrupted caller
    left at work may write there a last time."""
    for pause in REMOVAL_PAUSES:
        time.sleep(pause)
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return


def remove_scratch(place: Path | None = None) -> None:
    """Remove the scratch folders of processes that were killed.

    A run that finds all done needs no scratch folder, and so would leave that of the run before it,
    killed at its end.

    Args:
        place: as in `scratch_folder`.
    """
    with suppress(OSError):
        _remove_left(_scratch(place))


def _scratch(place: Path | None) -> Path:
    return Path(place or tempfile.gettempdir()) / "colmap-netvlad"


def _prefix(path: Path) -> str:
    machine = re.sub(r"\W", "-", socket.gethostname())
    return f".{path.name}.{machine}-"


def _remove_left(path: Path) -> None:
    prefix = _prefix(path)
    for left in path.parent.glob(f"{glob.escape(prefix)}*"):
        maker = re.match(r"(\d+)-", left.name.removeprefix(prefix))
        if maker is not None and not _runs(int(maker[1])):
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                with suppress(OSError):
                    left.unlink()


def _runs(process: int) -> bool:
    if os.name == "nt":
        return True  # os.kill would end it there: what it left stays
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
