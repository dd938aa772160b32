"""Calls into pycolmap that write a database: checked first, quiet, stopped cleanly by Ctrl-C.

A fault inside COLMAP's worker threads (disk full, database locked) ends the whole process, so
what can be known before is checked before, and the free disk space is watched during the call.

While pycolmap has a database open, this process must not open the same file through `sqlite3`:
two copies of sqlite in one process undo each other's file locks.
"""

from __future__ import annotations

import logging
import os
import shutil
import signal
import sqlite3
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import pycolmap

from colmap_netvlad.colmap.database import open_database
from colmap_netvlad.runtime.errors import InputError

Result = TypeVar("Result")

FREE_BYTES = 64 * 2**20
"""Disk space that stays free: less, and sqlite could fail inside one of COLMAP's threads."""

LOCK_SECONDS = 5.0
"""How long to wait for another process's lock before saying so."""

OPENINGS, OPENING_SECONDS = 10, 0.1
"""How often and after which pauses COLMAP is asked to open a database."""

WATCH_SECONDS = 0.2

# pycolmap takes SIGTERM to print a stack trace; what Python had is put back.
with suppress(ValueError):  # not in the main thread
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))

_logger = logging.getLogger("colmap_netvlad")

_QUIET = 3  # glog: only fatal messages


def check_writable(database: Path) -> None:
    """Make sure that pycolmap can write a database, which need not exist yet.

    Raises:
        InputError: it is not COLMAP's or locked, or its folder cannot be written or is full.
    """
    try:
        database.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=database.parent):
            pass
    except OSError as fault:
        raise InputError(
            f"Cannot write in the folder {database.parent}: {fault.strerror or fault}."
        ) from fault
    check_space(database.parent)
    if not database.exists():
        return
    with open_database(database):
        pass
    if not os.access(database, os.W_OK):
        raise InputError(f"{database} is read-only; make it writable, or work on a copy.")
    try:
        with closing(sqlite3.connect(database, timeout=LOCK_SECONDS)) as connection:
            connection.isolation_level = None
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("ROLLBACK")
    except sqlite3.OperationalError as fault:
        raise InputError(
            f"{database} is locked by another process; wait for it to finish, or close COLMAP."
        ) from fault


def call(function: Callable[..., Result], folder: Path, *arguments: Any, **options: Any) -> Result:
    """Run one pycolmap function that takes a `cancellation_token`, and return its result.

    Ctrl-C and a disk that fills up cancel it; what it finished by then stays in the database.

    Args:
        function: the pycolmap function, called with `arguments` and `options`.
        folder: where it writes; its disk space is watched.

    Raises:
        InputError: the disk is nearly full, or COLMAP refuses what it reads.
        KeyboardInterrupt: Ctrl-C.
    """
    silence()
    token = pycolmap.CancellationToken()
    outcome: list[Result] = []
    faults: list[BaseException] = []
    # An event and not `Thread.join`: Ctrl-C inside a join makes Python 3.11 take the running
    # thread for a finished one, and the process would end under COLMAP's feet.
    finished = threading.Event()

    def run() -> None:
        try:
            outcome.append(function(*arguments, cancellation_token=token, **options))
        except BaseException as fault:  # handed to the caller's thread below
            faults.append(fault)
        finally:
            finished.set()

    thread = threading.Thread(target=run, name="pycolmap", daemon=True)
    thread.start()
    try:
        while not finished.wait(WATCH_SECONDS):
            check_space(folder)
    except BaseException:
        token.cancel()
        finished.wait()
        raise
    thread.join()
    if faults:
        with faults_said():
            raise faults[0]
    return outcome[0]


def make_or_migrate(database: Path) -> None:
    """Let COLMAP make a database, or bring an old one up to its own schema.

    Raises:
        InputError: COLMAP cannot read it.
    """
    silence()
    with opened(database):
        pass


@contextmanager
def opened(database: Path) -> Iterator[pycolmap.Database]:
    """Open a database as COLMAP does, and close it after the block.

    COLMAP writes as it opens and does not wait for another process, so it is asked again.

    Raises:
        InputError: COLMAP cannot read it.
    """
    with faults_said():
        for _ in range(OPENINGS - 1):
            with suppress(Exception):
                colmap = pycolmap.Database.open(database)
                break
            time.sleep(OPENING_SECONDS)
        else:
            colmap = pycolmap.Database.open(database)
    try:
        yield colmap
    finally:
        colmap.close()


@contextmanager
def faults_said() -> Iterator[None]:
    """Say in a sentence what COLMAP itself raises in the block.

    Raises:
        InputError: instead of COLMAP's exceptions.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as fault:
        raise InputError(
            f"COLMAP stopped: {' '.join(str(fault).split())} Where another program uses the "
            "database, wait for it; where it is damaged (sqlite3's `PRAGMA integrity_check` says "
            "so), restore it from a copy."
        ) from fault


def silence() -> None:
    """Let only COLMAP's fatal messages through, unless our own logger is at DEBUG."""
    pycolmap.logging.minloglevel = 0 if _logger.isEnabledFor(logging.DEBUG) else _QUIET
    pycolmap.logging.logtostderr = True


def initialiser() -> Callable[[], None]:
    """Return what a worker (`runtime.workers`) calls first, to log as much as this process."""
    return partial(_log_at, _logger.getEffectiveLevel())


def _log_at(level: int) -> None:
    _logger.setLevel(level)
    silence()


def check_space(folder: Path) -> None:
    """Raise InputError where the disk of a folder is nearly full."""
    free = shutil.disk_usage(folder).free
    if free < FREE_BYTES:
        raise InputError(
            f"The disk of {folder} is full ({free / 2**20:.0f} MiB left); make room and run the "
            "command again: it goes on where it stopped."
        )
