"""Flights in one project: sessions by folder, day and camera, and pairs across them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import numpy as np

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.pairs.union import ImagePair
from colmap_netvlad.photos.files import BadPhoto, read_header
from colmap_netvlad.runtime.errors import InputError

SHOWN = 6
"""Sessions that are printed one by one."""

DEPTH = 100
"""Candidates of each image, at least, among which partners in other sessions are looked for."""


def find_sessions(names: Sequence[str], images: Path | None) -> list[str]:
    """Return the session of each image: folder, day and serial number, as far as they differ.

    Args:
        names: of the images, relative to `images`.
        images: photo folder, for days and serial numbers; None: folders alone.

    Raises:
        InputError: all images are of one session.
    """
    parts = [[str(PurePosixPath(name).parent)] for name in names]
    if images is not None:
        with ThreadPoolExecutor() as pool:
            said = pool.map(_day_and_serial, [images / name for name in names])
        for part, more in zip(parts, said, strict=True):
            part.extend(more)
    columns = [column for column in zip(*parts, strict=True) if len(set(column)) > 1]
    if not columns:
        raise InputError(
            "`across` needs several flights, but all photos are of one folder"
            + (", day and camera." if images is not None else "; name the photo folder for more.")
        )
    return [", ".join(part or "unknown" for part in row) for row in zip(*columns, strict=True)]


def session_lines(sessions: Sequence[str]) -> list[str]:
    """Return what was taken for a session, largest first."""
    counts = Counter(sessions).most_common()
    shown = "; ".join(f"{name} ({count} photos)" for name, count in counts[:SHOWN])
    more = f"; {len(counts) - SHOWN} more" if len(counts) > SHOWN else ""
    return [f"{len(counts)} sessions: {shown}{more}"]


def across_pairs(ranking: Ranking, sessions: Sequence[str], count: int) -> list[ImagePair]:
    """Return each image with its `count` best partners of other sessions, each pair once."""
    session = np.unique(np.array(sessions), return_inverse=True)[1]
    found: dict[tuple[int, int], ImagePair] = {}
    for i, row in enumerate(ranking.partners):
        listed = np.flatnonzero(row != NO_PARTNER)
        foreign = listed[session[row[listed]] != session[i]][:count]
        for place in foreign.tolist():
            first, second = sorted((i, int(row[place])))
            score = float(ranking.scores[i, place])
            kept = found.get((first, second))
            if kept is None or kept.score < score:
                names = ranking.names[first], ranking.names[second]
                found[first, second] = ImagePair(*names, score, place + 1)
    return [found[key] for key in sorted(found)]


def joined(pairs: Sequence[ImagePair], more: Sequence[ImagePair]) -> list[ImagePair]:
    """Return the pairs, and those of `more` that are not among them."""
    have = {(pair.name1, pair.name2) for pair in pairs}
    return [*pairs, *(pair for pair in more if (pair.name1, pair.name2) not in have)]


def _day_and_serial(photo: Path) -> tuple[str, str]:
    try:
        header = read_header(photo)
    except BadPhoto:
        return "", ""
    return header.day or "", header.serial or ""
