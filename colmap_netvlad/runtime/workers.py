"""Who does the work that need not be done in this process: processes of this machine, unless
`using` names others.

Three ways: `run` for jobs of which one that crashes loses its own work only; `results` for many
items, in shares; `stream` for items whose work keeps all processors of a machine busy by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager

from colmap_netvlad.runtime import processes
from colmap_netvlad.runtime.jobs import (
    LIGHT,
    Capacity,
    Engine,
    Folder,
    Item,
    Job,
    Load,
    Outcome,
    Result,
    Shares,
    Source,
    Work,
    nothing,
)

HERE = processes.Processes()

_engine: Engine = HERE


@contextmanager
def using(engine: Engine) -> Iterator[None]:
    """Let `engine` do the work while the block runs."""
    global _engine
    before, _engine = _engine, engine
    try:
        yield
    finally:
        _engine = before


def capacity() -> Capacity:
    """Return what there is to work with."""
    return _engine.capacity()


def run(
    jobs: Sequence[Job],
    workers: int,
    advance: Callable[[int], None],
    finished: Callable[[int, Outcome], None] = lambda number, outcome: None,
    initialiser: Callable[[], None] = nothing,
) -> list[Outcome]:
    """Run jobs, at most `workers` at a time, and return how each ended.

    Jobs that do not name their files stay on this machine.

    Args:
        advance: is told the units done, of all jobs together.
        finished: is called in this process with a job's number as it ends.
        initialiser: is called in each worker before its job; a module-level function, or a
            `functools.partial` of one.

    An exception in this process (Ctrl-C) ends all workers before it goes on.
    """
    engine = _engine if all(job.files for job in jobs) else HERE
    return engine.run(jobs, workers, advance, finished, initialiser)


def results(
    function: Callable[..., Result],
    items: Sequence[Item],
    workers: int,
    initialiser: Callable[[], None] = nothing,
    source: Source[Item] | None = None,
    load: Load = LIGHT,
    folders: tuple[Folder[Item] | None, ...] = (),
    *,
    first: int = 1,
    seconds: float | None = None,
) -> Generator[Result, None, None]:
    """Yield `function(share)` for shares of the items as they are done, by `workers` processes.

    No more shares wait than are soon worked at. Functions and results are sent between processes:
    module-level functions, or a `functools.partial` of one.

    Args:
        initialiser: is called once in each process.
        source: what the function reads: its path is handed over before the share.
        folders: what else it reads: their paths are handed over between the two, None for None.
        first: items of the first share.
        seconds: how long a share should take; None: all have `first` items.

    Raises:
        InputError: a process crashed or was killed. What a share raises is raised here. Either
            ends the work; results that were ready come first.

    After an exception in this process (Ctrl-C), or when no more results are asked for, shares at
    work here are waited for: long ones look at `unwanted` now and then, and stop.
    """
    shares = Shares(items, first, seconds)
    work = Work(function, initialiser, source, load, folders)
    return _engine.results(work, shares, workers)


def stream(
    function: Callable[..., Iterable[Result]],
    items: Sequence[Item],
    initialiser: Callable[[], None] = nothing,
    source: Source[Item] | None = None,
    load: Load = LIGHT,
    folders: tuple[Folder[Item] | None, ...] = (),
    *,
    first: int = 1,
) -> Generator[Result, None, None]:
    """Yield what `function(share)` yields, for work that uses all processors by itself.

    On this machine all items are one share, in this process; other machines take shares of them.
    Arguments and what is raised are as in `results`.
    """
    return _engine.stream(Work(function, initialiser, source, load, folders), items, first)


def unwanted() -> bool:
    """Return whether this process is at a share whose result nobody waits for any longer."""
    return processes.unwanted()
