"""What tests of the guided matcher share: rows of results, and a run that is killed."""

from __future__ import annotations

import sqlite3
import sys
from contextlib import closing
from pathlib import Path

Rows = dict[int, tuple[object, ...]]

COLUMNS = (
    "m.rows, m.cols, m.data, g.rows, g.cols, g.data, g.config, g.F, g.E, g.H, g.qvec, g.tvec,"
    " g.camera1, g.camera2"
)


def rows(database: Path) -> Rows:
    """Return every column of both tables of matches, by pair."""
    with closing(sqlite3.connect(database)) as connection:
        found = connection.execute(
            f"SELECT m.pair_id, {COLUMNS} FROM matches m JOIN two_view_geometries g USING (pair_id)"
        )
        return {row[0]: row[1:] for row in found}


def change(database: Path, *statements: str) -> None:
    """Run some SQL."""
    with closing(sqlite3.connect(database)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


def match_slowly(database: Path) -> None:
    """Match all pairs, a pair a transaction with a pause after it, to be killed meanwhile."""
    import itertools
    import time

    from colmap_netvlad.colmap.database import image_names
    from colmap_netvlad.colmap.results import write_results
    from colmap_netvlad.matching import blocks
    from colmap_netvlad.matching.options import MatchOptions
    from colmap_netvlad.matching.run import match_pairs

    def write(*arguments: object) -> None:
        write_results(*arguments)  # type: ignore[arg-type]
        time.sleep(0.3)

    blocks.BLOCK = blocks.WRITE_PAIRS = 1
    blocks.write_results = write  # type: ignore[attr-defined]
    pairs = list(itertools.combinations(image_names(database), 2))
    match_pairs(database, pairs, MatchOptions("guided"))


if __name__ == "__main__":
    match_slowly(Path(sys.argv[1]))
