"""Which pairs are worth comparing: those that are likely partners, by what was found so far.

How likely is a logistic regression over two things: the ranks of two images in each other's lists
of candidates, and the votes of their neighbours, which grow as pairs are compared. So an image
whose neighbours find much goes on, however far down its list; one whose next candidates promise
nothing stops, unless it has hardly a partner yet, or nothing but partners.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from colmap_netvlad.retrieval.fusion import TAIL, keep_best

AT_A_TIME = 10
"""Candidates that an image asks for, before all look at what was found."""

PARTNERS = 6
"""An image with fewer sure partners asks on: what hardly overlaps with any other is not to be
missed."""

GOES_WELL = 0.8
"""An image also asks on while so large a share of what it asked for last were sure partners: there
are more than its candidates' order lets expect."""

LISTED = 50
"""Better ranks than this one say something."""

STRANGERS = -4.9
NEARER, FARTHER, VOTES = 1.4, 1.0, 2.5
"""Log-odds that two images turn out to be sure partners: of two that are in neither's list; what
the logarithm of how many times better than `LISTED` the better and the worse of their two ranks are
adds; what that of their neighbours' votes adds."""

LEAST_ODDS = -3.5
"""Log-odds of a pair that is not worth comparing: three of a hundred such make partners. What these
constants were chosen by: docs/training-log.md, section 22."""

FEW = 0.01
"""A pass in which fewer than this share of the images ask is not made: of thousands it takes longer
than what it compares."""


class Asking:
    """The pairs that N images ask to be compared, a few at a time."""

    def __init__(self, order: sparse.csr_array, depth: int) -> None:
        """Start with nothing compared.

        Args:
            order: (N, N) 1 / rank of each image's candidates.
            depth: pairs that an image asks for at most.
        """
        near = order.copy()
        near.data = np.maximum(np.log(LISTED * near.data), 0.0)
        self._by_rank = NEARER * near.maximum(near.T) + FARTHER * near.minimum(near.T)
        self._by_rank += TAIL * order
        self._left = np.full(order.shape[0], depth, np.intp)
        self._at_a_time = min(AT_A_TIME, depth - depth // 2)
        self._asked = sparse.csr_array(order.shape)

    def next(
        self,
        votes: sparse.csr_array,
        compared: sparse.csr_array,
        sure: sparse.csr_array,
    ) -> sparse.csr_array:
        """Return (N, N) positive where the image of a row asks for that of a column.

        Args:
            votes: (N, N) symmetric, the logarithm of one and the neighbours' votes in tens of
                places.
            compared: (N, N) symmetric, 1 for the pairs that were compared.
            sure: (N, N) symmetric, 1 for sure partners.
        """
        odds = self._by_rank + VOTES * votes
        rest = (odds - odds * compared).tocsr()
        found = (self._asked > 0).multiply(sure).sum(axis=1)
        goes_well = (found > 0) & (found >= GOES_WELL * np.diff(self._asked.indptr))
        on = (sure.sum(axis=1) < PARTNERS) | goes_well
        least = np.where(on, 0.0, LEAST_ODDS - STRANGERS)
        rest.data[rest.data <= np.repeat(least, np.diff(rest.indptr))] = 0.0
        rest.eliminate_zeros()
        asked = keep_best(rest, np.minimum(self._at_a_time, self._left))
        numbers = np.diff(asked.indptr)
        if np.count_nonzero(numbers) < FEW * len(numbers):
            return sparse.csr_array(asked.shape)
        self._left -= numbers
        self._asked = asked
        return asked
