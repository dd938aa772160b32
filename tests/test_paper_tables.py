"""The paper's tables from comparisons of our own."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from comparisons import made_up

from colmap_netvlad.comparison.result import write_json


@pytest.fixture(scope="module")
def script():
    path = Path(__file__).parents[1] / "scripts" / "paper_tables.py"
    spec = importlib.util.spec_from_file_location("paper_tables", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["paper_tables"] = module
    spec.loader.exec_module(module)
    return module


def test_tables_show_ours_beside_the_published(script, tmp_path):
    comparison, _ = made_up(30)
    write_json(tmp_path / "compare.json", comparison)
    result = CliRunner().invoke(script.main, [f"north={tmp_path / 'compare.json'}"])
    assert result.exit_code == 0, result.output
    ours = 100 * comparison.methods[0].best_k.accuracy
    row = f"| NetVLAD, ranked list, batched nontrivial | {ours:.2f} | 86.84 | 89.62 | 74.01 |"
    assert row in result.output
    assert "| 3D points: vlad | 4,000 | 965,066 | 1,477,146 | 2,080,135 |" in result.output
    assert "north: 30 photos, k = 10, models at k = 10" in result.output
    assert "cannot be compared number by number" in result.output


def test_scenes_are_named_after_their_folders(script, tmp_path):
    path = tmp_path / "sheffield" / "project-compare" / "compare.json"
    write_json(path, made_up(20)[0])
    assert script.read_scene(str(path)).name == "sheffield"


def test_missing_and_failed_methods_are_dashes_and_others_have_a_table(script):
    comparison, _ = made_up(20)
    bow = replace(comparison.methods[1], failed="broken", model=None)
    extra = replace(comparison.methods[2], name="spatial", model=None)
    changed = replace(comparison, methods=(comparison.methods[0], bow, extra))
    text = script.tables([script.Scene("a", changed), script.Scene("b", comparison)])
    assert "| Registered images: bow | – | 19 | 3,716 | 4,029 | 4,267 |" in text
    accuracy = 100 * extra.best_k.accuracy
    assert f"| spatial | {accuracy:.2f} | – | – | – |" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert all(line.count("|") >= 6 for line in lines)


def test_what_is_no_comparison_is_one_sentence(script, tmp_path):
    (tmp_path / "compare.json").write_text("{}")
    for path, message in (("gone.json", "does not exist"), ("compare.json", "not a comparison")):
        result = CliRunner().invoke(script.main, [str(tmp_path / path)])
        assert result.exit_code == 1 and message in result.output


def test_transcribed_figures_agree_between_the_papers_tables(script):
    five = {label: figures for label, _, figures in script.TABLE_5}
    six = {label: figures for label, _, figures in script.TABLE_6}
    for model in ("NetVLAD", "GeM", "MIRorR"):
        trained = next(f for label, f in five.items() if label.startswith(model) and "UAV" in label)
        assert trained == six[f"{model}, triplet, global hard negative"]
