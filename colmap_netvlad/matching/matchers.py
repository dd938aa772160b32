"""The table of matchers: a new one is one file and one row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from colmap_netvlad.graph.pair import IdPair
from colmap_netvlad.matching.colmap import match_by_colmap
from colmap_netvlad.matching.options import MATCHER_DEFAULT, MatchOptions, Work
from colmap_netvlad.runtime.errors import InputError


class Match(Protocol):
    """A matcher matches pairs, verifies them, and writes both into `database`."""

    def __call__(
        self,
        database: Path,
        pairs: Sequence[IdPair],
        options: MatchOptions,
        advance: Callable[[int], None],
    ) -> Work:
        """Match pairs that have not been matched before.

        Args:
            pairs: in an order in which neighbours share images.
            advance: is told how many more pairs are done.

        Raises:
            InputError: a process that failed, or a database that cannot be written; what was
                matched by then stays.
        """


@dataclass(frozen=True)
class Matcher:
    """A matcher.

    Attributes:
        name: what users call it.
        summary: one line.
        match: does it.
        sift_only: whether it takes no other local features than SIFT.
        gives_up: whether it passes over pairs that show nothing in common at a first glance,
            which `MatchOptions.thorough` forbids.
    """

    name: str
    summary: str
    match: Match
    sift_only: bool = False
    gives_up: bool = False


def _guided(
    database: Path, pairs: Sequence[IdPair], options: MatchOptions, advance: Callable[[int], None]
) -> Work:
    from colmap_netvlad.matching.blocks import match_guided  # torch takes seconds to import

    return match_guided(database, pairs, options, advance)


MATCHERS: dict[str, Matcher] = {
    matcher.name: matcher
    for matcher in (
        Matcher(
            "colmap",
            "COLMAP's own: every feature against all of the other photo.",
            match_by_colmap,
        ),
        Matcher(
            "guided",
            "A glance at the largest features tells whether and how two photos overlap; all others"
            " are looked for only there.",
            _guided,
            sift_only=True,
            gives_up=True,
        ),
    )
}


def find_matcher(options: MatchOptions) -> Matcher:
    """Return the matcher that the options name.

    Raises:
        InputError: there is none of that name, or `thorough` would be ignored by it.
    """
    name = options.matcher or MATCHER_DEFAULT
    if name not in MATCHERS:
        raise InputError(f"There is no matcher {name}; choose {', '.join(MATCHERS)}.")
    matcher = MATCHERS[name]
    if options.thorough and not matcher.gives_up:
        raise InputError(
            f"`thorough` would be ignored: the matcher {name} gives no pair up; leave it out."
        )
    return matcher


def usable_matcher(options: MatchOptions, sift: bool) -> tuple[Matcher, str]:
    """Return the matcher for a database, and a sentence where it is not the one asked for.

    Args:
        sift: whether the database has SIFT descriptors and no others.

    Raises:
        InputError: as `find_matcher`.
    """
    matcher = find_matcher(options)
    if sift or not matcher.sift_only:
        return matcher, ""
    return MATCHERS["colmap"], (
        f"The matcher {matcher.name} needs SIFT descriptors and no others, which this database "
        "does not have; COLMAP's matcher is used."
    )
