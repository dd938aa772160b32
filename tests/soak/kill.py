"""Kill commands at random moments, run them again, and compare with an undisturbed run.

    python tests/soak/kill.py match --times 100 --seed 0
    python tests/soak/kill.py match --times 30 --signal INT

Each try starts the command on a small rendered flight, sends SIGKILL at a random moment (to the
command, or to it and its workers), once to three times, then lets it run to its end. Wanted are
the same images, features, matches, pairs, figures and weights as of a run that nobody disturbed, a
database that sqlite and COLMAP find whole after each kill, and no file left behind.

With `--signal INT` (Ctrl-C: the command and its workers get it) or `TERM` (the command alone) it is
asked to stop instead, and has to within `STOPS_WITHIN` seconds, leaving nothing behind at once.

`--first NUMBER --times 1` repeats one try; `--minutes` ends a run early and says where to go on.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import pkgutil
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import colmap_netvlad
from colmap_netvlad.cli import main as main_of_command

PAGE = "report.html"
"""The last thing that a command writes beside a model."""

STOPS_WITHIN = 2.0
"""How long a command may take to stop when asked, s."""

LONGEST = 600.0
"""A run that takes longer than this hangs, s."""

TIMES = ("seconds", "created", "time", "ms_", "timed", "measured", "memory", "database")
"""Words in the names of figures that differ between two undisturbed runs."""


@dataclass(frozen=True)
class Kind:
    """A command under test.

    Attributes:
        words: its words, where {} stands for the project's folder.
        sound: prepares the folder that it starts from.
        makes: the model that a finished run has made, where another run makes another.
        refusal: what a finished command says when it is run again, where it is refused.
    """

    words: tuple[str, ...]
    sound: Callable[[Path], None]
    makes: str = ""
    refusal: str = ""


def photos(folder: Path, seed: int = 0, rows: int = 2) -> None:
    """Eight rendered photos: two rows of four."""
    from colmap_netvlad.demo.render import FlightOptions, render_flight

    options = FlightOptions(rows=rows, columns=4, width=400, height=300, altitude=45.0, seed=seed)
    render_flight(folder / "flight", options)
    (folder / "flight" / "images").rename(folder / "images")
    shutil.rmtree(folder / "flight")


def features(folder: Path, rows: int = 2, few: tuple[str, ...] = ()) -> None:
    """The same with features."""
    photos(folder, rows=rows)
    run(folder, "features", "--images", "{}/images", "--db", "{}/project.db", *(few or FEW))


def listed(folder: Path, rows: int = 2, few: tuple[str, ...] = ()) -> None:
    """The same with a list of all pairs."""
    features(folder, rows, few)
    names = sorted(path.name for path in (folder / "images").iterdir())
    pairs = [f"{a} {b}\n" for a in names for b in names if a < b]
    (folder / "pairs.txt").write_text("".join(pairs))


def matched(folder: Path, rows: int = 2, few: tuple[str, ...] = ()) -> None:
    """The same, matched."""
    listed(folder, rows, few)
    run(folder, "match", "--db", "{}/project.db")


def larger(folder: Path) -> None:
    """Twelve photos, matched: models of fewer than ten are not merged."""
    matched(folder, rows=3, few=("--max-features", "400", "--threads", "1"))


def built(folder: Path) -> None:
    """A model of seven photos, and an eighth that is to join."""
    photos(folder)
    last = max((folder / "images").iterdir())
    last.rename(folder / "new.jpg")
    run(folder, "features", "--images", "{}/images", "--db", "{}/project.db", *FEW)
    run(folder, "pairs", "--db", "{}/project.db", "--method", "exhaustive")
    run(folder, "reconstruct", "--db", "{}/project.db", *ONE)
    (folder / "new.jpg").rename(last)


def annotated(folder: Path) -> None:
    """Two annotated scenes and weights to begin from."""
    import torch
    from safetensors.torch import save_file

    from colmap_netvlad.models.backbones import build_trunk

    for seed, scene in enumerate(("first", "second")):
        (folder / scene).mkdir()
        photos(folder / scene, seed)
    run(folder, "annotate", "{}/first", "{}/second", "--output", "{}/scenes",
        "--method", "exhaustive")  # fmt: skip
    torch.manual_seed(0)
    save_file(build_trunk("efficientnet-lite0-stage5").state_dict(), folder / "lite.safetensors")


FEW = ("--max-features", "800", "--threads", "1")
ONE = ("--mapper", "incremental", "--threads", "1")
CLUSTERS = ("--mapper", "parallel", "--cluster-size", "6", "--threads", "1")
DB = ("--db", "{}/project.db")

KINDS = {
    "features": Kind(("features", "--images", "{}/images", *DB, *FEW), photos),
    "pairs": Kind(("pairs", *DB, "--method", "hybrid", "--k", "3"), features),
    "pairs-bow": Kind(("pairs", *DB, "--method", "bow", "--k", "3"), features),
    "match": Kind(("match", *DB), listed),
    "match-rounds": Kind(("match", *DB, "--rounds", "2", "--k", "2", "--method", "vlad"), features),
    "reconstruct": Kind(("reconstruct", *DB, *ONE), matched, "sparse/0"),
    "reconstruct-parallel": Kind(("reconstruct", *DB, *CLUSTERS), larger, "sparse/0"),
    "add": Kind(
        ("add", *DB, "--images", "{}/images", "--method", "vlad", "--k", "5"),
        built,
        "sparse-2/0",
        "There are no new photos",
    ),
    "compare": Kind(
        ("compare", *DB, "--methods", "vlad,random", "--k", "2,3", "--no-reconstruct"), features
    ),
    "train": Kind(
        ("train", "{}/scenes", "--output", "{}/run", "--trunk", "efficientnet-lite0-stage5",
         "--weights", "{}/lite.safetensors", "--clusters", "4", "--width", "96", "--height", "64",
         "--positives", "2", "--epsilon", "10", "--epochs", "2", "--iterations", "3",
         "--checkpoint-every", "1", "--long-side", "96", "--rotations", "1"),
        annotated,
    ),
}  # fmt: skip


# Running


def start(folder: Path, *words: str) -> int:
    """Start a command in a process of its own and return its id."""
    process = os.fork()
    with suppress(OSError):  # whoever of the two is first
        os.setpgid(process, process)
    if process:
        return process
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background
    log = os.open(folder.parent / "log.txt", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.environ["TMPDIR"] = str(scratch_of(folder))
    tempfile.tempdir = None
    sys.argv = ["colmap-netvlad", *(word.replace("{}", str(folder)) for word in words)]
    code = 1
    try:
        main_of_command()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def scratch_of(folder: Path) -> Path:
    """The temporary disk of a project's commands."""
    scratch = folder.parent / "scratch"
    scratch.mkdir(exist_ok=True)
    return scratch


def run(folder: Path, *words: str) -> float:
    """Run a command to its end and return how long it took, s."""
    began = time.monotonic()
    code, log = ended(folder, words)
    if code != 0:
        raise RuntimeError(f"{words}: {log}")
    return time.monotonic() - began


def ended(folder: Path, words: tuple[str, ...]) -> tuple[int, str]:
    """Run a command; return its exit code and what it printed."""
    process, began = start(folder, *words), time.monotonic()
    while time.monotonic() - began < LONGEST:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            log = (folder.parent / "log.txt").read_text(errors="replace")
            return os.waitstatus_to_exitcode(status), log
        time.sleep(0.01)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    raise RuntimeError(f"{words} hangs")


def killed(
    folder: Path, words: tuple[str, ...], after: float, sent: signal.Signals, group: bool
) -> float | None:
    """Start a command and send it a signal after some seconds.

    Returns:
        How long it took to end, s; None where it had ended before.
    """
    process = start(folder, *words)
    deadline = time.monotonic() + after
    while time.monotonic() < deadline:
        done, _ = os.waitpid(process, os.WNOHANG)
        if done:
            return None
        time.sleep(0.002)
    began = time.monotonic()
    (os.killpg if group else os.kill)(process, sent)
    while time.monotonic() - began < LONGEST:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            log = (folder.parent / "log.txt").read_text(errors="replace")
            if "Traceback" in log:
                raise RuntimeError(f"{words}, {sent.name} after {after:.2f} s: {log[-2000:]}")
            # Ended well, it was at its end when the signal came.
            return None if status == 0 else time.monotonic() - began
        time.sleep(0.002)
    os.killpg(process, signal.SIGKILL)
    raise RuntimeError(f"{words} does not end by {sent.name}")


def complete(kind: Kind, folder: Path) -> list[str]:
    """Run a command once more, where it has not come to its end, and return what was wrong."""
    if not finished(kind, folder):
        run(folder, *kind.words)
    if not kind.refusal:
        return []
    code, log = ended(folder, kind.words)
    return [] if code and kind.refusal in log else [f"run again: exit code {code}: {log[-1500:]}"]


def finished(kind: Kind, folder: Path) -> bool:
    """Whether a command has come to its end where another run would make another model."""
    return bool(kind.makes) and (folder / kind.makes / PAGE).exists()


# Comparing


def state(folder: Path) -> dict[str, Any]:
    """Return what a command has made, without times."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".db" and path.name != "seconds.db":
            found[name] = _tables(path)
        elif path.name == "pairs.txt" or path.suffix == ".safetensors":
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.name == "points3D.bin":
            found[name] = _figures(path.parent)
        elif path.name == "compare.json":
            found[name] = _timeless(json.loads(path.read_text()))
        elif path.is_file():
            found[name] = "there"
    return found


def _tables(path: Path) -> dict[str, Any]:
    with closing(sqlite3.connect(path)) as connection:
        names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        found = {}
        for (name,) in names:
            if name in ("photos", "sqlite_sequence", "settings"):
                continue
            columns = [row[1] for row in connection.execute(f"PRAGMA table_info({name})")]
            kept = ", ".join(column for column in columns if column != "seconds")
            rows = connection.execute(f"SELECT {kept} FROM {name} ORDER BY 1, 2").fetchall()
            found[name] = (len(rows), hashlib.sha256(repr(rows).encode()).hexdigest())
        return found


def _figures(model: Path) -> tuple[int, int, float]:
    import pycolmap

    read = pycolmap.Reconstruction(model)
    error = round(read.compute_mean_reprojection_error(), 6)
    return read.num_reg_images(), read.num_points3D(), error


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            key: _timeless(item)
            for key, item in value.items()
            if not any(word in key for word in TIMES) and key != "notes"
        }
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def check_whole(folder: Path) -> None:
    """Make sure that sqlite finds every database whole, and COLMAP its own."""
    import pycolmap

    for path in folder.rglob("*.db"):
        with closing(sqlite3.connect(path)) as connection:
            (said,) = connection.execute("PRAGMA integrity_check").fetchone()
            if said != "ok":
                raise RuntimeError(f"{path}: {said}")
    project = folder / "project.db"
    if project.exists():
        pycolmap.Database.open(project).close()


def left_behind(folder: Path) -> list[str]:
    """Return the temporary files that are still there."""
    hidden = [path for path in folder.rglob("*") if path.name.startswith(".")]
    parts = [path for path in folder.rglob("*") if path.suffix in (".tmp", ".part")]
    scratch = [path for path in scratch_of(folder).iterdir() if "torch" not in path.name]
    return [str(path) for path in (*hidden, *parts, *scratch)]  # PyTorch keeps a cache of its own


def differences(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return what two states differ in."""
    return [
        f"{key}: {one.get(key)} instead of {other.get(key)}"
        for key in sorted({*one, *other})
        if one.get(key) != other.get(key)
    ]


def options(parser: argparse.ArgumentParser, times: int) -> argparse.Namespace:
    """Read a soak's command line."""
    parser.add_argument("command", choices=KINDS)
    parser.add_argument("--times", type=int, default=times)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="begin with the try of this number")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no try after")
    return parser.parse_args()


def tries(chosen: argparse.Namespace) -> Iterator[tuple[int, np.random.Generator]]:
    """Yield the number and the randomness of each try until the time is up."""
    until = time.monotonic() + 60 * chosen.minutes
    for number in range(chosen.first, chosen.first + chosen.times):
        if time.monotonic() > until:
            print(f"go on with --first {number} --times {chosen.first + chosen.times - number}")
            return
        yield number, np.random.default_rng([chosen.seed, number])


def disturbed(
    kind: Kind,
    folder: Path,
    seconds: float,
    sent: signal.Signals,
    random: np.random.Generator,
) -> tuple[list[float], list[str]]:
    """Kill or stop a command one to three times.

    Returns:
        How long it took to end, s, and what was wrong with that.
    """
    took, wrong = [], []
    for _ in range(random.integers(1, 4)):
        after = float(random.uniform(0, 1.1 * seconds))
        both = bool(random.integers(2))
        group = both if sent == signal.SIGKILL else sent == signal.SIGINT
        ended = killed(folder, kind.words, after, sent, group)
        check_whole(folder)
        if ended is not None:
            took.append(ended)
        if sent != signal.SIGKILL:
            # Finished clusters are kept for the next run.
            wrong += [left for left in left_behind(folder) if not left.endswith(".clusters")]
            if ended is not None and ended > STOPS_WITHIN:
                wrong.append(f"{sent.name} after {after:.2f} s: stopped within {ended:.2f} s")
        if ended is None or finished(kind, folder):
            break
    return took, wrong


def main() -> int:
    """Kill a command many times and print what went wrong; 1 where anything did."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--signal", choices=("KILL", "INT", "TERM"), default="KILL")
    chosen = options(parser, 100)
    kind, sent = KINDS[chosen.command], signal.Signals[f"SIG{chosen.signal}"]
    took: list[float] = []
    tried = faults = 0
    with tempfile.TemporaryDirectory(prefix="kill-") as top:
        base = Path(top, "base", "project")
        base.mkdir(parents=True)
        kind.sound(base)
        whole = Path(top, "whole", "project")
        shutil.copytree(base, whole)
        seconds = run(whole, *kind.words)
        wanted = state(whole)
        for number, random in tries(chosen):
            tried += 1
            folder = Path(top, f"try{number}", "project")
            shutil.copytree(base, folder)
            try:
                stops, wrong = disturbed(kind, folder, seconds, sent, random)
                took += stops
                wrong += complete(kind, folder)
                wrong += differences(state(folder), wanted) + left_behind(folder)
            except (RuntimeError, sqlite3.Error) as fault:
                wrong = [str(fault)]
            if wrong:
                faults += 1
                print(f"{chosen.command} {number} (--seed {chosen.seed}):", *wrong, sep="\n  ")
            shutil.rmtree(folder.parent)
    stopped = f", the slowest {max(took):.2f} s" if took and sent != signal.SIGKILL else ""
    print(
        f"{chosen.command}: {tried} tries, {len(took)} {sent.name}{stopped}, {faults} with faults "
        f"(undisturbed {seconds:.1f} s)",
        flush=True,
    )
    return 1 if faults else 0


def load() -> None:
    """Load what the commands load, once, before the processes part: their time is their work."""
    import faiss  # noqa: F401
    import matplotlib.pyplot  # noqa: F401
    import torch._dynamo  # noqa: F401, which optimizers load

    for module in pkgutil.walk_packages(colmap_netvlad.__path__, "colmap_netvlad."):
        if not module.name.endswith(("__main__", "ray_tasks")):  # which needs the extra [cluster]
            importlib.import_module(module.name)


if __name__ == "__main__":
    load()
    sys.exit(main())
