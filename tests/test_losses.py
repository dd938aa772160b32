"""The losses against slow, literal transcriptions of the paper's equations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_netvlad.training.losses import LOSSES, LossOptions, keep_similarities
from colmap_netvlad.training.sampling import Query


def plus(value: float) -> float:
    return max(0.0, value)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return math.sqrt(sum((x - y) ** 2 for x, y in zip(a.tolist(), b.tolist(), strict=True)))


def mean(values: list[float], nontrivial: bool) -> float:
    """Average; of the non-zero values only where trivial samples are left out."""
    kept = [v for v in values if v > 0] if nontrivial else values
    return sum(kept) / len(kept) if kept else 0.0


def literal_triplet(x: np.ndarray, queries: list[Query], options: LossOptions) -> float:
    values = []
    for q in queries:
        for p in q.positives:
            for n in q.negatives:
                values.append(
                    plus(distance(x[q.anchor], x[p]) - distance(x[q.anchor], x[n]) + options.margin)
                )
    return mean(values, options.nontrivial)


def literal_contrastive(x: np.ndarray, queries: list[Query], options: LossOptions) -> float:
    values = []
    for q in queries:
        for p in q.positives:
            values.append(distance(x[q.anchor], x[p]) ** 2 / 2)
        for n in q.negatives:
            values.append(plus(options.contrastive_margin - distance(x[q.anchor], x[n])) ** 2 / 2)
    return mean(values, options.nontrivial)


def literal_ranked_list(x: np.ndarray, queries: list[Query], options: LossOptions) -> float:
    per_query = []
    for q in queries:
        first = []
        for n in q.negatives:
            first.append(plus(options.alpha - distance(x[q.anchor], x[n])))
        for p in q.positives:
            first.append(plus(distance(x[q.anchor], x[p]) - options.alpha + options.margin))
        second = []
        for p, following in zip(q.positives, q.positives[1:], strict=False):
            second.append(plus(distance(x[q.anchor], x[p]) - distance(x[q.anchor], x[following])))
        l2 = mean(second, True) if options.nontrivial else sum(second) / len(q.positives)
        per_query.append(mean(first, options.nontrivial) + l2)
    return mean(per_query, options.nontrivial)


def literal_softmax(x: np.ndarray, queries: list[Query], options: LossOptions) -> float:
    per_query = []
    for q in queries:
        values = []
        for p in q.positives:
            share = math.exp(float(x[q.anchor] @ x[p]) / options.temperature)
            others = sum(
                math.exp(float(x[q.anchor] @ x[n]) / options.temperature) for n in q.negatives
            )
            values.append(-math.log(share / (share + others)))
        per_query.append(sum(values) / len(values))
    return sum(per_query) / len(per_query)


LITERAL = {
    "softmax": literal_softmax,
    "triplet": literal_triplet,
    "contrastive": literal_contrastive,
    "ranked-list": literal_ranked_list,
}


def random_batch(seed: int, queries: int, positives: int) -> tuple[torch.Tensor, list[Query]]:
    """A batch of B x (1 + M) descriptors with eq. 8's negatives, positions in random order."""
    rng = np.random.default_rng(seed)
    size = queries * (1 + positives)
    x = torch.from_numpy(rng.normal(size=(size, 6)))
    x = torch.nn.functional.normalize(x, dim=1)
    rows = rng.permutation(size).reshape(queries, 1 + positives).tolist()
    made = []
    for i, (anchor, *own) in enumerate(rows):
        others = [p for k, row in enumerate(rows) if k != i for p in row[1:]]
        made.append(Query(anchor, tuple(own), tuple(others)))
    return x, made


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    queries=st.integers(2, 5),
    positives=st.integers(1, 4),
    alpha=st.floats(0.3, 1.8),
    margin=st.floats(0.0, 0.5),
    nontrivial=st.booleans(),
    name=st.sampled_from(sorted(LOSSES)),
)
def test_losses_equal_the_literal_equations(
    seed: int,
    queries: int,
    positives: int,
    alpha: float,
    margin: float,
    nontrivial: bool,
    name: str,
) -> None:
    x, batch = random_batch(seed, queries, positives)
    options = LossOptions(margin, alpha, contrastive_margin=alpha, nontrivial=nontrivial)
    expected = LITERAL[name](x.numpy(), batch, options)
    assert LOSSES[name](x, batch, options).item() == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("nontrivial", [True, False])
@pytest.mark.parametrize("name", sorted(LOSSES))
def test_gradients_are_right(name: str, nontrivial: bool) -> None:
    x, batch = random_batch(3, 3, 2)
    options = LossOptions(alpha=1.3, contrastive_margin=1.3, nontrivial=nontrivial)

    def loss(values: torch.Tensor) -> torch.Tensor:
        return LOSSES[name](torch.nn.functional.normalize(values, dim=1), batch, options)

    assert torch.autograd.gradcheck(loss, (x.clone().requires_grad_(),))


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_equal_photos_have_a_finite_gradient(name: str) -> None:
    x = torch.nn.functional.normalize(torch.ones(6, 4), dim=1).requires_grad_()
    batch = [Query(0, (1, 2), (4, 5)), Query(3, (4, 5), (1, 2))]
    LOSSES[name](x, batch, LossOptions()).backward()
    assert x.grad is not None and torch.isfinite(x.grad).all()


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_an_anchor_without_negatives_has_a_finite_loss_and_gradient(name: str) -> None:
    x, _ = random_batch(4, 2, 2)
    x.requires_grad_()
    loss = LOSSES[name](x, [Query(0, (1, 2), ())], LossOptions())
    loss.backward()
    assert torch.isfinite(loss) and x.grad is not None and torch.isfinite(x.grad).all()


def test_nontrivial_average_is_not_thinned_by_easy_negatives() -> None:
    """One hard negative counts the same among a hundred easy ones."""
    anchor = torch.tensor([[1.0, 0.0, 0.0]])
    hard = torch.nn.functional.normalize(torch.tensor([[1.0, 0.05, 0.0]]), dim=1)
    easy = torch.tensor([[-1.0, 0.0, 0.0]]).repeat(100, 1)
    few = torch.cat([anchor, anchor, hard])
    many = torch.cat([few, easy])
    for name in ("triplet", "contrastive", "ranked-list"):
        loss, options = LOSSES[name], LossOptions()
        alone = loss(few, [Query(0, (1,), (2,))], options)
        among = loss(many, [Query(0, (1,), tuple(range(2, 103)))], options)
        assert alone > 0
        assert among.item() == pytest.approx(alone.item())
        thinned = loss(many, [Query(0, (1,), tuple(range(2, 103)))], LossOptions(nontrivial=False))
        assert thinned < 0.1 * alone


def test_ranked_list_asks_for_the_order_of_geometric_similarity() -> None:
    """L2 is zero in the right order and positive in the wrong one, with L1 zero in both."""
    angles = torch.tensor([0.0, 0.1, 0.2, math.pi], dtype=torch.float64)
    x = torch.stack([angles.cos(), angles.sin()], dim=1)
    right, wrong = [Query(0, (1, 2), (3,))], [Query(0, (2, 1), (3,))]
    loss = LOSSES["ranked-list"]
    assert loss(x, right, LossOptions()).item() == 0
    assert loss(x, wrong, LossOptions()).item() == pytest.approx(
        distance(x[0].numpy(), x[2].numpy()) - distance(x[0].numpy(), x[1].numpy())
    )


def test_keeping_similarities_costs_nothing_when_they_are_the_teachers() -> None:
    x, _ = random_batch(1, 3, 2)
    other, _ = random_batch(2, 3, 2)
    assert keep_similarities(x, x @ x.T).item() == 0
    wanted = other @ other.T
    expected = np.mean(
        [
            (float(x[i] @ x[j]) - float(wanted[i, j])) ** 2
            for i in range(len(x))
            for j in range(len(x))
            if i != j
        ]
    )
    assert keep_similarities(x, wanted).item() == pytest.approx(float(expected))
