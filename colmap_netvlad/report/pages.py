"""The templates of all pages, filled in one way: everything that is not ours is escaped."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined


def pages() -> Environment:
    """Return an environment of its own for a page, which adds its filters."""
    return Environment(
        loader=PackageLoader("colmap_netvlad.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
