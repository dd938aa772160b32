"""Deep image pair retrieval for COLMAP on drone flights."""

import contextlib
import ctypes

__version__ = "0.1.0"

# pycolmap's Linux wheel exports zlib symbols that replace those inside libz when pycolmap loads
# it; OpenCV, loaded after it, then crashes on PNG files ("free(): invalid pointer"). Loading
# libz first, in whatever order users import the two, keeps them apart.
with contextlib.suppress(OSError):
    ctypes.CDLL("libz.so.1")
