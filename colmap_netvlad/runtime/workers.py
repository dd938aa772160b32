"""Run jobs in processes of their own: one that crashes loses its own work only; or many small
tasks in a few processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor
from concurrent.futures import wait as wait_for_any
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, TypeVar

from colmap_netvlad.runtime.errors import InputError

POLL_SECONDS = 0.5
"""How often progress is looked at."""

KILL_SECONDS = 5.0
"""How long a worker may take to end when told to."""

AHEAD = 2
"""Tasks at hand for each process that is asked for results: one at work, one to go on with."""

KILLED = 9
"""SIGKILL, which some systems have no name for."""


Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Job:
    """A module-level function that is called in a worker as `function(advance, *arguments)`.

    `advance(count)` tells the parent that `count` more units are done.
    """

    function: Callable[..., None]
    arguments: tuple[Any, ...]


@dataclass
class Outcome:
    """How a job ended.

    Attributes:
        fault: why it failed, or None.
        peak_bytes: the most memory its process held; 0 where it crashed.
        seconds: how long its initialiser and function ran, s; 0 where its process crashed.
    """

    fault: str | None = None
    peak_bytes: int = 0
    seconds: float = 0.0


def _nothing() -> None:
    pass


def run(
    jobs: Sequence[Job],
    workers: int,
    advance: Callable[[int], None],
    finished: Callable[[int, Outcome], None] = lambda number, outcome: None,
    initialiser: Callable[[], None] = _nothing,
) -> list[Outcome]:
    """Run jobs in at most `workers` processes at a time and return how each ended.

    Args:
        advance: is told the units done, of all jobs together.
        finished: is called in this process with a job's number as it ends.
        initialiser: is called in each worker before its job; a module-level function, or a
            `functools.partial` of one.

    An exception in this process (Ctrl-C) ends all workers before it goes on.
    """
    context = multiprocessing.get_context("spawn")
    counters = [context.Value("q", 0) for _ in jobs]
    outcomes = [Outcome() for _ in jobs]
    running: dict[int, tuple[SpawnProcess, Connection]] = {}
    waiting = list(range(len(jobs)))[::-1]
    told = 0
    try:
        while waiting or running:
            while waiting and len(running) < max(1, workers):
                number = waiting.pop()
                receiver, sender = context.Pipe(duplex=False)
                process = context.Process(
                    target=_work,
                    args=(jobs[number], counters[number], sender, initialiser),
                )
                process.start()
                sender.close()
                running[number] = process, receiver
            wait([process.sentinel for process, _ in running.values()], POLL_SECONDS)
            done = sum(counter.value for counter in counters)
            advance(done - told)
            told = done
            for number, (process, receiver) in list(running.items()):
                if process.exitcode is None:
                    continue
                outcomes[number] = _outcome(process, receiver)
                del running[number]
                finished(number, outcomes[number])
    finally:
        for process, _ in running.values():
            process.terminate()
        for process, _ in running.values():
            process.join(KILL_SECONDS)
            if process.exitcode is None:
                process.kill()
                process.join()
    return outcomes


def _outcome(process: SpawnProcess, receiver: Connection) -> Outcome:
    with contextlib.suppress(EOFError), receiver:
        if receiver.poll():
            return Outcome(*receiver.recv())
    code = process.exitcode or 0
    if code == -KILLED:
        return Outcome("its process was killed, by the system for want of memory perhaps")
    return Outcome(f"its process crashed (exit code {code})")


def _work(job: Job, counter: Any, sender: Connection, initialiser: Callable[[], None]) -> None:
    _begin()

    def advance(count: int = 1) -> None:
        with counter.get_lock():
            counter.value += count

    fault, start = None, time.monotonic()
    try:
        initialiser()
        job.function(advance, *job.arguments)
    except InputError as known:
        fault = known.message
    except Exception as unknown:
        fault = f"{type(unknown).__name__}: {unknown}"
    sender.send((fault, _peak_bytes(), time.monotonic() - start))


def results(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    workers: int,
    initialiser: Callable[[], None] = _nothing,
) -> Generator[Result, None, None]:
    """Yield `function(task)` for every task as they are done, from `workers` processes.

    For many small tasks, of which no more wait than are soon worked at. Functions and results are
    sent between processes: module-level functions, or a `functools.partial` of one.

    Raises:
        InputError: a process crashed or was killed. What a task raises is raised here. Either
            ends the work; results that were ready come first.
    """
    context = multiprocessing.get_context("spawn")
    waiting = iter(tasks)
    pool = ProcessPoolExecutor(workers, context, _begin, (initialiser,))
    try:
        running = {pool.submit(function, task) for task in islice(waiting, AHEAD * workers)}
        while running:
            done, running = wait_for_any(running, return_when=FIRST_COMPLETED)
            for ended in sorted(done, key=lambda ended: ended.exception() is not None):
                yield ended.result()
            running |= {pool.submit(function, task) for task in islice(waiting, len(done))}
    except BrokenProcessPool as fault:
        raise InputError(
            "A process of this run crashed or was killed, by the system for want of memory "
            "perhaps; run the command again: it goes on where it stopped."
        ) from fault
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(initialiser: Callable[[], None] = _nothing) -> None:
    # Ctrl-C reaches the whole group; the parent alone decides and ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    initialiser()


def _end_with_parent() -> None:
    """End this process when its parent is gone (killed, say): nobody waits for the result."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _peak_bytes() -> int:
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
