"""Fill the disk under commands at random points, make room, run them again, and compare.

    python tests/soak/full.py pairs --times 30 --seed 0

Each try puts a small project, or the temporary files of its commands, on a disk of its own (tmpfs:
Linux, as root) with a random amount of room, up to twice what the command writes. Wanted is one
sentence or success, nothing half written, and, with room again, the end of an undisturbed run. What
COLMAP itself writes is guarded by 64 MiB that stay free; half of the tries have a little more.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import kill

ROOM = 2**30
GUARD = 64 * 2**20
LEAST = 256 * 2**10
"""Room for the journals of small databases, bytes."""


def resize(disk: Path, size: int) -> None:
    """Give a mounted tmpfs another size, bytes."""
    options = f"remount,size={size}"
    subprocess.run(["mount", "-o", options, str(disk)], check=True)


def size(folder: Path) -> int:
    """Return what the files of a folder hold, bytes."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def main() -> int:
    """Fill the disk many times and print what went wrong; 1 where anything did."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    chosen = kill.options(parser, 30)
    kind = kill.KINDS[chosen.command]
    tried = refused = faults = 0
    with tempfile.TemporaryDirectory(prefix="full-") as top:
        base, disk = Path(top, "base", "project"), Path(top, "disk")
        base.mkdir(parents=True)
        disk.mkdir()
        kind.sound(base)
        whole = Path(top, "whole", "project")
        shutil.copytree(base, whole)
        kill.run(whole, *kind.words)
        wanted = kill.state(whole)
        needs = LEAST + 2 * max(0, size(whole) - size(base))
        subprocess.run(["mount", "-t", "tmpfs", f"-osize={ROOM}", "tmpfs", str(disk)], check=True)
        try:
            for number, random in kill.tries(chosen):
                tried += 1
                folder = Path(top, f"try{number}", "project")
                folder.parent.mkdir()
                small = disk / f"try{number}"
                small.mkdir()
                if random.integers(3):  # the project's disk
                    shutil.copytree(base, small / "project")
                    folder.symlink_to(small / "project")
                else:  # the temporary one
                    shutil.copytree(base, folder)
                    (folder.parent / "scratch").symlink_to(small)
                used = shutil.disk_usage(disk).used
                room = int(random.uniform(0, needs)) + GUARD * int(random.integers(2))
                resize(disk, (used + room) // 4096 * 4096 + 4096)
                wrong = []
                try:
                    code, log = kill.ended(folder, kind.words)
                    if code and ("Traceback" in log or "Error: " not in log):
                        wrong.append(f"{room} bytes of room, exit code {code}: {log[-1500:]}")
                    refused += code != 0
                    wrong += [f"left {left}" for left in kill.left_behind(folder.resolve())]
                    resize(disk, ROOM)
                    kill.check_whole(folder.resolve())
                    wrong += kill.complete(kind, folder)
                    wrong += kill.differences(kill.state(folder.resolve()), wanted)
                except (RuntimeError, kill.sqlite3.Error) as fault:
                    wrong.append(str(fault))
                resize(disk, ROOM)
                shutil.rmtree(small)
                if wrong:
                    faults += 1
                    print(f"{chosen.command} {number} (--seed {chosen.seed}):", *wrong, sep="\n  ")
        finally:
            subprocess.run(["umount", "-l", str(disk)], check=True)
    print(f"{chosen.command}: {tried} tries, {refused} refused, {faults} with faults")
    return 1 if faults else 0


if __name__ == "__main__":
    kill.load()
    sys.exit(main())
