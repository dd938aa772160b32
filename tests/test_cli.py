"""The command line as a whole."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from colmap_netvlad import __version__
from colmap_netvlad.cli import cli

README = Path(__file__).parents[1] / "README.md"


def commands() -> Iterator[tuple[str, click.Command]]:
    for name, command in cli.commands.items():
        yield name, command
        if isinstance(command, click.Group):
            yield from ((f"{name} {sub}", child) for sub, child in command.commands.items())


ALL = dict(commands())


@pytest.mark.parametrize("name", ALL)
def test_every_command_and_option_is_explained(name: str) -> None:
    command = ALL[name]
    assert command.help, name
    unexplained = [
        option.opts
        for option in command.params
        if isinstance(option, click.Option) and not option.help
    ]
    assert not unexplained
    result = CliRunner().invoke(cli, [*name.split(), "--help"])
    assert result.exit_code == 0 and "Usage:" in result.output


@pytest.mark.parametrize("name", ALL)
def test_every_command_is_in_the_readme(name: str) -> None:
    text = README.read_text("utf-8")
    assert f"`{name}" in text or f"colmap-netvlad {name}" in text


def test_the_main_job_s_commands_are_there() -> None:
    assert {"features", "pairs", "reconstruct", "demo"} <= set(ALL)


def test_python_m_is_the_command_and_tells_the_version() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "colmap_netvlad", "--version"], capture_output=True, text=True
    )
    assert done.returncode == 0 and __version__ in done.stdout


def test_help_loads_none_of_the_heavy_libraries() -> None:
    code = (
        "import sys; from click.testing import CliRunner; from colmap_netvlad.cli import cli;"
        "[CliRunner().invoke(cli, [*name, '--help'])"
        " for name in ([], ['features'], ['pairs'], ['reconstruct'], ['demo'])];"
        "heavy = ('torch', 'pycolmap', 'cv2', 'faiss', 'matplotlib');"
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_no_project_in_the_current_folder_is_said(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "colmap_netvlad", "reconstruct"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(README.parent)},
    )
    assert done.returncode == 1
    assert done.stderr.startswith("Error: No project.db or database.db in ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
