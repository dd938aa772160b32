"""The floor plan: what may import what, and the way of a project through a command."""

from __future__ import annotations

import ast
import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import networkx as nx
import pytest

import colmap_netvlad
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.flight import Flight
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions

PACKAGE = Path(colmap_netvlad.__file__).parent
NAME = PACKAGE.name

FLOORS = [
    ["cli", "cli_options", "cli_settings", "terminal", "__main__"],
    ["commands"],
    ["demo", "training"],
    ["report"],
    ["comparison"],
    ["export"],
    ["geo"],
    ["mapping"],
    ["matching"],
    ["pairs"],
    ["metrics"],
    ["retrieval"],
    ["graph"],
    ["models"],
    ["flight"],
    ["project"],
    ["cache"],
    ["colmap"],
    ["photos"],
    ["runtime"],
]
"""From the roof to the ground; a room may import its own floor and those below."""

HEIGHT = {room: len(FLOORS) - i for i, rooms in enumerate(FLOORS) for room in rooms}


def modules() -> dict[str, ast.Module]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = ast.parse(path.read_text("utf-8"))
    return found


MODULES = modules()


def imports() -> Iterator[tuple[str, str]]:
    """Yield (importing module, imported module) within the package, whenever it is imported."""
    for name, tree in MODULES.items():
        if name == NAME:
            continue  # the face, whose imports are lazy names
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(NAME):
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    yield name, whole if whole in MODULES else str(node.module)
            elif isinstance(node, ast.Import):
                yield from ((name, a.name) for a in node.names if a.name.startswith(NAME))


def room(module: str) -> str:
    return module.split(".")[1]


def test_every_room_has_its_floor() -> None:
    rooms = {room(name) for name in MODULES if name != NAME}
    assert rooms == HEIGHT.keys()


def test_no_arrow_runs_up() -> None:
    up = {f"{a} -> {b}" for a, b in imports() if b != NAME and HEIGHT[room(b)] > HEIGHT[room(a)]}
    assert not up


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = nx.DiGraph((a, b) for a, b in imports() if a != b)
    assert [c for c in nx.strongly_connected_components(graph) if len(c) > 1] == []


@pytest.mark.parametrize("table", ["two_view_geometries", "keypoints", "pose_priors"])
def test_only_the_room_colmap_knows_tables(table: str) -> None:
    knowing = {
        name
        for name, tree in MODULES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and f" {table}" in node.value
        and any(word in node.value for word in ("SELECT", "INSERT", "DELETE", "UPDATE"))
    }
    assert {room(name) for name in knowing} == {"colmap"}


def test_a_project_climbs_at_most_three_times_on_its_way_through_pairs(
    project_copy: Callable[..., Project], tiny_checkpoint: Path
) -> None:
    """Stations are the functions that are handed the project, or the flight read from it."""
    way: list[str] = []

    def watch(frame: FrameType, event: str, argument: Any) -> None:
        module = frame.f_globals.get("__name__", "")
        if event != "call" or not module.startswith(f"{NAME}."):
            return
        names = frame.f_code.co_varnames[: frame.f_code.co_argcount]
        values = [frame.f_locals.get(name) for name in names]
        own = names[:1] == ("self",)  # a look at its own fields is no station
        if not own and any(isinstance(value, Project | Flight) for value in values):
            way.append(room(module))

    sys.setprofile(watch)
    try:
        make_pairs(project_copy(), "hybrid", RetrievalOptions(k=3, model=tiny_checkpoint))
    finally:
        sys.setprofile(None)
    climbs = [b for a, b in itertools.pairwise(way) if HEIGHT[b] > HEIGHT[a]]
    assert len(climbs) <= 3, way
    assert len(way) <= 20, way
