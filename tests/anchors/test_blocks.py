"""Blocks of features that periods share, and when they part."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from chronoscene.anchors.blocks import (
    BlockStatistics,
    find_splits,
    leaders,
    nearest_seen,
    own_blocks,
    pack_blocks,
    share_equal,
    unpack_blocks,
)
from chronoscene.errors import CheckpointError


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


@pytest.mark.parametrize("first", [[[0, 0, 9]], [[1, 1, 0]]])
def test_damaged_files_are_refused(first: list[list[int]]) -> None:
    stored = {
        "anchors": torch.zeros(1, 3),
        "blocks": torch.zeros(2, 1),
        "block_leaders": torch.tensor(first, dtype=torch.uint8),
    }
    with pytest.raises(CheckpointError, match="each the first with its block"):
        unpack_blocks(stored, 3)


def test_equal_blocks_are_stored_once() -> None:
    blocks = torch.tensor([[[1.0], [2.0], [1.0]], [[3.0], [3.0], [3.0]], [[4.0], [5.0], [6.0]]])
    values, rows = share_equal(blocks)
    assert values.flatten().tolist() == [1, 2, 3, 4, 5, 6]
    assert rows.tolist() == [[0, 1, 0], [2, 2, 2], [3, 4, 5]]


def statistics_of(gradients: dict[tuple[int, int], list[list[float]]], shape: tuple[int, int, int]):  # type: ignore[no-untyped-def]
    """Statistics of gradients that are given by anchor and period."""
    found = BlockStatistics(*shape, torch.device("cpu"))
    for (anchor, period), values in gradients.items():
        for value in values:
            found.update(torch.tensor([anchor]), period, torch.tensor([value]))
    return found


def views(mean: float, count: int = 6) -> list[list[float]]:
    """Gradients that scatter about a mean."""
    return [[mean + 0.1 * (-1) ** i, 0.05 * (-1) ** (i // 2)] for i in range(count)]


def test_periods_that_pull_another_way_leave_together() -> None:
    found = statistics_of(
        {
            **{(0, t): views(1.0 if t in (1, 3) else -1.0) for t in range(5)},
            **{(1, t): views(0.5) for t in range(5)},
            **{(2, t): views(-2.0 if t == 0 else 0.0) for t in (0, 2, 4)},
            (3, 2): views(1.0),
        },
        (4, 5, 2),
    )
    rows = own_blocks(4, 1).repeat(1, 5)
    leaves = find_splits(found, rows, 10.0)
    one = leaves[0].nonzero()[:, 0].tolist()
    assert one in ([1, 3], [0, 2, 4])
    assert not leaves[1].any()
    assert leaves[2].nonzero()[:, 0].tolist() in ([0], [2, 4])  # not those that were never seen
    assert not leaves[3].any()
    # Those that left do not part again.
    rows[0, leaves[0]] = 4
    assert not find_splits(found, rows, 10.0)[0].any()


def test_few_views_split_nothing() -> None:
    found = statistics_of({(0, 0): views(1.0, 2), (0, 1): views(-1.0)}, (1, 2, 2))
    assert not find_splits(found, torch.zeros(1, 2, dtype=torch.int64), 1.0).any()


@pytest.mark.parametrize("periods", [2, 3, 8])
def test_scatter_alone_splits_almost_nothing(periods: int) -> None:
    generator = torch.Generator().manual_seed(periods)
    found = BlockStatistics(1_000, periods, 4, torch.device("cpu"))
    for _ in range(10):
        for period in range(periods):
            gradient = torch.randn(1_000, 4, generator=generator)
            found.update(torch.arange(1_000), period, gradient)
    rows = own_blocks(1_000, 1).repeat(1, periods)
    assert find_splits(found, rows, 8.0).any(1).float().mean() < 0.01
    assert find_splits(found, rows, 0.0).any(1).all()


def test_a_period_without_a_view_takes_the_nearest() -> None:
    seen = [[False, True, False, False, True, False], [False] * 6, [True] * 6]
    found = nearest_seen(torch.tensor(seen)).tolist()
    assert found == [[1, 1, 1, 4, 4, 4], list(range(6)), list(range(6))]


def test_what_is_forgotten() -> None:
    found = statistics_of({(0, 0): [[1.0]], (1, 0): [[2.0]]}, (2, 1, 1))
    found.fade(torch.tensor([True, False]))
    for counter in (found.count, found.squares, found.total):
        assert counter[0].sum() == 0 < counter[1].sum()
    torch.testing.assert_close(found.total[1] / found.count[1, 0], torch.tensor([[2.0]]))
    assert found.total[1] < 2
    assert found.seen.all()
