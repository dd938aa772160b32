"""Which pairs to match next, given what the pairs matched so far taught.

The paper ranks once and matches what it ranked. Here a budget of image pairs is spent in rounds:
the first follows the ranking; after each round the untested candidates are scored again by what
was verified and what failed around them, and the most probable ones are matched next.

Everything is sparse: candidates are the images' own lists and the partners of their verified
partners, so 20,000 images fit in memory. Matrices are (N, N) and symmetric, N the number of
images; pairs are index pairs with the lower index first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from colmap_netvlad.graph.pair import IndexPair, places_by_name
from colmap_netvlad.graph.verified import CORRECT_MATCHES
from colmap_netvlad.runtime.sequences import blocks

SATURATION = 100
"""Verified matches from which on a pair's evidence counts fully."""

LEAST_PROBABILITY = 0.05
"""A round stops where no untested candidate is more probable than this, see `least_probability`."""

DOUBT = 5.0
"""Pairs by which a round's success is held to be chance."""

BLOCK_ROWS = 2048
"""Rows of a sparse product that are in memory at once."""


@dataclass(frozen=True)
class Weights:
    """A logistic model of the probability that an untested pair verifies.

    `scripts/fit_rounds.py` fits it on the training flights by replaying rounds on exhaustively
    matched databases. Each weight belongs to a column of `evidence`.
    """

    similarity: float
    agreeing: float
    failing: float
    rate: float
    support: float
    intercept: float


FITTED = {
    False: Weights(
        similarity=0.162,
        agreeing=1.28,
        failing=-3.84,
        rate=-0.39,
        support=0.482,
        intercept=-2.08,
    ),
    True: Weights(
        similarity=3.18,
        agreeing=1.83,
        failing=-4.51,
        rate=-4.34,
        support=0.46,
        intercept=-10.09,
    ),
}
"""By whether the ranking's candidates were compared place by place: such a ranking says more."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Untested pairs.

    Attributes:
        first, second: (M,) indices of the images, first < second.
        evidence: (M, 5) columns as in `Weights`.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    evidence: NDArray[np.float64]

    def probability(self, weights: Weights = FITTED[False]) -> NDArray[np.float64]:
        """Return (M,) the probability that each pair verifies, 0..1."""
        *slopes, intercept = astuple(weights)
        logit = self.evidence @ np.array(slopes) + intercept
        # Rounded, so that the order in which floats were added cannot reorder equal pairs.
        return np.round(1.0 / (1.0 + np.exp(-logit)), 9)


def find_candidates(similarity: sparse.csr_array, verified: Mapping[IndexPair, int]) -> Candidates:
    """Return the untested pairs worth a thought, with what speaks for and against each.

    Args:
        similarity: from `retrieval.fusion.similarity_matrix`.
        verified: verified matches of every tested pair (0 where it failed).
    """
    results = _tested_matrices(similarity.shape[0], verified)
    tested, correct, _ = results
    reachable = (similarity + correct @ correct).tocoo()
    upper = reachable.row < reachable.col
    first, second = reachable.row[upper].astype(np.int64), reachable.col[upper].astype(np.int64)
    untested = _sample(tested, first, second) == 0
    return _with_evidence(similarity, results, first[untested], second[untested])


def _with_evidence(
    similarity: sparse.csr_array,
    results: tuple[sparse.csr_array, sparse.csr_array, sparse.csr_array],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
) -> Candidates:
    tested, correct, weight = results
    failed = (tested - correct).tocsr()
    agreeing = _symmetric_product(weight, correct, first, second)
    failing = _symmetric_product(weight, failed, first, second)
    strength = np.maximum(weight.sum(axis=1), 1.0)
    mean_of_verified = sparse.diags_array(1.0 / strength) @ weight
    support = _symmetric_product(mean_of_verified, similarity, first, second)
    evidence = np.column_stack(
        [
            _sample(similarity, first, second),
            np.log1p(agreeing),
            np.log1p(failing),
            np.log((agreeing + 0.5) / (agreeing + failing + 1.5)),
            support,
        ]
    )
    return Candidates(first, second, evidence)


def take_turns(
    first: Sequence[int] | NDArray[np.int64],
    second: Sequence[int] | NDArray[np.int64],
    value: Sequence[float] | NDArray[np.float64],
    names: Sequence[str],
    budget: int,
) -> list[IndexPair]:
    """Choose at most `budget` pairs, round-robin over the images.

    In each sweep every image that has a candidate left proposes its best one, all at the same
    time, so no image is served twice before every image was served once; a pair both its images
    propose serves both. Where the budget ends within a sweep its best proposals are taken.
    The choice does not depend on the order of the images: ties are broken by name.
    """
    order = _strict_order(first, second, value, names)
    ranked = [(int(first[i]), int(second[i])) for i in order]
    queues: dict[int, list[int]] = {}
    for place, pair in enumerate(ranked):
        for image in pair:
            queues.setdefault(image, []).append(place)
    waiting = {image: iter(queue) for image, queue in queues.items()}
    taken: set[int] = set()
    chosen: list[int] = []
    while len(chosen) < budget and waiting:
        proposals = _proposals(waiting, taken)
        cut = sorted(proposals)[: budget - len(chosen)]
        taken.update(cut)
        chosen.extend(cut)
    return [ranked[place] for place in chosen]


def next_round(
    similarity: sparse.csr_array,
    verified: Mapping[IndexPair, int],
    names: Sequence[str],
    budget: int,
    weights: Weights = FITTED[False],
    latest: Collection[IndexPair] = (),
) -> list[IndexPair]:
    """Return at most `budget` untested pairs to match next, the most valuable first.

    With nothing tested yet this is the ranking itself, round-robin over the images. Later,
    pairs less probable than `least_probability` are not worth matching: the list is shorter than
    the budget, or empty, where nothing promising is left or fewer than `LEAST_PROBABILITY` of what
    was tested verified.

    Args:
        latest: the pairs of the round before, which are among the tested.
    """
    correct = sum(count > CORRECT_MATCHES for count in verified.values())
    if correct < LEAST_PROBABILITY * len(verified):
        return []
    candidates = find_candidates(similarity, verified)
    if not verified:
        value = candidates.evidence[:, 0]
        promising = np.ones(len(value), dtype=bool)
    else:
        value = candidates.probability(weights)
        promising = value > least_probability(similarity, verified, weights, latest)
    return take_turns(
        candidates.first[promising],
        candidates.second[promising],
        value[promising],
        names,
        budget,
    )


def least_probability(
    similarity: sparse.csr_array,
    verified: Mapping[IndexPair, int],
    weights: Weights,
    latest: Collection[IndexPair],
) -> float:
    """Return how probable a pair must be to be worth matching: `LEAST_PROBABILITY`, or less where
    more of the latest round verified than was probable.

    There the weights, which are the same for all flights, say too little of this one, and of the
    pairs that are left as well: the odds that they must have are divided by as many times as
    those of the latest round were better. Worse ones change nothing, since stopping early costs
    pairs that nobody finds again.
    """
    asked = set(latest)
    before = {pair: count for pair, count in verified.items() if pair not in asked}
    if not before or not asked:
        return LEAST_PROBABILITY
    first, second = np.array(sorted(asked), dtype=np.int64).T
    results = _tested_matrices(similarity.shape[0], before)
    probable = _with_evidence(similarity, results, first, second).probability(weights).sum()
    correct = sum(verified.get(pair, 0) > CORRECT_MATCHES for pair in asked)
    odds, expected = (
        (count + DOUBT) / (len(asked) - count + DOUBT) for count in (correct, probable)
    )
    if odds <= expected:
        return LEAST_PROBABILITY
    least = LEAST_PROBABILITY / (1 - LEAST_PROBABILITY) * expected / odds
    return float(least / (1 + least))


def replay(
    similarity: sparse.csr_array,
    truth: Mapping[IndexPair, int],
    names: Sequence[str],
    budget: int,
    rounds: int,
    weights: Weights = FITTED[False],
    unpaid: Set[IndexPair] = frozenset(),
) -> Iterator[dict[IndexPair, int]]:
    """Play rounds on a flight whose every pair is matched already; nothing is matched.

    Args:
        truth: verified matches of all pairs; absent pairs have none.
        unpaid: pairs that do not count against the budget.

    Yields:
        After each round the verified matches of all pairs tested so far.
    """
    tested: dict[IndexPair, int] = {}
    chosen: list[IndexPair] = []
    allowed = 0
    for size in split_budget(budget, rounds):
        allowed += size
        room = allowed - len(tested.keys() - unpaid)
        chosen = next_round(similarity, tested, names, room, weights, chosen)
        tested.update((pair, truth.get(pair, 0)) for pair in chosen)
        yield dict(tested)


def split_budget(budget: int, rounds: int) -> list[int]:
    """Return the size of each round; they add up to the budget, none is empty if it can help."""
    share, rest = divmod(budget, rounds)
    return [share + (1 if i < rest else 0) for i in range(rounds)]


def _tested_matrices(
    n: int, verified: Mapping[IndexPair, int]
) -> tuple[sparse.csr_array, sparse.csr_array, sparse.csr_array]:
    """Return the symmetric matrices: tested (0/1), correct (0/1), strength of evidence (0..1)."""
    pairs = np.array(list(verified), dtype=np.int64).reshape(-1, 2)
    counts = np.fromiter(verified.values(), dtype=np.float64, count=len(verified))
    correct = counts > CORRECT_MATCHES
    rows = np.concatenate([pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([pairs[:, 1], pairs[:, 0]])

    def matrix(values: NDArray[np.float64]) -> sparse.csr_array:
        both = np.concatenate([values, values])
        built = sparse.csr_array((both, (rows, columns)), shape=(n, n))
        built.eliminate_zeros()
        return built

    strength = np.where(correct, np.minimum(counts / SATURATION, 1.0), 0.0)
    return matrix(np.ones(len(counts))), matrix(correct.astype(np.float64)), matrix(strength)


def _symmetric_product(
    a: sparse.csr_array,
    b: sparse.csr_array,
    first: NDArray[np.int64],
    second: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return (a b)[i, j] + (a b)[j, i] of symmetric-pattern matrices at the pairs, in blocks."""
    total = np.zeros(len(first))
    transposed = a.T.tocsr()
    for rows, inside in _rows_and_pairs(a.shape[0], first):
        local, columns = first[inside] - rows.start, second[inside]
        total[inside] += _sample((a[rows] @ b).tocsr(), local, columns)
        total[inside] += _sample((b[rows] @ transposed).tocsr(), local, columns)
    return total


def _rows_and_pairs(n: int, first: NDArray[np.int64]) -> Iterator[tuple[slice, NDArray[np.int64]]]:
    order = np.argsort(first, kind="stable")
    for rows in blocks(n, BLOCK_ROWS):
        low, high = np.searchsorted(first[order], [rows.start, rows.stop])
        if high > low:
            yield rows, order[low:high]


def _sample(
    matrix: sparse.csr_array, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the values of a sparse matrix at (rows, columns)."""
    if len(rows) == 0:
        return np.zeros(0)
    return np.asarray(matrix[rows, columns], dtype=np.float64).ravel()


def _strict_order(
    first: Sequence[int] | NDArray[np.int64],
    second: Sequence[int] | NDArray[np.int64],
    value: Sequence[float] | NDArray[np.float64],
    names: Sequence[str],
) -> list[int]:
    """Return the candidates from the best to the worst, equal ones in the order of their names."""
    place = places_by_name(names)
    a, b = place[np.asarray(first, dtype=np.int64)], place[np.asarray(second, dtype=np.int64)]
    order = np.lexsort((np.maximum(a, b), np.minimum(a, b), -np.asarray(value, dtype=np.float64)))
    return [int(i) for i in order]


def _proposals(waiting: dict[int, Iterator[int]], taken: set[int]) -> set[int]:
    """Return each waiting image's best place that is not taken; images without one leave."""
    proposals = set()
    for image in list(waiting):
        place = next((p for p in waiting[image] if p not in taken), None)
        if place is None:
            del waiting[image]
        else:
            proposals.add(place)
    return proposals
