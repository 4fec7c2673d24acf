"""RowAdam against Adam, which moves every row in every step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chronoscene.training.optimizers import row_adam
from chronoscene.training.optimizers.adam import ONE_VIEW, Adam, Pace
from chronoscene.training.optimizers.row_adam import RowAdam, fetch_together, step_together

# Worst of 400 runs: 3e-6 of the rates' sum, by which everything may move.
TOLERANCE = 1e-5


class Both:
    """The same table under both optimisers, the gradient of what is not read being zero."""

    def __init__(self, rows: int, columns: int, seed: int, pace: Pace = ONE_VIEW) -> None:
        self.rng = np.random.default_rng(seed)
        start = torch.from_numpy(self.rng.normal(size=(rows, columns)).astype(np.float32))
        self.dense = start.clone().requires_grad_()
        self.adam = Adam({"x": self.dense}, pace)
        self.lazy = RowAdam(start.clone(), pace)
        self.pace = pace
        self.way = 0.0

    def step(self, share: float, rate: float, scale: float = 1.0) -> None:
        rows = torch.from_numpy(np.flatnonzero(self.rng.random(len(self.dense)) < share))
        leaf = self.lazy.fetch(rows)
        np.testing.assert_allclose(
            leaf.detach(), self.dense.detach()[rows], rtol=0, atol=self.tolerance
        )
        grads = scale * self.rng.normal(size=leaf.shape).astype(np.float32)
        leaf.grad = torch.from_numpy(grads)
        self.dense.grad = torch.zeros_like(self.dense)
        self.dense.grad[rows] = leaf.grad
        self.lazy.step(rate)
        self.adam.step({"x": rate})
        self.way += 4 * self.pace.views * rate

    @property
    def tolerance(self) -> float:
        return TOLERANCE * self.way + 1e-6

    def compare(self) -> None:
        np.testing.assert_allclose(
            self.lazy.flush(), self.dense.detach(), rtol=0, atol=self.tolerance
        )


@settings(max_examples=30, deadline=None)
@given(
    steps=st.lists(st.tuples(st.floats(0, 1), st.floats(1e-5, 0.1)), min_size=1, max_size=40),
    scale=st.sampled_from([1e-7, 1e-3, 1.0, 1e4]),
    seed=st.integers(0, 1000),
    views=st.sampled_from([1, 4]),
)
def test_waiting_rows_end_where_adam_takes_them(
    steps: list[tuple[float, float]], scale: float, seed: int, views: int
) -> None:
    both = Both(7, 9, seed, Pace(views))
    for share, rate in steps:
        both.step(share, rate, scale)
    both.compare()


@pytest.mark.parametrize("views", [1, 3])
def test_rows_may_wait_longer_than_the_horizon(views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some for ever, some until the end."""
    both = Both(6, 4, 3, Pace(views))
    both.step(1.0, 0.01)
    monkeypatch.setattr(both, "rng", np.random.default_rng(1))
    for index in range(row_adam._HORIZON + 60):
        both.step(0.0, 0.01 * 0.99**index)
    both.step(1.0, 0.01)
    both.compare()


def test_waits_over_the_horizon_begin_at_any_step() -> None:
    """Rows are read every 150 steps or so, up to where the table of whole ways has grown twice."""
    both = Both(40, 4, seed=5)
    both.step(1.0, 0.01)
    for index in range(5 * row_adam._HORIZON):
        both.step(1 / 150, 0.001 * (1 + index % 7))
    both.compare()


def test_a_snapshot_changes_nothing() -> None:
    """Later values are equal bit by bit with and without it."""
    results = []
    for look in (False, True):
        both = Both(6, 5, seed=4)
        for _ in range(8):
            both.step(0.4, 0.01)
            if look:
                shown = both.lazy.snapshot()
                np.testing.assert_allclose(shown, both.dense.detach(), rtol=0, atol=both.tolerance)
        results.append(both.lazy.flush())
    assert torch.equal(*results)


def test_rows_come_and_go() -> None:
    both = Both(5, 3, seed=1)
    for _ in range(3):
        both.step(0.5, 0.01)
    new = torch.ones(2, 3)
    mask = torch.tensor([True, False, True, True, False, True, True])
    both.lazy.extend(new)
    both.lazy.keep(mask)
    both.adam.extend("x", new)
    both.dense = both.adam.keep("x", mask)
    for _ in range(4):
        both.step(0.5, 0.01)
    both.compare()


def test_without_a_gradient_nothing_is_lost() -> None:
    """Rows that were fetched and not used move as those that were not fetched."""
    both = Both(4, 2, seed=2)
    both.step(1.0, 0.01)
    both.lazy.fetch(torch.tensor([1, 3]))
    both.compare()


def test_a_row_keeps_its_shape() -> None:
    table = RowAdam(torch.zeros(4, 5, 3))
    assert table.fetch(torch.tensor([2, 0])).shape == (2, 5, 3)
    assert RowAdam(torch.zeros(0, 5, 3)).fetch(torch.empty(0, dtype=torch.int64)).shape == (0, 5, 3)


def test_tables_together_have_the_bits_of_each_alone() -> None:
    rng, shapes = np.random.default_rng(3), [(700, 5, 3), (900, 4), (0, 2), (600, 28)]
    start = [torch.from_numpy(rng.normal(size=s).astype(np.float32)) for s in shapes]
    together, alone = ([RowAdam(value.clone()) for value in start] for _ in range(2))
    for _ in range(4):
        rows = [torch.from_numpy(np.flatnonzero(rng.random(len(t)) < 0.6)) for t in start]
        copies = fetch_together(list(zip(together, rows, strict=True)))
        rates = [0.01, 0.02, 0.03, 0.04]
        for table, seen, copy, rate in zip(alone, rows, copies, rates, strict=True):
            own = table.fetch(seen)
            assert torch.equal(own, copy)
            if rate != 0.04:  # the last has no gradient
                own.grad = torch.from_numpy(rng.normal(size=own.shape).astype(np.float32))
                copy.grad = own.grad
            table.step(rate)
        step_together(list(zip(together, rates, strict=True)))
    for a, b in zip(together, alone, strict=True):
        assert torch.equal(a.flush(), b.flush())


def test_equal_bits_for_any_number_of_threads(threads: Callable[[int], None]) -> None:
    results = []
    for number in (1, 2):
        threads(number)
        both = Both(5_000, 11, seed=0)
        for _ in range(6):
            both.step(0.4, 0.01)
        results.append(both.lazy.flush())
    assert torch.equal(*results)


def test_a_table_goes_on_from_its_state_with_the_same_bits() -> None:
    """Also rows that wait for longer than the horizon, before and after the interruption."""
    first, second = (Both(40, 5, seed=4) for _ in range(2))
    for both in (first, second):
        both.step(1.0, 0.02)
        for _ in range(row_adam._HORIZON + 40):
            both.step(1 / 150, 0.01)
    state = {name: tensor.clone() for name, tensor in first.lazy.state().items()}
    assert state["stamps"].min() == 1
    second.lazy = RowAdam(torch.zeros(2, 5))
    assert torch.equal(second.lazy.load_state(state), state["value"])
    for both in (first, second):
        for _ in range(row_adam._HORIZON + 40):
            both.step(1 / 150, 0.01)
        both.step(1.0, 0.01)
    ours, theirs = first.lazy.state(), second.lazy.state()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    first.compare()
