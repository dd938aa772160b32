"""How pairs are matched, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

MATCHER_DEFAULT = "colmap"
"""The matcher where none is named."""

THOROUGH = ", thorough"


@dataclass(frozen=True)
class MatchOptions:
    """How pairs are matched; verification is COLMAP's with its own thresholds.

    Attributes:
        matcher: name in `matchers.MATCHERS`; None: `MATCHER_DEFAULT`.
        thorough: the matcher `guided` searches pairs in full that it would give up, and tries
            those again that were left without a match.
        seed: seed of the robust estimation, so that a pair always gives the same inliers.
        processes: how many work at once; None: all processors.
    """

    matcher: str | None = None
    thorough: bool = False
    seed: int = 0
    processes: int | None = None

    @property
    def label(self) -> str:
        """Who matches, for a reader: "guided, thorough"."""
        return (self.matcher or MATCHER_DEFAULT) + (THOROUGH if self.thorough else "")

    def labelled(self, label: str) -> MatchOptions:
        """Return these options with the matcher of another's label."""
        matcher, thorough, _ = label.partition(THOROUGH)
        return replace(self, matcher=matcher, thorough=bool(thorough))


@dataclass(frozen=True)
class Work:
    """What a matcher did.

    Attributes:
        given_up: pairs whose first glance showed nothing in common, which were not searched.
        even_seconds: what it took had all processors been at work all the time, s: the time of
            its processes, together, over the number that may work at once.
    """

    given_up: int = 0
    even_seconds: float = 0.0


@dataclass(frozen=True)
class MatchReport:
    """What `match_pairs` did.

    Attributes:
        requested: distinct pairs asked for.
        already: those matched before.
        matched: those matched now.
        verified: those of `requested` with a verified two-view geometry.
        seconds: time of matching and verification, s.
        given_up: those of `matched` whose first glance showed nothing in common; they stand in
            the database as pairs without matches.
        matcher: who matched them, a name in `matchers.MATCHERS`.
        even_seconds: as `Work`'s, to compare few pairs, for which one process works, with many.
    """

    requested: int
    already: int
    matched: int
    verified: int
    seconds: float
    given_up: int = 0
    matcher: str = MATCHER_DEFAULT
    even_seconds: float = 0.0


def given_up_words(report: MatchReport) -> str:
    """Return what to add to the number of verified pairs, or nothing."""
    return f", {report.given_up:,} given up at a glance" if report.given_up else ""
