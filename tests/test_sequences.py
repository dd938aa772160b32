"""Parts of long lists, and the order that breaks ties."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_netvlad.graph.pair import places_by_name
from colmap_netvlad.runtime.sequences import blocks, listed


@given(st.integers(0, 50), st.integers(1, 12))
def test_blocks_cover_every_row_once_in_order(count: int, size: int) -> None:
    parts = list(blocks(count, size))
    assert [i for part in parts for i in range(part.start, part.stop)] == list(range(count))
    assert all(part.stop - part.start <= size for part in parts)


@pytest.mark.parametrize(
    ("names", "text"),
    [([], ""), (["a"], "a"), (["a", "b", "c"], "a, b, c"), (list("abcde"), "a, b, c, and 2 more")],
)
def test_a_long_list_is_cut_and_says_how_many_more(names: list[str], text: str) -> None:
    assert listed(names, 3) == text


@given(st.lists(st.text(), unique=True))
def test_places_are_those_of_the_sorted_names(names: list[str]) -> None:
    places = places_by_name(names)
    assert [name for _, name in sorted(zip(places, names, strict=True))] == sorted(names)
