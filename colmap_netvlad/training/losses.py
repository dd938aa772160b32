"""Losses over a batch of global descriptors (section 3.2 of the paper).

Distances D are Euclidean between L2-normalised descriptors, so they lie in 0..2. Every loss takes
the batch's descriptors (N, D) and its queries, which say by row which samples are anchor,
positives and negatives.

Nontrivial averaging (section 3.1): samples whose loss is zero leave the average, so that they do
not thin out the gradient of the others. `nontrivial=False` gives the equations as printed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from colmap_netvlad.training.sampling import Query


@dataclass(frozen=True)
class LossOptions:
    """Margins of the losses.

    Attributes:
        margin: m of eq. 9 and 11, between positive and negative.
        alpha: the radius that eq. 11 pushes negatives out of.
        temperature: of the softmax loss.
        contrastive_margin: the distance from which on a negative costs nothing.
        nontrivial: leave samples of zero loss out of the averages.
    """

    margin: float = 0.1
    alpha: float = 1.35
    contrastive_margin: float = 0.7
    temperature: float = 0.05
    nontrivial: bool = True


Loss = Callable[[Tensor, Sequence[Query], LossOptions], Tensor]


def triplet(descriptors: Tensor, queries: Sequence[Query], options: LossOptions) -> Tensor:
    """Triplet loss (eq. 9), averaged over all triplets (anchor, positive, negative)."""
    terms = []
    for query in queries:
        positive, negative = _distances(descriptors, query)
        terms.append((positive[:, None] - negative[None, :] + options.margin).relu().flatten())
    return _average(torch.cat(terms), options.nontrivial)


def contrastive(descriptors: Tensor, queries: Sequence[Query], options: LossOptions) -> Tensor:
    """Contrastive loss: D^2 / 2 of a positive, [margin - D]_+^2 / 2 of a negative, averaged.

    Source: Radenović et al. 2018, eq. 4, whose training the paper compares with.
    """
    terms = []
    for query in queries:
        positive, negative = _distances(descriptors, query)
        terms.append(0.5 * positive.square())
        terms.append(0.5 * (options.contrastive_margin - negative).relu().square())
    return _average(torch.cat(terms), options.nontrivial)


def ranked_list(descriptors: Tensor, queries: Sequence[Query], options: LossOptions) -> Tensor:
    """Ranked list loss of a batch (eq. 13): the mean over queries of L1 + L2 (eq. 10).

    L1 (eq. 11) pulls positives inside the radius alpha - m and pushes negatives out of alpha.
    L2 (eq. 12) asks a positive of higher geometric similarity to be nearer than the next one; its
    sum ends one before the last positive, which has no next, and its divisor stays |P| as printed
    unless trivial terms are left out.
    """
    losses = []
    for query in queries:
        positive, negative = _distances(descriptors, query)
        sets = torch.cat(
            [
                (options.alpha - negative).relu(),
                (positive - options.alpha + options.margin).relu(),
            ]
        )
        order = (positive[:-1] - positive[1:]).relu()
        ranking = (
            _average(order, nontrivial=True)
            if options.nontrivial
            else order.sum() / len(query.positives)
        )
        losses.append(_average(sets, options.nontrivial) + ranking)
    return _average(torch.stack(losses), options.nontrivial)


def softmax(descriptors: Tensor, queries: Sequence[Query], options: LossOptions) -> Tensor:
    """Softmax loss: of each positive, -log of its share among itself and all negatives.

    With cosine similarities s and temperature T the mean over positives p of
    log(1 + sum_n exp((s_n - s_p) / T)), averaged over queries. Source: InfoNCE, van den Oord et
    al. 2018, eq. 4, for each positive by itself.
    """
    losses = []
    for query in queries:
        scaled = descriptors[query.anchor] @ descriptors.T / options.temperature
        negatives = scaled[list(query.negatives)].logsumexp(0)
        losses.append(softplus(negatives - scaled[list(query.positives)]).mean())
    return _average(torch.stack(losses), nontrivial=False)


LOSSES: dict[str, Loss] = {
    "ranked-list": ranked_list,
    "triplet": triplet,
    "contrastive": contrastive,
    "softmax": softmax,
}
"""The losses by the name that `train --loss` takes."""


def keep_similarities(descriptors: Tensor, similarities: Tensor) -> Tensor:
    """Distillation: mean squared difference of cosine similarities over pairs of different photos.

    It compares similarities, not descriptors, so that teacher and pupil may differ in length.

    Args:
        descriptors: (N, D) of the network, L2-normalised.
        similarities: (N, N) of the teacher.
    """
    different = ~torch.eye(len(descriptors), dtype=torch.bool, device=descriptors.device)
    return (descriptors @ descriptors.T - similarities)[different].square().mean()


def _distances(descriptors: Tensor, query: Query) -> tuple[Tensor, Tensor]:
    """Return the distances D of the anchor to its positives (P,) and negatives (Q,)."""
    others = descriptors[[*query.positives, *query.negatives]]
    # The square root has no gradient at 0 (equal photos), hence the floor.
    squared = (others - descriptors[query.anchor]).square().sum(1)
    distances = squared.clamp_min(1e-12).sqrt()
    return distances[: len(query.positives)], distances[len(query.positives) :]


def _average(terms: Tensor, nontrivial: bool) -> Tensor:
    """Mean of non-negative terms, or of those above zero."""
    count = int((terms > 0).sum()) if nontrivial else terms.numel()
    return terms.sum() / max(count, 1)
