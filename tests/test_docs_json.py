"""The examples of docs/json.md have the keys and types that the commands print."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from colmap_netvlad.cli import cli
from colmap_netvlad.project import Project

PAGE = Path(__file__).parents[1] / "docs" / "json.md"
EXAMPLE = re.compile(r"^## (\w+)\n\n```json\n(.*?)^```$", re.MULTILINE | re.DOTALL)
EXAMPLES = {name: json.loads(text) for name, text in EXAMPLE.findall(PAGE.read_text("utf-8"))}

COMMANDS = {
    "pairs": ["--method", "vlad", "--k", "4"],
    "match": ["--rounds", "2", "--k", "3", "--method", "vlad"],
    "reconstruct": [],
    "viewgraph": [],
    "methods": [],
}


def differences(told: Any, real: Any, place: str = "") -> list[str]:
    """Return where keys or types differ; of lists the first items count, None fits anything."""
    if told is None or real is None:
        return []
    if isinstance(told, dict) and isinstance(real, dict):
        if list(told) != list(real):
            return [f"{place or 'keys'}: {list(told)} is {list(real)}"]
        return [d for key in told for d in differences(told[key], real[key], f"{place}.{key}")]
    if isinstance(told, list) and isinstance(real, list):
        return differences(told[0], real[0], f"{place}[0]") if told and real else []
    return [] if type(told) is type(real) else [f"{place}: {told!r} is {real!r}"]


def test_every_command_with_json_has_an_example() -> None:
    with_json = {
        name
        for name, command in cli.commands.items()
        if any("--json" in option.opts for option in command.params)
    }
    assert set(EXAMPLES) == set(COMMANDS) == with_json


@pytest.mark.parametrize("name", COMMANDS)
def test_an_example_is_what_the_command_prints(
    name: str, project_copy: Callable[..., Project]
) -> None:
    project = project_copy(matched=name in ("reconstruct", "viewgraph"))
    arguments = [name, *COMMANDS[name], "--json"]
    if name != "methods":
        arguments += ["--db", str(project.database)]
    if name == "reconstruct":
        CliRunner().invoke(cli, ["pairs", "--db", str(project.database), "--method", "exhaustive"])
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.stderr
    assert differences(EXAMPLES[name], json.loads(done.stdout)) == []
