"""Parts of a database, for machines that do not see it, and what they write into them.

A part is a database of COLMAP's own with the same ids. What is written there comes back as rows.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from colmap_netvlad.colmap import engine
from colmap_netvlad.colmap.copies import (
    CAMERAS,
    FEATURES,
    MATCHES,
    Rows,
    copy_features,
    read_rows,
    write_rows,
)
from colmap_netvlad.colmap.database import open_database, pair_id

IMPORTED = ("images", "frames", "frame_data", "pose_priors")
"""Tables that an import of photos writes, beside those of cameras."""

COUNTED = ("cameras", "rigs", "images", "frames")
"""Tables in which sqlite counts the ids."""


def part_of_pairs(database: Path, pairs: Sequence[tuple[int, int]], target: Path) -> None:
    """Write what matching needs of some pairs: cameras and features of their images."""
    engine.make_or_migrate(target)
    copy_features(database, target, {number: f"image{number}" for pair in pairs for number in pair})


def rows_of_pairs(part: Path, pairs: Sequence[tuple[int, int]]) -> Rows:
    """Return matches and two-view geometries of some pairs."""
    ids = [pair_id(*pair) for pair in pairs]
    return read_rows(part, dict.fromkeys(MATCHES, ("pair_id", ids)))


class PartsOfImport:
    """Parts of a database for importing photos and extracting their features.

    Each photo gets the ids it would have if all were imported here one after the other.

    Args:
        database: has the cameras of the photos, but for those that have a camera each.
        names: of all photos, in the order of their ids to be; those that it has keep theirs.
    """

    def __init__(self, database: Path, names: Sequence[str]) -> None:
        with open_database(database) as colmap:
            known = {row.name for row in colmap.images()}
            self._last = {
                table: int(seq)
                for table, seq in colmap.connection.execute("SELECT name, seq FROM sqlite_sequence")
            }
            query = "SELECT COALESCE(MAX(pose_prior_id), 0) FROM pose_priors"
            (self._last_prior,) = colmap.connection.execute(query).fetchone()
        new = (name for name in names if name not in known)
        self._place = {name: place for place, name in enumerate(new)}

    def part(self, database: Path, names: Sequence[str], target: Path) -> None:
        """Write a part for some photos that follow each other."""
        engine.make_or_migrate(target)
        wanted = set(names)
        with open_database(database) as colmap:
            ids = {row.image_id for row in colmap.images() if row.name in wanted}
            frames = [frame for image, frame in colmap.frames().items() if image in ids]
        known = dict.fromkeys(CAMERAS) | {
            "images": ("image_id", ids),
            "frames": ("frame_id", frames),
            "frame_data": ("frame_id", frames),
        }
        write_rows(target, read_rows(database, known))
        place = self._first_place(names)
        with closing(sqlite3.connect(target)) as new, new:
            new.execute("DELETE FROM sqlite_sequence")
            new.executemany(
                "INSERT INTO sqlite_sequence VALUES (?, ?)",
                [(table, self._last.get(table, 0) + place) for table in COUNTED],
            )

    def rows(self, part: Path, names: Sequence[str]) -> Rows:
        """Return everything in a part."""
        with closing(sqlite3.connect(part)) as connection, connection:
            # By way of negative numbers: one by one, a row would get the number of another.
            connection.execute("UPDATE pose_priors SET pose_prior_id = -pose_prior_id")
            connection.execute(
                "UPDATE pose_priors SET pose_prior_id = ? - pose_prior_id",
                (self._last_prior + self._first_place(names),),
            )
        return read_rows(part, dict.fromkeys((*CAMERAS, *IMPORTED, *FEATURES)))

    def _first_place(self, names: Sequence[str]) -> int:
        return min((self._place[name] for name in names if name in self._place), default=0)
