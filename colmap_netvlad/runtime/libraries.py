"""What other libraries need before they are loaded: OpenMP told to wait, zlib kept apart."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import sys
import tempfile
from pathlib import Path


def wait_without_spinning() -> None:
    """Let OpenMP's threads sleep where they wait, unless the environment says otherwise.

    GNU's runtime, which torch, faiss and pycolmap bring, spins for a while instead. Where other
    work has the processors, most of that is lost: describing 24 photos with two threads took 18 to
    35 CPU seconds beside four other processes, and 3 asleep, as with one thread. It holds for the
    process and those that it starts, if it is said before any of these libraries is loaded.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def keep_zlib_apart() -> None:
    """Let OpenCV read PNG files in a process that also holds pycolmap.

    pycolmap's wheel exports zlib symbols, which replace those inside libz when pycolmap loads it;
    OpenCV, loaded after it, then crashes on PNG files ("free(): invalid pointer"). Where pycolmap
    is not there yet, loading libz first keeps the two apart. Where it is, OpenCV is given a copy
    of libz under another name, whose symbols are its own.
    """
    with contextlib.suppress(OSError):
        if "pycolmap" not in sys.modules:
            ctypes.CDLL("libz.so.1")
        elif "cv2" not in sys.modules and hasattr(os, "RTLD_DEEPBIND"):
            _load_copy(_loaded_zlib())


def _loaded_zlib() -> Path:
    lines = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    paths = (line.split()[-1] for line in lines if "/libz.so" in line)
    found = next(paths, None)
    if found is None:
        raise FileNotFoundError("libz.so")
    return Path(found)


def _load_copy(library: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="colmap-netvlad-") as folder:
        # Under its own name and file the loader would take it for the one that it has.
        copy = Path(folder) / "libz-for-opencv.so"
        shutil.copy(library, copy)
        ctypes.CDLL(str(copy), mode=os.RTLD_GLOBAL | os.RTLD_DEEPBIND | os.RTLD_NOW)
