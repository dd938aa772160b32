"""A command run in a process of its own: wall and processor time, peak memory of all processes."""

from __future__ import annotations

import resource
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

LOOK_SECONDS = 0.2


@dataclass(frozen=True)
class Watched:
    """What a command took.

    Attributes:
        wall: s.
        cpu: processor time of it and of all it started, s.
        peak: memory of all of them together (proportional set size), bytes.
        done: whether it ended by itself; else it was stopped by Ctrl-C at the time limit.
    """

    wall: float
    cpu: float
    peak: int
    done: bool


def watch(command: Sequence[str], limit: float = float("inf")) -> Watched:
    """Run a command to its end or for `limit` seconds; Linux only.

    Raises:
        SystemExit: it failed.
    """
    used, start, peak, done = _children(), time.monotonic(), 0, True
    process = subprocess.Popen(command)
    while process.poll() is None:
        peak = max(peak, _memory(process.pid))
        if done and time.monotonic() - start > limit:
            process.send_signal(signal.SIGINT)
            done = False
        time.sleep(LOOK_SECONDS)
    if process.returncode and done:
        raise SystemExit(f"Failed: {' '.join(command)}")
    return Watched(time.monotonic() - start, _children() - used, peak, done)


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _memory(root: int) -> int:
    """Return the bytes of a process and of all it started."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(stat.parent.name)] = int(fields[1])
    family, size = {root}, 0
    while len(family) != size:
        size = len(family)
        family |= {process for process, parent in parents.items() if parent in family}
    total = 0
    for process in family:
        try:
            lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        total += sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total
