"""What is handed out: versions, dependencies, bounds, weights, and the scripts that check them."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import sys
import tomllib
from importlib.resources import files
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import colmap_netvlad
from colmap_netvlad.models.catalogue import CATALOGUE, DEFAULT
from colmap_netvlad.models.checkpoint import read_metadata

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OWN = canonicalize_name(PROJECT["name"])

MODULES = {
    "cv2": "opencv-python-headless",
    "faiss": "faiss-cpu",
    "mpl_toolkits": "matplotlib",
    "PIL": "pillow",
}
"""Import name -> distribution, where they differ."""

NOT_LOWEST = {"torch": "2.13.0"}
"""Left out of the run on the lowest versions; constraints-lowest.txt says why."""


def requirements(*extras: str) -> dict[str, Requirement]:
    """The dependencies, and those of some extras, by canonical name."""
    lines = list(PROJECT["dependencies"])
    for extra in extras:
        lines += PROJECT["optional-dependencies"][extra]
    found = {canonicalize_name(r.name): r for r in map(Requirement, lines)}
    return {name: requirement for name, requirement in found.items() if name != OWN}


def pins(file: str) -> dict[str, str]:
    """The versions of a file of constraints by canonical name."""
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    pinned = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pinned}


def imported(folder: Path) -> set[str]:
    """Top names of all modules that the code below a folder imports, wherever it does."""
    names: set[str] = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names.update(alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                names.add(node.module.partition(".")[0])
    return names


@pytest.fixture(scope="module")
def tasks() -> ModuleType:
    specification = importlib.util.spec_from_file_location("tasks", ROOT / "scripts" / "tasks.py")
    assert specification and specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_the_version_stands_in_one_place_and_its_copy() -> None:
    assert colmap_netvlad.__version__ == PROJECT["version"]
    assert importlib.metadata.version(OWN) == PROJECT["version"]


def test_the_dependencies_are_what_is_imported() -> None:
    package = Path(colmap_netvlad.__file__).parent
    foreign = imported(package) - set(sys.stdlib_module_names) - {"colmap_netvlad"}
    assert {canonicalize_name(MODULES.get(name, name)) for name in foreign} == set(
        requirements("cluster")
    )


def test_the_lowest_versions_are_the_bounds() -> None:
    bounds = {}
    for name, requirement in requirements("test").items():
        (bound,) = requirement.specifier
        assert bound.operator == ">=", f"{requirement} has no lower bound"
        bounds[name] = Version(NOT_LOWEST.get(name, bound.version))
    lowest = {name: Version(version) for name, version in pins("constraints-lowest.txt").items()}
    assert lowest == bounds


def test_the_tested_versions_pin_every_dependency_within_its_bounds() -> None:
    tested = pins("constraints.txt")
    for name, requirement in requirements("cluster", "fit", "test", "dev").items():
        assert name in tested, f"constraints.txt does not pin {name}"
        assert requirement.specifier.contains(tested[name]), f"{requirement} against {tested[name]}"


def test_the_classifiers_name_the_versions_of_python_that_are_allowed(tasks: ModuleType) -> None:
    prefix = "Programming Language :: Python :: 3."
    minors = [int(c.removeprefix(prefix)) for c in PROJECT["classifiers"] if c.startswith(prefix)]
    assert PROJECT["requires-python"] == f">=3.{min(minors)}"
    assert (3, min(minors)) == tasks.OLDEST
    assert minors == list(range(min(minors), max(minors) + 1))


def test_the_shipped_weights_and_the_templates_are_installed() -> None:
    shipped = [entry for entry in CATALOGUE.values() if entry.url is None]
    assert DEFAULT in {entry.name for entry in shipped}
    for entry in shipped:
        assert read_metadata(entry.path)["name"] == entry.name
    package = files("colmap_netvlad")
    assert any((package / "report" / "templates").iterdir())
    assert (package / "py.typed").is_file()


def test_every_shell_script_is_a_task_and_every_task_has_one(tasks: ModuleType) -> None:
    named = set()
    for path in (ROOT / "scripts").iterdir():
        if path.is_file() and (text := path.read_text(encoding="utf-8")).startswith("#!/bin/sh"):
            _, found, rest = text.partition('tasks.py" ')
            named |= {rest.split(" ")[0]} if found else set()
    assert named == set(tasks.TASKS)


def test_the_core_of_the_tests_is_there(tasks: ModuleType) -> None:
    assert [name for name in tasks.CORE if not (ROOT / name).is_file()] == []


def test_help_is_printed_and_nothing_set_up(
    tasks: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tasks, "TASKS", {})
    assert tasks.main(["setup", "--help"]) == 0
    assert "tasks.py setup [--dev]" in capsys.readouterr().out


def test_an_unknown_task_prints_the_list(
    tasks: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tasks.main(["deploy"]) == 2
    assert "scripts/tasks.py wheel" in capsys.readouterr().err


SOUND = {"name": "numpy", "version": "2.4.6", "vulns": []}
FAULT = {"id": "CVE-2026-1", "fix_versions": ["13.0.1"]}
FAULTY = {"name": "pillow", "version": "13.0.0", "vulns": [FAULT]}
SKIPPED = {"name": "torch", "skip_reason": "not found on PyPI"}


@pytest.mark.parametrize(
    ("libraries", "code", "said"),
    [
        ([SOUND], 0, "1 libraries audited, 0 vulnerabilities known"),
        ([SOUND, FAULTY, SKIPPED], 1, "pillow 13.0.0: CVE-2026-1, mended in 13.0.1"),
        ([SOUND, SKIPPED], 2, "could not be asked about torch"),
        ([SKIPPED, SKIPPED], 2, "0 libraries audited"),
        (None, 2, "could not be asked about anything"),
    ],
)
def test_an_audit_that_asked_nothing_is_no_clean_one(
    libraries: list[dict[str, object]] | None,
    code: int,
    said: str,
    tasks: ModuleType,
    capsys: pytest.CaptureFixture[str],
) -> None:
    report = None if libraries is None else {"dependencies": libraries, "fixes": []}
    assert tasks.verdict(report) == code
    assert said in "".join(capsys.readouterr())
