"""Small photos of every kind a memory card may hold, sound and broken."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

WIDTH, HEIGHT = 192, 144


def scene(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """(height, width, 3) RGB texture with features for SIFT, bright at the top left."""
    noise = np.random.default_rng(seed).normal(size=(height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    smooth = 60 * smooth / smooth.std() + 110
    smooth[: height // 2, : width // 2] += 60
    return np.clip(smooth, 0, 255).astype(np.uint8)


def save_jpeg(path: Path, pixels: NDArray[np.uint8], **exif: object) -> None:
    """Save as JPEG; keywords are EXIF: make, model, focal (35 mm), orientation, detail (tags)."""
    tags = Image.Exif()
    for key, tag in (("make", 0x010F), ("model", 0x0110), ("orientation", 0x0112)):
        if key in exif:
            tags[tag] = exif[key]
    detail = exif.get("detail", {})
    if "focal" in exif:
        detail = {0xA405: exif["focal"], **detail}
    if detail:
        tags[0x8769] = detail
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, quality=95, exif=tags)


def _grey(path: Path) -> None:
    Image.fromarray(scene()).convert("L").save(path, quality=95)


def _cmyk(path: Path) -> None:
    Image.fromarray(scene()).convert("CMYK").save(path, quality=95)


def _rgba(path: Path) -> None:
    Image.fromarray(scene()).convert("RGBA").save(path)


def _deep(path: Path) -> None:
    cv2.imwrite(str(path), cv2.cvtColor(scene(), cv2.COLOR_RGB2BGR).astype(np.uint16) * 257)


def _deep_grey(path: Path) -> None:
    cv2.imwrite(str(path), cv2.cvtColor(scene(), cv2.COLOR_RGB2GRAY).astype(np.uint16) * 257)


def _rotated(path: Path) -> None:
    """Stored lying on its side; upright it is `scene()`."""
    save_jpeg(path, np.ascontiguousarray(np.rot90(scene())), orientation=6)


SOUND: dict[str, Callable[[Path], None]] = {
    "plain.jpg": lambda path: save_jpeg(path, scene()),
    "plain.png": lambda path: Image.fromarray(scene()).save(path),
    "plain.bmp": lambda path: Image.fromarray(scene()).save(path),
    "grey.jpg": _grey,
    "cmyk.jpg": _cmyk,
    "rgba.png": _rgba,
    "deep.png": _deep,
    "deep.tif": _deep,
    "deep_grey.png": _deep_grey,
    "rotated.jpg": _rotated,
}
"""File name -> writer of a photo that is to be used; each shows `scene()`."""


def _cut(path: Path, share: float) -> None:
    SOUND["plain" + path.suffix](path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def _zeros_at_the_end(path: Path) -> None:
    """What a failed copy leaves: the right size, but the last blocks never written."""
    SOUND["plain.jpg"](path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))


BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "truncated.jpg": (lambda path: _cut(path, 0.6), "truncated"),
    "header_only.jpg": (lambda path: _cut(path, 0.01), "damaged header|not a photo|truncated"),
    "truncated.png": (lambda path: _cut(path, 0.6), "truncated"),
    "zeros.jpg": (_zeros_at_the_end, "truncated"),
    "empty.jpg": (lambda path: path.write_bytes(b"") and None, "empty"),
    "text.jpg": (lambda path: path.write_text("not a photo" * 99) and None, "not a photo"),
    "one.png": (
        lambda path: Image.fromarray(scene()[:1, :1]).save(path),
        "only 1 x 1 pixels",
    ),
}
"""File name -> writer of a photo that is to be left out, and a pattern of the reason."""
