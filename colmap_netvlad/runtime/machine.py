"""What this machine lets us use: its processors and memory, or our container's share of them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
MEMBERSHIP = Path("/proc/self/cgroup")

_allotted: int | None = None

UNKNOWN_BYTES = 8 * 2.0**30
"""Memory that a machine is taken to have where it does not say."""


def usable_processors() -> int:
    """Return how many processors this process may use, at least 1.

    Heeded are its affinity, and the quotas of the Linux control groups it is in (containers,
    batch systems), rounded up as loky's `cpu_count` does.
    """
    if _allotted is not None:
        return _allotted
    if hasattr(os, "sched_getaffinity"):
        processors = len(os.sched_getaffinity(0))
    else:
        processors = os.cpu_count() or 1
    return max(1, min([processors, *(math.ceil(quota) for quota in _processor_quotas())]))


def allot(processors: int) -> None:
    """Let this process use so many processors: it shares the machine with others of its kind."""
    global _allotted
    _allotted = processors


def usable_memory() -> float:
    """Return the memory this process may use, bytes: the machine's, or its control groups' limit.

    What other processes hold is not taken off.
    """
    return min([_machine_bytes(), *_memory_limits()])


def _machine_bytes() -> float:
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return UNKNOWN_BYTES


def _processor_quotas() -> Iterator[float]:
    for group in _groups(""):
        quota, _, period = _read(group / "cpu.max").partition(" ")
        yield from _ratio(quota, period)
    for group in _groups("cpu"):
        yield from _ratio(_read(group / "cpu.cfs_quota_us"), _read(group / "cpu.cfs_period_us"))


def _memory_limits() -> Iterator[float]:
    for group in _groups(""):
        yield from _ratio(_read(group / "memory.max"), "1")
    for group in _groups("memory"):
        yield from _ratio(_read(group / "memory.limit_in_bytes"), "1")


def _groups(controller: str) -> Iterator[Path]:
    """Yield our control group and those it is in; an empty controller stands for version 2.

    A container may see itself at the root of the tree whatever its path says.
    """
    for line in _read(MEMBERSHIP).splitlines():
        _, controllers, path = line.split(":", 2)
        if controller in controllers.split(","):
            root = CGROUPS / controller
            group = root / path.lstrip("/")
            yield from (group, *(above for above in group.parents if above.is_relative_to(root)))


def _ratio(limit: str, unit: str) -> Iterator[float]:
    """Yield the limit in units, unless there is none ("max", -1, no such file)."""
    if limit.isdecimal() and unit.isdecimal() and int(limit) and int(unit):
        yield int(limit) / int(unit)


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
