"""Photos small enough to live inside a page."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2

from colmap_netvlad.photos.decode import decode_photo
from colmap_netvlad.photos.files import BadPhoto, photo_path

LONG_SIDE = 208
"""Of a thumbnail, px: sharp on screens of twice the density at the size the page shows."""

QUALITY = 72
"""JPEG quality: about 8 kB a thumbnail."""


def data_uri(kind: str, content: bytes) -> str:
    """Return bytes as an address that needs no file beside the page (`kind` is a MIME type)."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


class Thumbnails:
    """Thumbnails of a photo folder, each decoded once; "" where a photo cannot be shown."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._made: dict[str, str] = {}

    def __call__(self, name: str) -> str:
        """Return a photo as data URI."""
        if name not in self._made:
            self._made[name] = self._make(name)
        return self._made[name]

    def _make(self, name: str) -> str:
        if self._folder is None:
            return ""
        try:
            pixels = decode_photo(photo_path(self._folder, name), LONG_SIDE)
        except BadPhoto:
            return ""
        jpeg = cv2.imencode(
            ".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
        )[1]
        return data_uri("image/jpeg", jpeg.tobytes())
