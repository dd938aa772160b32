"""Run two commands on one project at once, every pair of them.

    python tests/soak/two.py
    python tests/soak/two.py --command add

Wanted is success or one sentence of both, whole databases, and, once both have been run again one
after the other, what they make one after the other. Of pairs with `add` only the images and their
features are compared: who comes first to the new photo decides what is matched and compared.
"""

from __future__ import annotations

import argparse
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
    "add": kill.KINDS["add"].words,
}


def started_from(folder: Path) -> None:
    """A project with a list of pairs and a photo that has no features yet."""
    kill.listed(folder)
    first = min((folder / "images").iterdir())
    shutil.copy(first, folder / "images" / "zz.jpg")


def with_model(folder: Path) -> None:
    """The same with a model, which the photo is to join."""
    started_from(folder)
    kill.run(folder, *COMMANDS["match"])
    kill.run(folder, *COMMANDS["reconstruct"])


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
        if not said(code, log):
            wrong.append(f"{side}: exit code {code}: {log[-1500:]}")
    return wrong


def said(code: int, log: str) -> bool:
    """Whether a command ended well, or with one sentence."""
    return code == 0 or ("Traceback" not in log and "Error: " in log)


def again(folder: Path, name: str, adding: bool) -> list[str]:
    """Run a command after both, and return what was wrong."""
    code, log = kill.ended(folder, COMMANDS[name])
    # Where a photo was added, there is nothing left to add, and comparisons are of other photos.
    if code == 0 or (adding and said(code, log)):
        return []
    return [f"{name} again: exit code {code}: {log[-1500:]}"]


def compared(folder: Path, adding: bool) -> dict[str, object]:
    """The state without what several runs number on (sparse-2, ...) and caches of either order."""
    state = kill.state(folder)
    if adding:
        tables = state.pop("project.db")
        return {name: tables[name] for name in ("images", "keypoints", "descriptors")}
    return {
        key: value
        for key, value in state.items()
        if not key.startswith("sparse") and not key.endswith((".netvlad.db", "seconds.db"))
    }


def main() -> int:
    """Try every pair and print what went wrong; 1 where anything did."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--command", choices=COMMANDS, help="only the pairs with this one")
    chosen = parser.parse_args().command
    faults = tries = 0
    with tempfile.TemporaryDirectory(prefix="two-") as top:
        bases = {}
        for adding, sound in ((False, started_from), (True, with_model)):
            bases[adding] = Path(top, f"base-{adding}", "project")
            bases[adding].mkdir(parents=True)
            sound(bases[adding])
        for one, other in combinations_with_replacement(COMMANDS, 2):
            if chosen not in (None, one, other):
                continue
            tries += 1
            adding = "add" in (one, other)
            wrong: list[str] = []
            states = []
            try:
                for at_once in (False, True):
                    folder = Path(top, f"{one}-{other}-{at_once}", "project")
                    shutil.copytree(bases[adding], folder)
                    if at_once:
                        wrong += together(folder, one, other)
                    kill.check_whole(folder)
                    for name in (one, other):
                        wrong += again(folder, name, adding)
                    states.append(compared(folder, adding))
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
