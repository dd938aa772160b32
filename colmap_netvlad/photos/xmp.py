"""The XMP block of a photo, in which drones say what EXIF has no tag for."""

from __future__ import annotations

import re

from PIL import Image

_VALUE = re.compile(r'([\w-]+:\w+)\s*=\s*"([^"]*)"|<([\w-]+:\w+)>([^<]*)</')
"""A property is an attribute with some writers and an element with others."""

XMP_TAG = 700
"""TIFF's tag of the block."""


def properties(photo: Image.Image) -> dict[str, str]:
    """Return an open photo's XMP properties by qualified name; empty where it has none."""
    # Older versions of Pillow leave a TIFF file's block among its tags.
    block = photo.info.get("xmp") or getattr(photo, "tag_v2", {}).get(XMP_TAG, b"")
    text = block.decode("utf-8", "replace") if isinstance(block, bytes) else str(block)
    return {
        attribute or element: (value or content).strip()
        for attribute, value, element, content in _VALUE.findall(text)
    }
