"""Processes of this machine: one for each job, or a few for many shares."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for_any
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.synchronize import Event
from typing import Any

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.jobs import (
    AHEAD,
    Capacity,
    Item,
    Job,
    Outcome,
    Result,
    Shares,
    Work,
)
from colmap_netvlad.runtime.machine import usable_memory, usable_processors

POLL_SECONDS = 0.5
"""How often progress is looked at."""

KILL_SECONDS = 5.0
"""How long a worker may take to end when told to."""

KILLED = 9
"""SIGKILL, which some systems have no name for."""


class Processes:
    """This machine, as `jobs.Engine`."""

    def capacity(self) -> Capacity:
        """Return what this process may use."""
        processors = usable_processors()
        return Capacity(processors, usable_memory(), processors)

    def run(
        self,
        jobs: Sequence[Job],
        workers: int,
        advance: Callable[[int], None],
        finished: Callable[[int, Outcome], None],
        initialiser: Callable[[], None],
    ) -> list[Outcome]:
        """Run each job in a process of its own."""
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
                    with _heard_later():
                        process.start()
                        running[number] = process, receiver
                    sender.close()
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

    def results(
        self, work: Work[Item, Result], shares: Shares[Item], workers: int
    ) -> Generator[Result, None, None]:
        """Work at shares in a pool of processes."""
        context = multiprocessing.get_context("spawn")
        stop = context.Event()
        pool = ProcessPoolExecutor(workers, context, _begin_shares, (stop, work.initialiser))
        running: dict[Future[tuple[float, Result]], int] = {}
        try:
            while shares or running:
                with _heard_later():  # the first share starts all processes
                    while shares and len(running) < AHEAD * workers:
                        share = shares.next(workers)
                        running[pool.submit(_timed, work.here, share)] = len(share)
                done, _ = wait_for_any(running, return_when=FIRST_COMPLETED)
                for ended in sorted(done, key=lambda ended: ended.exception() is not None):
                    seconds, result = ended.result()
                    shares.learn(running.pop(ended), seconds)
                    yield result
        except BrokenProcessPool as fault:
            raise InputError(
                "A process of this run crashed or was killed, by the system for want of memory "
                "perhaps; run the command again: it goes on where it stopped."
            ) from fault
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)

    def stream(
        self, work: Work[Item, Iterable[Result]], items: Sequence[Item], first: int
    ) -> Generator[Result, None, None]:
        """Work at all items in this process."""
        yield from work.here(items)


@contextlib.contextmanager
def _heard_later() -> Iterator[None]:
    """Let processes that are started in the block not be interrupted while they load: Ctrl-C
    reaches the whole group, and half of what this one tells them is none. It hears of Ctrl-C and
    SIGTERM at the end of the block."""
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield  # Windows has no signal masks; only the main thread is interrupted
        return
    heard: list[int] = []
    # They keep the mask, but not the handler: `terminate` ends them at any time.
    kept = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, kept)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number in heard:
            signal.raise_signal(number)


def _timed(function: Callable[..., Result], share: Sequence[Item]) -> tuple[float, Result]:
    start = time.monotonic()
    result = function(share)
    return time.monotonic() - start, result


def _outcome(process: SpawnProcess, receiver: Connection) -> Outcome:
    with contextlib.suppress(EOFError), receiver:
        if receiver.poll():
            outcome: Outcome = receiver.recv()
            return outcome
    code = process.exitcode or 0
    if code == -KILLED:
        return Outcome("its process was killed, by the system for want of memory perhaps")
    return Outcome(f"its process crashed (exit code {code})")


def _work(job: Job, counter: Any, sender: Connection, initialiser: Callable[[], None]) -> None:
    _begin(lambda: None)

    def advance(count: int = 1) -> None:
        with counter.get_lock():
            counter.value += count

    def do() -> None:
        initialiser()
        job.function(advance, *job.files, *job.arguments)

    sender.send(outcome_of(do))


def outcome_of(do: Callable[[], None]) -> Outcome:
    """Do a job in this process, and return how it ended."""
    fault, start = None, time.monotonic()
    try:
        do()
    except InputError as known:
        fault = known.message
    except Exception as unknown:
        fault = f"{type(unknown).__name__}: {unknown}"
    return Outcome(fault, peak_bytes(), time.monotonic() - start)


_stop: Event | None = None
"""Of a process that works at shares."""


def unwanted() -> bool:
    """Return whether this process is at a share whose result nobody waits for any longer."""
    return _stop is not None and _stop.is_set()


def _begin_shares(stop: Event, initialiser: Callable[[], None]) -> None:
    global _stop
    _stop = stop
    _begin(initialiser)


def _begin(initialiser: Callable[[], None]) -> None:
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


def peak_bytes() -> int:
    """Return the most memory that this process held; 0 where nobody knows."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
