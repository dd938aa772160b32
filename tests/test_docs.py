"""The documentation says what the code does: pages made from it, links, commands, methods."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import click
import pytest

from colmap_netvlad.cli import cli
from colmap_netvlad.retrieval.methods import METHODS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]

MEASURED = ("measurements.md", "model-card.md")
"""Where figures are at home, with the commands that made them."""

EXAMPLES = {"colour.py", "calibrated.py"}
"""Files of CONTRIBUTING.md's examples."""

README_LINES = 120
FIGURE_BYTES = 300_000


def make_reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "make_reference", ROOT / "scripts" / "make_reference.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


REFERENCE = make_reference().PAGES


@pytest.mark.parametrize("name", REFERENCE)
def test_the_reference_is_what_the_code_says(name: str) -> None:
    committed = (DOCS / name).read_text("utf-8")
    assert committed == REFERENCE[name](), "stale: run `python scripts/make_reference.py`"


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as mkdocs and repository pages make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), flags=re.MULTILINE)
    slugs = (re.sub(r"[^\w\s-]", "", title.lower()).strip() for title in titles)
    return {re.sub(r"[\s-]+", "-", slug) for slug in slugs}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if "://" in target:
            continue
        file, _, anchor = target.partition("#")
        found = (page.parent / file).resolve() if file else page
        assert found.is_file(), target
        if anchor:
            assert anchor in anchors(found), target


def written_commands(page: Path) -> list[str]:
    """Return the command lines of colmap-netvlad in a page: in its code, inline or in blocks."""
    text = page.read_text("utf-8").replace("\\\n", " ")
    code = re.findall(r"`([^`\n]+)`", text) + re.findall(r"^\s*(colmap-.+)$", text, re.MULTILINE)
    return [line.strip() for line in code if re.match(r"\s*colmap-netvlad [a-z]", line)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_the_text_exist_with_their_options(page: Path) -> None:
    for line in written_commands(page):
        _, name, *words = shlex.split(line.split(" > ")[0], comments=True)
        assert name in cli.commands, line
        context = click.Context(cli.commands[name], info_name=name)
        known = {
            flag
            for option in cli.commands[name].get_params(context)
            for flag in (*option.opts, *option.secondary_opts)
        }
        unknown = {word for word in words if word.startswith("-")} - known - {"--help"}
        assert not unknown, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_named_in_the_text_exist(page: Path) -> None:
    named = re.findall(r"`(?:python )?([\w./-]+\.(?:py|toml))\b", page.read_text("utf-8"))
    homes = (ROOT, ROOT / "colmap_netvlad", DOCS)
    missing = {
        name for name in named if not any((home / name).exists() for home in homes)
    } - EXAMPLES
    assert not missing


@pytest.mark.parametrize("page", [ROOT / "README.md", DOCS / "index.md"], ids=lambda p: p.name)
def test_figures_on_the_first_pages_stand_in_the_measurements(page: Path) -> None:
    section = page.read_text("utf-8").split("## How good, how fast")[1].split("\n## ")[0]
    measured = "".join((DOCS / name).read_text("utf-8") for name in MEASURED)
    figures = set(re.findall(r"\d+\.\d+", section))
    assert len(figures) > 4
    assert {figure for figure in figures if figure not in measured} == set()


def test_every_method_is_explained() -> None:
    page = (DOCS / "which-method.md").read_text("utf-8")
    assert [name for name in METHODS if f"`{name}`" not in page] == []


def test_the_readme_is_short_and_figures_are_light() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= README_LINES
    heavy = [p.name for p in DOCS.rglob("*.png") if p.stat().st_size > FIGURE_BYTES]
    assert heavy == []


def test_the_floor_plan_names_every_room() -> None:
    page = (DOCS / "how-it-works.md").read_text("utf-8")
    package = ROOT / "colmap_netvlad"
    rooms = [path.parent.name + "/" for path in package.glob("*/__init__.py")]
    modules = [path.name for path in package.glob("*.py") if not path.name.startswith("__")]
    assert [room for room in (*rooms, *modules) if f"`{room}`" not in page] == []


def test_the_site_builds_without_a_warning_and_fetches_nothing(tmp_path: Path) -> None:
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip('the tools of the site are not installed (pip install -e ".[docs]")')
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    fetching = re.compile(
        r"""<(?:script|img|iframe)[^>]*src=["']?(?:https?:)?//"""
        r"""|<link[^>]*rel=["']?stylesheet[^>]*href=["']?(?:https?:)?//"""
    )
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > len(list(DOCS.glob("*.md"))) - 1
    assert [page.name for page in pages if fetching.search(page.read_text("utf-8"))] == []
