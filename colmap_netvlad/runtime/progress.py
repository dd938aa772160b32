"""Progress of long work: told to whoever wants to show it.

The library is silent. The command line draws bars (`colmap_netvlad.terminal`); a program that
uses the library can hand in a reporter of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Step(Protocol):
    """One unit of work under way."""

    def advance(self, count: int = 1) -> None:
        """Say that `count` more items are done."""


class Reporter(Protocol):
    """Is told of every step: entered as it begins, left as it ends."""

    def __call__(self, title: str, total: int) -> AbstractContextManager[Step]:
        """Begin a step of `total` items; 0 where nobody knows how many. Steps may nest."""


class _Silent:
    def advance(self, count: int = 1) -> None:
        pass


@contextmanager
def silent(title: str, total: int) -> Iterator[Step]:
    """Report nothing: the default."""
    yield _Silent()


_reporter: Reporter = silent


def step(title: str, total: int) -> AbstractContextManager[Step]:
    """Tell the reporter that `total` items are under way while the block runs."""
    return _reporter(title, total)


@contextmanager
def report_to(reporter: Reporter) -> Iterator[None]:
    """Report progress to `reporter` while the block runs."""
    global _reporter
    before, _reporter = _reporter, reporter
    try:
        yield
    finally:
        _reporter = before
