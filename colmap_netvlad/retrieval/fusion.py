"""Rankings that add up: sparse similarities, fusion, query expansion.

What deep features see and what SIFT sees differs, so their rankings are better together than
either alone. Everything works on sparse (N, N) matrices of the candidates the rankings list: no
dense matrix, so 20,000 images fit in memory.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.graph.pair import places_by_name
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.sequences import blocks

USUAL = 80
"""So many best partners of each image, or all others where they are fewer, tell what is usual."""

EXPANSION_NEIGHBOURS = 8
EXPANSION_SHARE = 0.6
"""Query expansion of `combine`. What these constants were chosen by: docs/training-log.md, section
21."""

TAIL = 1e-3
"""Weight of the rankings' own order, which decides where nothing else does."""

BLOCK_ROWS = 1024
"""Rows of a sparse product that are in memory at once."""


def similarity_matrix(ranking: Ranking) -> sparse.csr_array:
    """Return the symmetric (N, N) sparse similarity of a ranking's candidates, all above zero.

    A row's scores are standardised over its own list, so that rankings of different units add
    up and an image whose neighbours all look alike does not outbid the others; they are shifted
    so that "not listed" is zero, and the two directions of a pair are averaged.
    """
    n = len(ranking.names)
    listed = ranking.partners != NO_PARTNER
    rows = np.repeat(np.arange(n), listed.sum(axis=1))
    scores = ranking.scores[listed].astype(np.float64)
    count = np.maximum(np.bincount(rows, minlength=n), 1)
    mean = np.bincount(rows, scores, minlength=n) / count
    centred = scores - mean[rows]
    spread = np.sqrt(np.bincount(rows, centred**2, minlength=n) / count)
    standard = centred / np.maximum(spread, 1e-12)[rows]
    floor = np.zeros(n)
    np.minimum.at(floor, rows, standard)
    # A whisker above the floor keeps the least similar partner listed.
    values = standard - floor[rows] + 1e-6
    directed = sparse.csr_array((values, (rows, ranking.partners[listed])), shape=(n, n))
    return ((directed + directed.T) / 2).tocsr()


def above(ranking: Ranking) -> sparse.csr_array:
    """Return the symmetric (N, N) sparse similarity of candidates above what is usual.

    What is usual is the mean of all images' `USUAL` best scores; the unit is their standard
    deviation. Unlike `similarity_matrix`'s, all lists have the same units: an image without
    neighbours stays without.
    """
    n = len(ranking.names)
    best = ranking.scores[:, :USUAL].astype(np.float64)
    best = best[ranking.partners[:, :USUAL] != NO_PARTNER]
    if not best.size:
        return sparse.csr_array((n, n))
    floor, unit = best.mean(), max(best.std(), 1e-12)
    rows, places = np.nonzero((ranking.partners != NO_PARTNER) & (ranking.scores > floor))
    over = (ranking.scores[rows, places] - floor) / unit
    directed = sparse.csr_array((over, (rows, ranking.partners[rows, places])), shape=(n, n))
    return directed.maximum(directed.T).tocsr()


def combine(sources: Sequence[tuple[Ranking, float]], method: str, depth: int) -> Ranking:
    """Return the ranking by several, each with its share.

    How much more alike two images are than is usual (`above`) adds up, and the neighbours of an
    image's best neighbours are likely its own (query expansion). Where nothing is above what is
    usual, the rankings' own order decides.

    Raises:
        InputError: the rankings are of different image sets.
    """
    start = time.perf_counter()
    rankings = [ranking for ranking, _ in sources]
    names = rankings[0].names
    for ranking in rankings[1:]:
        if ranking.names != names:
            raise InputError(
                f"The rankings of {rankings[0].method} ({len(names)} images) and "
                f"{ranking.method} ({len(ranking.names)} images) are of different image sets; "
                "make both from the same database."
            )
    similar = sum(share * above(ranking) for ranking, share in sources)
    own_order = sum(share * similarity_matrix(ranking) for ranking, share in sources)
    similarity = expand(similar.tocsr(), EXPANSION_NEIGHBOURS, EXPANSION_SHARE, depth)
    unusable = set.intersection(*({name for name, _ in ranking.left_out} for ranking in rankings))
    return replace(
        ranking_of((similarity + TAIL * own_order).tocsr().sqrt(), names, method, depth),
        seconds_describe=sum(ranking.seconds_describe for ranking in rankings),
        seconds_search=sum(ranking.seconds_search for ranking in rankings)
        + time.perf_counter()
        - start,
        left_out=tuple((name, why) for name, why in rankings[0].left_out if name in unusable),
        notes=tuple(note for ranking in rankings for note in ranking.notes),
    )


def expand(
    similarity: sparse.csr_array, neighbours: int, share: float, depth: int
) -> sparse.csr_array:
    """Query expansion over the nearest-neighbour graph: what my neighbours like, I like.

    Each row becomes (1 - share) times itself plus `share` times the similarity-weighted mean of
    the rows of its `neighbours` best partners; the best `depth` of each row are kept.

    Returns:
        (N, N) symmetric sparse similarity.
    """
    voters = keep_best(similarity, neighbours)
    total = np.maximum(voters.sum(axis=1), 1e-12)
    voters = (sparse.diags_array(1.0 / total) @ voters).tocsr()
    expanded_rows = []
    for rows in blocks(similarity.shape[0], BLOCK_ROWS):
        mixed = (1 - share) * similarity[rows] + share * (voters[rows] @ similarity)
        expanded_rows.append(keep_best(_without_self(mixed.tocsr(), rows.start), depth))
    expanded = sparse.vstack(expanded_rows).tocsr()
    return ((expanded + expanded.T) / 2).tocsr()


def keep_best(matrix: sparse.csr_array, depth: int | NDArray[np.intp]) -> sparse.csr_array:
    """Return the matrix with only the `depth` largest values of each row; equals go by column.

    Args:
        depth: one number for all rows, or (N,) one for each.
    """
    matrix = matrix.tocsr()
    most = np.broadcast_to(depth, matrix.shape[0])
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    order = np.lexsort((matrix.indices, -matrix.data, rows))
    place = np.arange(len(rows)) - matrix.indptr[rows]
    kept = order[place < most[rows]]
    return sparse.csr_array(
        (matrix.data[kept], (rows[kept], matrix.indices[kept])), shape=matrix.shape
    )


def ranking_of(
    similarity: sparse.csr_array, names: tuple[str, ...], method: str, depth: int
) -> Ranking:
    """Return each image's `depth` most similar partners as a ranking; equals go by name."""
    n = len(names)
    by_name = places_by_name(names)
    rows = np.repeat(np.arange(n), np.diff(similarity.indptr))
    order = np.lexsort((by_name[similarity.indices], -similarity.data.round(9), rows))
    place = np.arange(len(rows)) - similarity.indptr[rows]
    inside = place < depth
    width = int(min(depth, np.diff(similarity.indptr).max(initial=0)))
    partners = np.full((n, width), NO_PARTNER, dtype=np.int32)
    scores = np.full((n, width), -np.inf, dtype=np.float32)
    partners[rows[inside], place[inside]] = similarity.indices[order[inside]]
    scores[rows[inside], place[inside]] = similarity.data[order[inside]]
    return Ranking(names, partners, scores, method)


def _without_self(block: sparse.csr_array, start: int) -> sparse.csr_array:
    entries = block.tocoo()
    other = entries.col != entries.row + start
    return sparse.csr_array(
        (entries.data[other], (entries.row[other], entries.col[other])), shape=block.shape
    )
