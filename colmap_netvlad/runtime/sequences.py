"""Long lists, a part at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

MOST_LISTED = 10
"""Names that are listed in one sentence."""


def listed(names: Sequence[str], most: int = MOST_LISTED) -> str:
    """Return the first `most` names with commas, and how many more there are."""
    more = f", and {len(names) - most:,} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def blocks(count: int, size: int) -> Iterator[slice]:
    """Yield slices that cover `count` rows in order, `size` at a time."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
