"""What the library says speaks of arguments; the command line shows the options they stand for."""

from __future__ import annotations

import ast
import logging
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import colmap_netvlad
from colmap_netvlad.cli import cli
from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.terminal import Command, Group, say

PACKAGE = Path(colmap_netvlad.__file__).parent
COMMAND_LINE = {"cli.py", "cli_options.py", "cli_settings.py", "terminal.py", "__main__.py"}
LIBRARY = [p for p in sorted(PACKAGE.rglob("*.py")) if p.name not in COMMAND_LINE]

OPTION = re.compile(r"(?<![\w|-])--[a-z]")
QUOTED = re.compile(r"`(?:colmap-netvlad train --help|ray start [^`]*)`")
"""Whole commands, ours and Ray's."""

NEXT_COMMAND = ("--db", "--pairs")  # a whole command, to be copied

ARGUMENT = re.compile(r"`(\w+)`")


def texts(tree: ast.AST) -> Iterator[str]:
    """Yield every string of the code but documentation, with `{}` for what is filled in."""
    documentation = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    parts = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            values = (
                part.value if isinstance(part, ast.Constant) else "{}" for part in node.values
            )
            yield "".join(map(str, values))
        elif isinstance(node, ast.Constant) and id(node) not in documentation | parts:
            yield str(node.value)


def messages(tree: ast.AST) -> Iterator[str]:
    """Yield the texts of every InputError."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "InputError":
            yield from texts(node)


def parameters() -> set[str | None]:
    context = click.Context(cli)
    return {p.name for command in cli.commands.values() for p in command.get_params(context)}


@pytest.mark.parametrize("path", LIBRARY, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_the_library_knows_no_command_line(path: Path) -> None:
    tree = ast.parse(path.read_text("utf-8"))
    imported = {
        name.split(".")[0]
        for node in ast.walk(tree)
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert not imported & {"click", "rich"}
    printed = [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print"
    ]
    assert not printed


def test_messages_speak_of_arguments_and_each_is_an_option_of_a_command() -> None:
    known = parameters()
    seen = 0
    for path in LIBRARY:
        tree = ast.parse(path.read_text("utf-8"))
        for text in texts(tree):
            if text not in NEXT_COMMAND:
                assert not OPTION.search(QUOTED.sub("", text)), f"{path.name}: {text}"
        for message in messages(tree):
            seen += 1
            unknown = set(ARGUMENT.findall(message)) - known
            assert not unknown, f"{path.name}: {message}"
    assert seen > 100


@click.group(cls=Group)
def program() -> None:
    pass


@program.command()
@click.option("--db", "--database_path", "database")
@click.option("--max-image-size", type=int)
@click.option("-v", "--verbose", is_flag=True)
@click.option("--connect/--no-connect", default=True)
def fail(**options: object) -> None:
    raise InputError("Mend `database`, lower `max_image_size`, `connect`, or leave `images` out.")


@program.command()
@click.option("--k", type=int)
def work(k: int) -> None:
    logger = logging.getLogger("colmap_netvlad.somewhere")
    logger.info("A note, raise `k`.")
    logger.debug("A detail.")
    with progress.step("Working", 0):
        say("A larger `k` may help.")


def test_a_fault_is_one_sentence_with_the_options_of_the_running_command() -> None:
    result = CliRunner().invoke(program, ["fail"])
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert result.stderr == (
        "Error: Mend --db, lower --max-image-size, --connect, or leave `images` out.\n"
    )


def test_notes_go_to_standard_error_and_the_report_to_standard_output() -> None:
    result = CliRunner().invoke(program, ["work"])
    assert result.exit_code == 0
    assert result.stdout == "A larger --k may help.\n"
    assert result.stderr == "A note, raise --k.\n"


def test_nothing_stays_installed_after_a_command() -> None:
    logger = logging.getLogger("colmap_netvlad")
    before = list(logger.handlers), logger.level
    CliRunner().invoke(program, ["work"])
    CliRunner().invoke(program, ["fail"])
    assert (list(logger.handlers), logger.level) == before
    assert progress._reporter is progress.silent


def test_every_command_shows_faults_that_way() -> None:
    assert all(isinstance(command, Command) for command in cli.commands.values())


def test_an_input_error_is_a_plain_exception() -> None:
    fault = InputError("The disk is full.")
    assert str(fault) == fault.message == "The disk is full."
    assert not isinstance(fault, click.ClickException)
