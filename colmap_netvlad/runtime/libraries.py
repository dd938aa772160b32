"""Two libraries that do not get on: pycolmap's Linux wheel and the system's zlib."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import sys
import tempfile
from pathlib import Path


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
