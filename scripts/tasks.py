"""Set up, try, test, build and audit this checkout; on Linux, macOS and Windows alike.

    python scripts/tasks.py setup [--dev]   make .venv with the tested versions; --dev: test tools
    python scripts/tasks.py demo [...]      set up, then `colmap-netvlad demo`
    python scripts/tasks.py test [...]      set up --dev; style, types, all tests
    python scripts/tasks.py lowest [...]    core of the tests on the lowest versions allowed
    python scripts/tasks.py wheel           build sdist and wheel into dist/, try them elsewhere
    python scripts/tasks.py audit           known vulnerabilities of the tested versions

`scripts/setup`, `scripts/demo`, `scripts/test`, `scripts/test_lowest`, `scripts/test_wheel` and
`scripts/audit` are these for a POSIX shell. Further arguments go to the demo, or to pytest. Only
the standard library is needed. PYTHON=/path/to/python names another interpreter for the
environments that are made.

Exit codes: 0; that of the step that failed; of `audit`: 0 no known vulnerability, 1 some (listed),
2 the database of vulnerabilities could not be asked (offline), or not about all libraries.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
OLDEST = (3, 11)

RAY_TESTS = "tests/test_cluster.py"

CORE = [
    f"tests/test_{name}.py"
    for name in (
        "packaging", "store", "database", "search", "partners", "rerank", "pairs_command",
        "face", "features", "positions", "models_checkpoint", "matching", "match_rounds",
        "viewgraph", "partition", "merge", "reconstruct", "add", "report", "losses", "real_colmap",
    )
]  # fmt: skip
"""What is run on the lowest versions: each library's use, on the rendered flight."""


def main(arguments: list[str]) -> int:
    if "--help" in arguments:
        print(__doc__.rstrip())
        return 0
    if not arguments or arguments[0] not in TASKS:
        print(__doc__.rstrip(), file=sys.stderr)
        return 2
    os.chdir(ROOT)
    try:
        return TASKS[arguments[0]](arguments[1:])
    except subprocess.CalledProcessError as fault:
        return fault.returncode
    except KeyboardInterrupt:
        return 130


def setup(arguments: list[str]) -> int:
    if not python_of(VENV).exists():
        make_venv(VENV)
    package = ".[dev,docs]" if "--dev" in arguments else "."
    install(VENV, "--constraint", "constraints.txt", "--editable", package)
    print(f"Ready: {program_of(VENV).relative_to(ROOT)}")
    return 0


def demo(arguments: list[str]) -> int:
    setup([])
    return run(program_of(VENV), "demo", *arguments)


def test(arguments: list[str]) -> int:
    setup(["--dev"])
    debian_packages(chromium="browser tests", colmap="tests against COLMAP's own program")
    python = python_of(VENV)
    run(python, "-m", "ruff", "check", ".")
    run(python, "-m", "ruff", "format", "--check", ".")
    run(python, "-m", "mypy")
    pytest: tuple[str | Path, ...] = (python, "-m", "pytest", "-q")
    if arguments:
        return run(*pytest, "-n", "2", "--dist", "loadfile", *arguments)
    # Two Ray clusters of one machine find each other: who joins the other's ends with it.
    run(*pytest, "-n", "2", "--ignore", RAY_TESTS)
    return run(*pytest, RAY_TESTS)


def lowest(arguments: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        venv = Path(folder) / "venv"
        make_venv(venv, oldest=True)
        install(venv, "--constraint", "constraints-lowest.txt", "--editable", ".[test]")
        return run(python_of(venv), "-m", "pytest", "-q", "-n", "2", *CORE, *arguments)


def wheel(arguments: list[str]) -> int:
    setup(["--dev"])
    shutil.rmtree("dist", ignore_errors=True)
    # The wheel is built from the sdist, so that one made from a downloaded sdist is the same.
    run(python_of(VENV), "-m", "build", "--outdir", "dist")
    (sdist,), (built,) = Path("dist").glob("*.tar.gz"), Path("dist").glob("*.whl")
    with tempfile.TemporaryDirectory() as folder:
        outside, venv = Path(folder), Path(folder) / "venv"
        shutil.unpack_archive(sdist, outside)
        unpacked = outside / sdist.name.removesuffix(".tar.gz")
        if missing := [name for name in tracked_files() if not (unpacked / name).is_file()]:
            print(f"The sdist lacks {', '.join(missing)}: see MANIFEST.in.", file=sys.stderr)
            return 1
        make_venv(venv)
        install(venv, "--constraint", "constraints.txt", str(built))
        run(program_of(venv), "--version", cwd=outside)
        run(program_of(venv), "demo", "--output", "demo", cwd=outside)
        # The sdist's tests find all that they import, and the installed wheel has it.
        install(venv, "--constraint", "constraints.txt", f"{built}[fit,test]")
        shutil.rmtree(unpacked / "colmap_netvlad")
        run(python_of(venv), "-m", "pytest", "-q", "--collect-only", "-qq", cwd=unpacked)
        return run(python_of(venv), "-m", "pytest", "-q", "tests/test_packaging.py", cwd=unpacked)


def audit(arguments: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        venv = Path(folder) / "venv"
        make_venv(venv)
        try:
            install(venv, "pip-audit")
        except subprocess.CalledProcessError:
            return verdict(None)
        # The pins are all there is, so nothing is installed or resolved.
        pins = ["--no-deps", "--disable-pip", "--requirement", "constraints.txt"]
        program = [python_of(venv), "-m", "pip_audit", "--progress-spinner", "off"]
        done = subprocess.run(
            [*program, "--format", "json", *pins, *arguments], capture_output=True, text=True
        )
    if not done.stdout.strip():
        print(done.stderr, end="", file=sys.stderr)
        return verdict(None)
    return verdict(json.loads(done.stdout))


def verdict(report: dict[str, list[dict[str, Any]]] | None) -> int:
    """Print what pip-audit's JSON says, and return the exit code; None: there is no answer.

    pip-audit itself calls it a success where it could ask about no library at all.
    """
    libraries = report["dependencies"] if report else []
    skipped = [library["name"] for library in libraries if "skip_reason" in library]
    known = [(library, fault) for library in libraries for fault in library.get("vulns", [])]
    for library, fault in known:
        mended = " or ".join(fault["fix_versions"]) or "nowhere yet"
        print(f"{library['name']} {library['version']}: {fault['id']}, mended in {mended}")
    print(f"{len(libraries) - len(skipped)} libraries audited, {len(known)} vulnerabilities known.")
    if skipped or not libraries:
        print(
            "The database of vulnerabilities (pypi.org) could not be asked about "
            f"{', '.join(skipped) or 'anything'}; try again with a connection to it.",
            file=sys.stderr,
        )
    return 1 if known else 2 if skipped or not libraries else 0


def make_venv(venv: Path, oldest: bool = False) -> None:
    """Make an environment; `oldest`: with Python 3.11 where it is on PATH, as the lowest
    versions of the libraries have no wheels for newer ones."""
    named = os.environ.get("PYTHON")
    old = shutil.which("python{}.{}".format(*OLDEST)) if oldest and not named else None
    python = named or old or sys.executable
    if subprocess.call([python, "-c", f"import sys; sys.exit(sys.version_info < {OLDEST})"]):
        sys.exit("Python 3.11 or newer is needed; name one with PYTHON=/path/to/python3.11.")
    run(python, "-m", "venv", venv)


def install(venv: Path, *arguments: str) -> None:
    run(python_of(venv), "-m", "pip", "install", "--quiet", "--disable-pip-version-check",
        *arguments)  # fmt: skip


def debian_packages(**purposes: str) -> None:
    """Install programs that tests use where that can be done; they are skipped where not."""
    for package, purpose in purposes.items():
        if shutil.which(package):
            continue
        if not shutil.which("apt-get") or os.geteuid() != 0:
            continue
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        subprocess.call(["apt-get", "-qq", "update"], **quiet)
        if subprocess.call(["apt-get", "-qq", "install", "--yes", package], **quiet):
            print(f"{package} could not be installed: {purpose} are skipped.", file=sys.stderr)


def tracked_files() -> list[str]:
    """What a checkout has, but for what only git and the CI read."""
    listed = subprocess.check_output(["git", "ls-files", "-z"], text=True).split("\0")
    return [name for name in listed if name and not name.startswith((".git", ".ci/"))]


def python_of(venv: Path) -> Path:
    return venv / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def program_of(venv: Path) -> Path:
    return python_of(venv).with_name("colmap-netvlad" + (".exe" if os.name == "nt" else ""))


def run(program: str | Path, *arguments: str | Path, cwd: Path = ROOT) -> int:
    """Run a program and return 0.

    Raises:
        CalledProcessError: it failed.
    """
    subprocess.run([program, *arguments], check=True, cwd=cwd)
    return 0


TASKS = {
    "setup": setup,
    "demo": demo,
    "test": test,
    "lowest": lowest,
    "wheel": wheel,
    "audit": audit,
}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
