"""The examples of CONTRIBUTING.md work: each section's code, in order, on the rendered flight."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.mapping import MAPPERS
from colmap_netvlad.models.aggregation import AGGREGATIONS
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods import METHODS
from colmap_netvlad.retrieval.options import RetrievalOptions

PAGE = Path(__file__).parents[1] / "CONTRIBUTING.md"
TABLES = {"A retrieval method": METHODS, "A model": AGGREGATIONS, "A mapper": MAPPERS}
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def sections() -> dict[str, list[str]]:
    """Return the Python blocks of each section that has any."""
    parts = re.split(r"^## (.+)$", PAGE.read_text("utf-8"), flags=re.MULTILINE)
    found = {
        title: BLOCK.findall(text) for title, text in zip(parts[1::2], parts[2::2], strict=True)
    }
    return {title: blocks for title, blocks in found.items() if blocks}


def test_each_table_has_its_section() -> None:
    assert set(sections()) == set(TABLES)


@pytest.mark.parametrize("title", TABLES)
def test_the_example_of_a_section_works(
    title: str, project_copy: Callable[..., Project], monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy(matched=title == "A mapper")
    if title == "A mapper":
        make_pairs(project, "exhaustive")
    table = TABLES[title]
    rows = dict(table)
    # What an example starts from: a project, and what the first section imported.
    names = {"project": project, "make_pairs": make_pairs, "RetrievalOptions": RetrievalOptions}
    try:
        for number, block in enumerate(sections()[title], 1):
            place = f"CONTRIBUTING.md, {title}, block {number}"
            exec(compile(block, place, "exec", dont_inherit=True), names)
        assert set(table) > set(rows)
    finally:
        table.clear()
        table.update(rows)  # type: ignore[arg-type]
