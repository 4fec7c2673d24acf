"""Blocks of features, and which periods come to share one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors import blocks as blocks_module
from chronoscene.anchors.blocks import (
    BlockStatistics,
    agglomerate,
    count_sharing,
    decay_to_mean,
    leaders,
    merge_alike,
    pack_blocks,
    unpack_blocks,
)
from chronoscene.errors import CheckpointError

Array = NDArray[np.float64]


def shared_rows(anchors: int, periods: int, seed: int) -> tuple[int, Tensor]:
    """How many blocks there are, and random rows of which no two anchors share one."""
    generator = np.random.default_rng(seed)
    chosen = generator.integers(0, periods, (anchors, periods))
    keys = chosen + periods * np.arange(anchors)[:, None]
    found, rows = np.unique(keys, return_inverse=True)
    order = generator.permutation(len(found))
    return len(found), torch.from_numpy(order[rows].reshape(anchors, periods))


@settings(max_examples=50)
@given(st.integers(1, 6), st.integers(1, 7), st.integers(0, 1000))
def test_what_is_stored_comes_back(anchors: int, periods: int, seed: int) -> None:
    count, rows = shared_rows(anchors, periods, seed)
    values = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    tensors = {"anchors": torch.zeros(anchors, 3), "blocks": values, "block_rows": rows}
    stored = pack_blocks(tensors)
    assert ("block_leaders" in stored) == (count < anchors * periods)
    restored = unpack_blocks(stored, periods)
    assert set(restored) == set(tensors)
    assert torch.equal(restored["blocks"][restored["block_rows"]], values[rows])
    assert torch.equal(leaders(restored["block_rows"]), leaders(rows))


@settings(max_examples=50)
@given(st.integers(0, 6), st.integers(1, 7), st.integers(0, 1000))
def test_what_periods_share_is_counted(anchors: int, periods: int, seed: int) -> None:
    _, rows = shared_rows(anchors, periods, seed)
    by_blocks, alone = [0] * periods, [0] * periods
    for row in rows.tolist():
        by_blocks[len(set(row)) - 1] += 1
        for period, block in enumerate(row):
            alone[period] += row.count(block) == 1
    found = count_sharing(rows)
    assert [counts.tolist() for counts in found] == [by_blocks, alone]


@settings(max_examples=50)
@given(
    st.integers(1, 6), st.integers(2, 7), st.integers(0, 1000), st.floats(0.0, 1.0), st.booleans()
)
def test_blocks_decay_to_the_mean_of_their_anchor(
    anchors: int, periods: int, seed: int, share: float, kernels: bool
) -> None:
    count, every = shared_rows(anchors, periods, seed)
    rows = every[:, torch.arange(1 + seed % periods)]  # the other periods take no part
    blocks = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    before, others = blocks[rows].double().numpy(), np.setdiff1d(every, rows)
    kept = blocks[others].clone()
    mean = before.mean(axis=1, keepdims=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks_module, "has_kernels", lambda *_: kernels)
        decay_to_mean(blocks, rows, share)
    expected = mean + (1 - share) * (before - mean)
    np.testing.assert_allclose(blocks[rows].numpy(), expected, atol=1e-6)
    assert torch.equal(blocks[others], kept)


@pytest.mark.parametrize("periods", [256, 257, 1000])
def test_many_periods_are_stored_as_few(periods: int) -> None:
    count, rows = shared_rows(3, periods, seed=0)
    tensors = {"anchors": torch.zeros(3, 3), "blocks": torch.arange(count)[:, None]}
    stored = pack_blocks(tensors | {"block_rows": rows})
    assert stored["block_leaders"].dtype == (torch.uint8 if periods == 256 else torch.int32)
    restored = unpack_blocks(stored, periods)
    assert torch.equal(restored["blocks"][restored["block_rows"]], tensors["blocks"][rows])


@pytest.mark.parametrize("first", [[[0, 0, 9]], [[1, 1, 0]]])
def test_damaged_files_are_refused(first: list[list[int]]) -> None:
    stored = {
        "anchors": torch.zeros(1, 3),
        "blocks": torch.zeros(2, 1),
        "block_leaders": torch.tensor(first, dtype=torch.uint8),
    }
    with pytest.raises(CheckpointError, match="each the first with its block"):
        unpack_blocks(stored, 3)


def clusters_by_hand(values: Array, weights: Array) -> tuple[list[float], list[Array]]:
    """Costs, and after each step the first period of each cluster, from the definition: the cost
    is what the weighted squares around the means of the clusters rise by. [T, F], [T]"""

    def squares(members: list[int]) -> float:
        w, v = weights[members, None], values[members]
        mean = (w * v).sum(0) / w.sum()
        return float((w * (v - mean) ** 2).sum())

    clusters = [[t] for t in range(len(values))]
    costs, history = [], []
    while len(clusters) > 1:
        pairs = [(a, b) for a in clusters for b in clusters if a[0] < b[0]]
        rises = [squares(a + b) - squares(a) - squares(b) for a, b in pairs]
        a, b = pairs[int(np.argmin(rises))]
        costs.append(min(rises))
        clusters = [c for c in clusters if c not in (a, b)] + [sorted(a + b)]
        first = {t: cluster[0] for cluster in clusters for t in cluster}
        history.append(np.array([first[t] for t in range(len(values))]))
    return costs, history


@settings(max_examples=30)
@given(st.integers(2, 7), st.integers(1, 4), st.integers(0, 1000))
def test_clusters_are_those_of_the_definition(periods: int, dim: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    values = generator.normal(size=(1, periods, dim))
    weights = generator.uniform(0.1, 3.0, (1, periods))
    expected, history = clusters_by_hand(values[0], weights[0])
    costs, first, _ = agglomerate(values, weights, np.inf)
    np.testing.assert_allclose(costs[0], expected, rtol=1e-9)
    assert (np.diff(costs[0]) >= -1e-12).all()  # a limit cuts the same steps off everywhere
    assert (first == 0).all()
    for steps, clusters in enumerate(history[:-1], start=1):
        limit = (expected[steps - 1] + expected[steps]) / 2
        costs, first, merged = agglomerate(values, weights, limit)
        assert np.isfinite(costs).sum() == steps
        np.testing.assert_array_equal(first[0], clusters)
        for leader in set(clusters):
            inside = clusters == leader
            mean = np.average(values[0, inside], axis=0, weights=weights[0, inside])
            np.testing.assert_allclose(merged[0, leader], mean, rtol=1e-9)


def test_a_period_that_sees_nothing_takes_a_neighbour() -> None:
    values, weights = np.arange(6.0).reshape(1, 6, 1), np.array([[0.0, 1, 0, 0, 1, 0]])
    _, first, merged = agglomerate(values, weights, 0.0)
    assert first.tolist() == [[0, 0, 0, 0, 4, 4]]
    assert merged[0, [0, 4], 0].tolist() == [1.0, 4.0]


def statistics_of(rise: list[list[float]], drawn: list[list[int]], off: list[list[int]]):  # type: ignore[no-untyped-def]
    """After ten views with these sums, by anchor and period."""
    found = BlockStatistics(len(rise), len(rise[0]), torch.device("cpu"))
    found.rise, found.drawn, found.off = (torch.tensor(t).float() for t in (rise, drawn, off))
    found.views += 10
    return found


def test_the_rise_of_the_loss_is_shared_among_all_anchors() -> None:
    blocks = torch.tensor([[0.0, 1.0, 5.0], [0.0, 2.0, 2.1], [7.0, 7.0, 7.0]])[..., None]
    found = statistics_of([[2.0] * 3] * 3, [[1] * 3] * 3, [[0] * 3] * 3)
    # Costs are half of the squared differences times the weight: 0, 0, 0.01 and 1 first.
    for share, expected in (
        (0.0, [[0, 1, 2], [0, 1, 2], [0, 0, 0]]),
        (0.002, [[0, 1, 2], [0, 1, 1], [0, 0, 0]]),
        (0.102, [[0, 0, 2], [0, 1, 1], [0, 0, 0]]),
        (100.0, [[0, 0, 0]] * 3),
    ):
        first, merged = merge_alike(blocks, found, share)
        assert first.tolist() == expected
    torch.testing.assert_close(merged[:2, 0, 0], torch.tensor([2.0, 4.1 / 3]))
    assert merged.dtype == torch.float32


def test_what_is_switched_off_is_not_taken_for_unseen() -> None:
    blocks = torch.tensor([[0.0, 3.0]])[..., None]
    unseen = statistics_of([[0.0, 8.0]], [[0, 4]], [[0, 0]])
    first, merged = merge_alike(blocks, unseen, 0.01)
    assert first.tolist() == [[0, 0]] and merged[0, 0] == 3.0
    switched_off = statistics_of([[0.0, 8.0]], [[0, 4]], [[4, 0]])
    torch.testing.assert_close(switched_off.weights(), torch.tensor([[8.0, 8.0]]))
    assert merge_alike(blocks, switched_off, 0.01)[0].tolist() == [[0, 1]]


def test_statistics_of_a_view() -> None:
    found = BlockStatistics(3, 2, torch.device("cpu"))
    gradient, drawn = torch.tensor([[0.1, 0.2], [0.0, 0.0]]), torch.tensor([True, False])
    found.update(torch.tensor([2, 0]), 1, gradient, drawn, loss=0.5, pixels=100)
    expected = 100 * 0.05 / (2 * 2 * 0.25)
    torch.testing.assert_close(found.rise, torch.tensor([[0, 0], [0, 0], [0, expected]]))
    assert found.drawn.tolist() == [[0, 0], [0, 0], [0, 1]]
    assert found.off.tolist() == [[0, 1], [0, 0], [0, 0]]
    found.fade()
    assert found.views == 0.9 and found.off[0, 1] == pytest.approx(0.9)
    copy = BlockStatistics(3, 2, torch.device("cpu"))
    copy.load_state(found.state())
    assert torch.equal(copy.rise, found.rise) and copy.views == found.views


def test_the_estimate_is_the_curvature_of_a_mean_of_independent_errors() -> None:
    """Pixels with errors of either sign, each moved by the block in a way of its own."""
    generator = np.random.default_rng(0)
    pixels, dim = 4_000, 4
    errors = generator.normal(size=pixels)
    slopes = generator.normal(size=(pixels, dim))
    step = 0.05 * generator.normal(size=(400, dim))

    def loss(at: Array) -> float:
        return float(np.abs(errors + slopes @ at).mean())

    zero = loss(np.zeros(dim))
    gradients = []
    for _ in range(200):  # other signs: other views of the same curvature
        signs = generator.choice([-1.0, 1.0], pixels)
        gradients.append((signs[:, None] * slopes).mean(0))
    squares = np.square(gradients).sum(1).mean()
    rise = pixels * squares / (2 * dim * zero**2) * np.square(step).sum(1)
    measured = np.mean([(loss(d) + loss(-d)) / 2 / zero - 1 for d in step])
    assert 0.5 < rise.mean() / measured < 2.0
