"""What is to be done, and how it ended: jobs and shares of items, for whoever does them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from colmap_netvlad.runtime.files import scratch_folder

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Shares at hand for each processor that is asked for results: one at work, one to go on with."""

GROWTH = 4
"""A share has at most this many times the items of the one before: its pace may be another's."""


@dataclass(frozen=True)
class Source(Generic[Item]):
    """A database that work reads, or writes too: who works on this machine opens it. Who works on
    another, which does not see it, opens a part of it, made for one share.

    Attributes:
        path: the database.
        part: `part(path, share, target)` writes to `target` what the share needs of `path`.
        take: `take(target, share)` returns, on the other machine, what was written there.
        keep: `keep(path, taken)` writes that into `path`, on this machine.
    """

    path: Path
    part: Callable[[Path, Sequence[Item], Path], None]
    take: Callable[[Path, Sequence[Item]], Any] | None = None
    keep: Callable[[Path, Any], None] | None = None


@dataclass(frozen=True)
class Folder(Generic[Item]):
    """A folder of files that work reads. Who works on a machine that does not see them gets those
    of its share, in a folder for that share alone.

    Attributes:
        path: where it lies.
        files: `files(path, item)` names those that an item needs, relative to `path`.
    """

    path: Path
    files: Callable[[Path, Item], Iterable[str]]


@dataclass(frozen=True)
class Load:
    """What a share or a job takes of a machine, for those who choose between machines.

    Attributes:
        processors: how many keep it busy.
        memory: most bytes that it holds; 0 where that is little.
        gpu: whether it runs on a GPU where machines have some.
    """

    processors: int = 1
    memory: float = 0.0
    gpu: bool = False


LIGHT = Load()


def nothing() -> None:
    """The initialiser of work that needs none."""


@dataclass(frozen=True)
class Work(Generic[Item, Result]):
    """What is done with each share of many items; see `runtime.workers.results`."""

    function: Callable[..., Result]
    initialiser: Callable[[], None] = nothing
    source: Source[Item] | None = None
    load: Load = LIGHT
    folders: tuple[Folder[Item] | None, ...] = ()

    @property
    def places(self) -> tuple[Path | None, ...]:
        """Where the folders lie."""
        return tuple(None if folder is None else folder.path for folder in self.folders)

    @property
    def here(self) -> Callable[..., Result]:
        """The function of a share, for who opens the source and sees the folders itself."""
        sources = () if self.source is None else (self.source.path,)
        return partial(self.function, *sources, *self.places)


@dataclass(frozen=True)
class Capacity:
    """What there is to work with.

    Attributes:
        processors: of all machines together.
        memory: bytes, of all machines together.
        largest: processors of the machine that has most.
    """

    processors: int
    memory: float
    largest: int


@dataclass(frozen=True)
class Job:
    """A module-level function that is called in a worker as `function(advance, *arguments)`.

    `advance(count)` tells the parent that `count` more units are done. A job may go to another
    machine if it names its files: then the function gets the source's path and `output` before
    the arguments.

    Attributes:
        source: what it reads; `part` gets the job's arguments as its share.
        output: the folder that it writes files into.
    """

    function: Callable[..., None]
    arguments: tuple[Any, ...]
    source: Source[Any] | None = None
    output: Path | None = None
    load: Load = LIGHT

    @property
    def files(self) -> tuple[Path, ...]:
        """Source and output, where they are named."""
        return () if self.source is None or self.output is None else (self.source.path, self.output)


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


class Shares(Generic[Item]):
    """Items, cut into shares that take about as long as they should.

    Args:
        first: items of the first share, and the fewest later on.
        seconds: how long a share should take, s; None: all have `first` items.
    """

    def __init__(self, items: Sequence[Item], first: int, seconds: float | None) -> None:
        self.items, self._at = items, 0
        self._first, self._seconds = first, seconds
        self._size = float(first)

    def __bool__(self) -> bool:
        return self._at < len(self.items)

    def next(self, workers: int) -> Sequence[Item]:
        """Return the next share: smaller ones towards the end, so that all workers end together."""
        size = int(self._size)
        if self._seconds is not None:
            even = (len(self.items) - self._at) // (AHEAD * workers)
            size = max(1, min(size, max(self._first, even)))
        share = self.items[self._at : self._at + size]
        self._at += len(share)
        return share

    def learn(self, items: int, seconds: float) -> None:
        """Size the next shares by how long one of so many items took."""
        if self._seconds is not None:
            pace = items / max(seconds, 1e-3)
            self._size = max(1.0, min(pace * self._seconds, GROWTH * max(items, self._size)))

    def lengthen(self, seconds: float) -> None:
        """Let shares take at least so long, s."""
        self._seconds = max(self._seconds or 0.0, seconds)


class Engine(Protocol):
    """Who does the work; see the functions of the same names in `runtime.workers`."""

    def capacity(self) -> Capacity: ...

    def run(
        self,
        jobs: Sequence[Job],
        workers: int,
        advance: Callable[[int], None],
        finished: Callable[[int, Outcome], None],
        initialiser: Callable[[], None],
    ) -> list[Outcome]: ...

    def results(
        self, work: Work[Item, Result], shares: Shares[Item], workers: int
    ) -> Generator[Result, None, None]: ...

    def stream(
        self, work: Work[Item, Iterable[Result]], items: Sequence[Item], first: int
    ) -> Generator[Result, None, None]: ...


class Enclosed:
    """A file whose content goes along to other machines."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._content: bytes | None = None

    def __getstate__(self) -> tuple[Path, bytes]:
        return self.path, self.path.read_bytes()

    def __setstate__(self, state: tuple[Path, bytes]) -> None:
        self.path, self._content = state

    @contextlib.contextmanager
    def opened(self) -> Iterator[Path]:
        """Yield where the file can be read during the block."""
        if self._content is None:
            yield self.path
            return
        with scratch_folder() as folder:
            copy = folder / self.path.name
            copy.write_bytes(self._content)
            yield copy
