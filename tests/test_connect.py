"""Components get a small extra budget, and nobody uses it up alone."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from colmap_netvlad.graph.components import component_names, components
from colmap_netvlad.pairs.connect import TRIES_PER_LINK, apart_lines, connecting_pairs


def test_components_are_numbered_by_size() -> None:
    assert components(6, [(4, 5), (0, 3), (3, 1)]).tolist() == [0, 0, 2, 0, 1, 1]
    assert components(2, []).tolist() == [0, 1]


def test_the_best_untested_pairs_across_components_come_first() -> None:
    similarity = np.zeros((4, 4))
    similarity[0, 2], similarity[1, 2], similarity[1, 3], similarity[0, 1] = 3, 2, 1, 9
    matrix = sparse.csr_array(similarity + similarity.T)
    component = components(4, [(0, 1), (2, 3)])
    names = list("abcd")
    assert connecting_pairs(matrix, component, [(0, 2)], names, 5) == [(1, 2), (1, 3)]
    assert connecting_pairs(matrix, component, [(0, 2)], names, 1) == [(1, 2)]
    assert connecting_pairs(matrix, components(4, [(0, 1), (1, 2), (2, 3)]), [], names, 5) == []


def test_one_hopeless_link_does_not_starve_another() -> None:
    n = 21
    similarity = np.zeros((n, n))
    similarity[:10, 10:20] = 5.0
    similarity[0, 20] = 0.1
    matrix, names = sparse.csr_array(similarity + similarity.T), [f"{i:02d}" for i in range(n)]
    pairs = [(i, i + 1) for i in range(9)] + [(i, i + 1) for i in range(10, 19)]
    chosen = connecting_pairs(matrix, components(n, pairs), [], names, 10)
    assert len(chosen) == TRIES_PER_LINK + 1
    assert (0, 20) in chosen
    assert (0, 20) in connecting_pairs(matrix, components(n, pairs), [], names, TRIES_PER_LINK)


def test_what_stays_apart_is_listed_briefly() -> None:
    names = [f"{i:02d}" for i in range(40)]
    pairs = [(names[i], names[i + 1]) for i in range(11)] + [("12", "13"), ("13", "14")]
    groups = component_names(names, pairs)
    assert [len(group) for group in groups[:3]] == [12, 3, 1]
    assert apart_lines(groups) == [
        "3 images: 12, 13, 14",
        "25 alone: 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, and 15 more",
    ]
    assert apart_lines(component_names(names[:12], pairs[:11])) == []
