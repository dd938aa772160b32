"""Progress of long work: a bar on a terminal, a line now and then in a log file."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

console = Console(stderr=True)
"""Progress and warnings go to standard error, so that standard output stays a clean report."""


verbose = False
"""Whether pycolmap's own log is let through (the commands' -v)."""


class Step(Protocol):
    """One unit of work under way."""

    def advance(self, count: int = 1) -> None:
        """Say that `count` more items are done."""


LOG_SECONDS = 30.0
"""How often a step writes a line where standard error is not a terminal (cluster logs)."""


class _Log:
    def __init__(self, title: str, total: int) -> None:
        self._title, self._total, self._done = title, total, 0
        self._start = self._said = time.monotonic()

    def advance(self, count: int = 1) -> None:
        self._done += count
        now = time.monotonic()
        if now - self._said < LOG_SECONDS:
            return
        self._said = now
        minutes = (now - self._start) / 60
        line = f"{self._title}, {minutes:.1f} min so far"
        if self._total > 0 and self._done:
            left = minutes * (self._total - self._done) / self._done
            line = f"{self._title} {self._done}/{self._total}, about {left:.1f} min to go"
        print(line, file=sys.stderr, flush=True)


class _Bar:
    def __init__(self, progress: Progress, task: object) -> None:
        self._progress = progress
        self._task = task

    def advance(self, count: int = 1) -> None:
        self._progress.advance(self._task, count)  # type: ignore[arg-type]


_shown: Progress | None = None
"""The bars on the terminal, while a step is under way: a step within it adds its bar there."""


@contextmanager
def step(title: str, total: int) -> Iterator[Step]:
    """Show a bar with elapsed and remaining time for `total` items while the block runs.

    A step within a step has its bar below. Where standard error is not a terminal it writes a
    line every half minute instead.
    """
    global _shown
    if total <= 0 or not sys.stderr.isatty():
        yield _Log(title, total)
        return
    if _shown is not None:
        task = _shown.add_task(title, total=total)
        try:
            yield _Bar(_shown, task)
        finally:
            _shown.remove_task(task)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("to go"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        _shown = progress
        try:
            yield _Bar(progress, progress.add_task(title, total=total))
        finally:
            _shown = None
