"""The XMP block of a photo, in which drones say what EXIF has no tag for."""

from __future__ import annotations

import re

from PIL import Image

_VALUE = re.compile(r'([\w-]+:\w+)\s*=\s*"([^"]*)"|<([\w-]+:\w+)>([^<]*)</')
"""A property is an attribute with some writers and an element with others."""


def properties(photo: Image.Image) -> dict[str, str]:
    """Return an open photo's XMP properties by qualified name; empty where it has none."""
    block = photo.info.get("xmp", b"")
    text = block.decode("utf-8", "replace") if isinstance(block, bytes) else str(block)
    return {
        attribute or element: (value or content).strip()
        for attribute, value, element, content in _VALUE.findall(text)
    }
