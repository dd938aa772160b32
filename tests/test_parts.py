"""Parts of a database for machines that do not see it, without any such machine."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.colmap.parts import IMPORTED
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.jobs import Item, Result, Work
from colmap_netvlad.runtime.processes import Processes


class InParts(Processes):
    """This machine, as if it did not see the database: shares begin at `starts`."""

    def __init__(self, starts: Sequence[int], folder: Path) -> None:
        self.starts, self.folder = starts, folder

    def stream(
        self, work: Work[Item, Iterable[Result]], items: Sequence[Item], first: int
    ) -> Iterator[Any]:
        source = work.source
        assert source is not None and source.take is not None and source.keep is not None
        for start, end in pairwise([*self.starts, len(items)]):
            share, part = items[start:end], self.folder / f"{start}.db"
            source.part(source.path, share, part)
            yield from work.function(part, *work.places, share)
            source.keep(source.path, source.take(part, share))


@pytest.mark.parametrize("starts", [(0, 1, 2, 6), (0, 2, 9), (0, 4)])
def test_shares_of_any_size_have_the_ids_of_one_import(
    starts: tuple[int, ...], flight: RenderedFlight, tmp_path: Path
) -> None:
    options = FeatureOptions("per-image", max_image_size=100, max_features=50)
    one, many = tmp_path / "one.db", tmp_path / "many.db"
    extract_features(flight.images, one, options)
    with workers.using(InParts(starts, tmp_path)):
        extract_features(flight.images, many, options)
    for table in IMPORTED:
        rows = [imported(database, table) for database in (one, many)]
        assert rows[0] == rows[1] and len(rows[0]) == len(flight.names)


def imported(database: Path, table: str) -> list[Any]:
    with closing(sqlite3.connect(database)) as connection:
        return sorted(connection.execute(f"SELECT * FROM {table}"))
