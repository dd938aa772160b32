"""What the command line shows: progress, notes, faults and tables.

Progress and notes go to standard error, so that standard output stays a clean report.
"""

from __future__ import annotations

import _thread
import errno
import logging
import re
import signal
import sqlite3
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from colmap_netvlad.runtime import progress
from colmap_netvlad.runtime.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from colmap_netvlad.commands.reconstruct import ReconstructReport
    from colmap_netvlad.comparison.result import Comparison
    from colmap_netvlad.mapping.summary import ModelSummary

LOG_SECONDS = 30.0
"""How often a step writes a line where standard error is not a terminal (cluster logs)."""

BEST = "*"
"""Marks the best of a row."""

WIDEST = 1000
"""Characters of the widest table."""

VERBOSE = f"{__name__}.verbose"
"""Where a command's context keeps whether -v was given."""


class Command(click.Command):
    """A command that shows the library's notes and progress, and its faults in a sentence."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; an InputError becomes click's, which exits with code 1."""
        with shown(ctx):
            try:
                return super().invoke(ctx)
            except InputError as fault:
                raise click.ClickException(as_options(fault.message, ctx)) from fault
            except (OSError, sqlite3.OperationalError) as fault:
                if not says_full(fault):
                    raise
                raise click.ClickException(
                    f"A disk is full ({fault}); make room and run the command again: it goes on "
                    "where it stopped."
                ) from fault


class Group(click.Group):
    """Commands of this kind."""

    command_class = Command


def hear_interrupts() -> None:
    """Let SIGTERM stop this process as Ctrl-C does, and neither be lost.

    Python loses an exception that is raised while an object is taken apart (matplotlib's are, by
    the thousand): it is then asked for again.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.unraisablehook = _interrupt_again


def _interrupt_again(lost: sys.UnraisableHookArgs) -> None:
    if lost.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(lost)
        return
    later = threading.Timer(0.01, _interrupt)
    later.daemon = True
    later.start()


def _interrupt() -> None:
    # SIGTERM: a job in the background may be deaf to Ctrl-C.
    main = threading.main_thread().ident
    if sys.platform == "win32" or main is None:
        _thread.interrupt_main(signal.SIGTERM)
    else:
        signal.pthread_kill(main, signal.SIGTERM)  # wakes it where it waits


def says_full(fault: OSError | sqlite3.OperationalError) -> bool:
    """Whether a fault is that of a full disk: any write may meet one, of sqlite's too."""
    if isinstance(fault, OSError):
        return fault.errno in (errno.ENOSPC, errno.EDQUOT)
    return fault.sqlite_errorcode == sqlite3.SQLITE_FULL


def as_options(text: str, context: click.Context) -> str:
    """Replace `name`, an argument of the library, by the option that the user types for it."""
    options = {
        parameter.name: parameter.opts[0]
        for parameter in context.command.get_params(context)
        if isinstance(parameter, click.Option)
    }
    return re.sub(r"`(\w+)`", lambda found: options.get(found[1], found[0]), text)


def say(*lines: str, err: bool = False) -> None:
    """Print lines, with options in place of arguments."""
    context = click.get_current_context()
    for line in lines:
        click.echo(as_options(line, context), err=err)


@contextmanager
def shown(context: click.Context) -> Iterator[None]:
    """Show notes and progress while the block runs, and COLMAP's own log where -v was given."""
    logger = logging.getLogger("colmap_netvlad")
    level = logger.level
    handler = _Notes(context)
    logger.setLevel(logging.DEBUG if context.meta.get(VERBOSE) else logging.INFO)
    logger.addHandler(handler)
    try:
        with progress.report_to(show_step):
            yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


class _Notes(logging.Handler):
    """Prints notes, above the bars where there are any."""

    def __init__(self, context: click.Context) -> None:
        super().__init__(logging.INFO)
        self._context = context

    def emit(self, record: logging.LogRecord) -> None:
        text = as_options(record.getMessage(), self._context)
        if _bars is not None:
            _bars.console.print(text, highlight=False, markup=False, soft_wrap=True)
        else:
            click.echo(text, err=True)


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
    def __init__(self, bars: Progress, task: Any) -> None:
        self._bars, self._task = bars, task

    def advance(self, count: int = 1) -> None:
        self._bars.advance(self._task, count)


_bars: Progress | None = None
"""The bars on the terminal, while a step is under way: a step within it adds its bar there."""


@contextmanager
def show_step(title: str, total: int) -> Iterator[progress.Step]:
    """Show a bar with elapsed and remaining time for `total` items while the block runs.

    A step within a step has its bar below. Where standard error is not a terminal it writes a
    line every half minute instead.
    """
    global _bars
    if total <= 0 or not sys.stderr.isatty():
        yield _Log(title, total)
    elif _bars is not None:
        task = _bars.add_task(title, total=total)
        try:
            yield _Bar(_bars, task)
        finally:
            _bars.remove_task(task)
    else:
        with _new_bars() as _bars:
            try:
                yield _Bar(_bars, _bars.add_task(title, total=total))
            finally:
                _bars = None


def _new_bars() -> Progress:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("to go"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )


def print_models(report: ReconstructReport) -> None:
    """Print the figures of all models on standard output."""
    _print_whole(models_table(report))


def models_table(report: ReconstructReport) -> Table:
    """Return the figures of every component, and in total where there are several."""
    from rich.table import Table

    table = Table(title=f"Sparse model in {report.output}", title_justify="left")
    table.add_column("Component")
    for column in (
        "Registered\nimages",
        "3D points",
        "Mean reprojection\nerror (px)",
        "Mean track\nlength",
        "Observations",
    ):
        table.add_column(column, justify="right", no_wrap=True)
    for index, model in enumerate(report.models):
        table.add_row(str(index), *_cells(model, report.images))
    if len(report.models) > 1:
        table.add_section()
        table.add_row("total", *_cells(report.total, report.images))
    return table


def _cells(model: ModelSummary, images: int) -> tuple[str, ...]:
    return (
        f"{model.registered:,} of {images:,}",
        f"{model.points:,}",
        f"{model.mean_reprojection_error:.3f}",
        f"{model.mean_track_length:.2f}",
        f"{model.observations:,}",
    )


def summary_table(comparison: Comparison) -> Table:
    """Return the summary of a comparison: a row for each measure, a column for each method."""
    from rich.table import Table

    from colmap_netvlad.report.comparison import partners_words, reference_sentence
    from colmap_netvlad.report.measures import NOT_RUNNING, shown

    table = Table(
        title=f"{comparison.project}: {comparison.images:,} images, {partners_words(comparison)}",
        title_justify="left",
        caption=f"{BEST} best of the row ({NOT_RUNNING}). {reference_sentence(comparison)}",
        caption_justify="left",
    )
    table.add_column("")
    for method in comparison.methods:
        table.add_column(method.name, justify="right", overflow="fold")
    group = ""
    for measure in shown(comparison):
        if measure.group != group and group:
            table.add_section()
        group = measure.group
        best = measure.best(comparison.methods)
        texts = {method.name: measure.show(method) for method in comparison.methods}
        cells = [f"[bold]{BEST}{t}[/]" if name in best else t for name, t in texts.items()]
        table.add_row(measure.title, *cells)
    return table


def print_comparison(comparison: Comparison, console: Console | None = None) -> None:
    """Print the summary on standard output."""
    _print_whole(summary_table(comparison), console)


def _print_whole(table: Table, console: Console | None = None) -> None:
    """Print a table whole, also where the terminal is narrow."""
    from rich.console import Console

    console = console or Console()
    needed = Console(width=WIDEST).measure(table).maximum
    if needed > console.width:
        console = Console(file=console.file, width=needed, force_terminal=console.is_terminal)
    console.print(table)
