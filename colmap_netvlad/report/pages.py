"""The templates of all pages, filled in one way: everything that is not ours is escaped."""

from __future__ import annotations

import re

from jinja2 import Environment, PackageLoader, StrictUndefined


def pages() -> Environment:
    """Return an environment of its own for a page, which adds its filters."""
    environment = Environment(
        loader=PackageLoader("colmap_netvlad.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["as_option"] = as_option
    return environment


def as_option(text: str) -> str:
    """Replace `name`, an argument of the library, by the option of the command line: a page's
    readers type commands."""
    return re.sub(r"`(\w+)`", lambda found: f"--{found[1].replace('_', '-')}", text)
