"""Run two commands on one project at once, every pair of them.

    python tests/soak/two.py

Wanted is success or one sentence of both, whole databases, and, once both have been run again one
after the other, what they make one after the other.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from itertools import combinations_with_replacement
from pathlib import Path

import kill

COMMANDS = {
    "features": ("features", "--images", "{}/images", *kill.DB, *kill.FEW),
    "pairs": ("pairs", *kill.DB, "--method", "vlad", "--k", "3", "--output", "{}/vlad.txt"),
    "match": ("match", *kill.DB),
    "match-rounds": kill.KINDS["match-rounds"].words,
    "viewgraph": ("viewgraph", *kill.DB),
    "reconstruct": ("reconstruct", *kill.DB, *kill.ONE),
    "compare": kill.KINDS["compare"].words,
}


def started_from(folder: Path) -> None:
    """A project with a list of pairs and a photo that has no features yet."""
    kill.listed(folder)
    first = min((folder / "images").iterdir())
    shutil.copy(first, folder / "images" / "zz.jpg")


def together(folder: Path, one: str, other: str) -> list[str]:
    """Run both at once and return what went wrong."""
    logs, processes = {}, {}
    for side, name in (("a", one), ("b", other)):
        # Each has its own log: `start` puts it beside the project.
        view = folder.parent / side / "project"
        view.parent.mkdir()
        view.symlink_to(folder)
        processes[side] = kill.start(view, *COMMANDS[name])
        logs[side] = view.parent / "log.txt"
    wrong = []
    for side, process in processes.items():
        _, status = os.waitpid(process, 0)
        code, log = os.waitstatus_to_exitcode(status), logs[side].read_text(errors="replace")
        if code and ("Traceback" in log or "Error: " not in log):
            wrong.append(f"{side}: exit code {code}: {log[-1500:]}")
    return wrong


def compared(folder: Path) -> dict[str, object]:
    """The state without what several runs number on (sparse-2, ...) and caches of either order."""
    return {
        key: value
        for key, value in kill.state(folder).items()
        if not key.startswith("sparse") and not key.endswith((".netvlad.db", "seconds.db"))
    }


def main() -> int:
    """Try every pair and print what went wrong; 1 where anything did."""
    faults = tries = 0
    with tempfile.TemporaryDirectory(prefix="two-") as top:
        base = Path(top, "base", "project")
        base.mkdir(parents=True)
        started_from(base)
        for one, other in combinations_with_replacement(COMMANDS, 2):
            tries += 1
            wrong: list[str] = []
            states = []
            try:
                for at_once in (False, True):
                    folder = Path(top, f"{one}-{other}-{at_once}", "project")
                    shutil.copytree(base, folder)
                    if at_once:
                        wrong += together(folder, one, other)
                    kill.check_whole(folder)
                    for name in (one, other):
                        kill.run(folder, *COMMANDS[name])
                    states.append(compared(folder))
                    wrong += [f"left {left}" for left in kill.left_behind(folder)]
                wrong += kill.differences(states[1], states[0])
            except RuntimeError as fault:
                wrong.append(str(fault))
            if wrong:
                faults += 1
                print(f"{one} and {other}:", *wrong, sep="\n  ", flush=True)
    print(f"two at once: {tries} tries, {faults} with faults")
    return 1 if faults else 0


if __name__ == "__main__":
    kill.load()
    sys.exit(main())
