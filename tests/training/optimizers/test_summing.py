"""Sums of gradients of several views."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from chronoscene.training import devices
from chronoscene.training.optimizers.adam import DenseTable
from chronoscene.training.optimizers.row_adam import RowAdam
from chronoscene.training.optimizers.summing import Part, add_gradients, use_sum

ROWS = ([4, 1], [], [0, 4, 5], [4])


def parts_of(table: DenseTable | RowAdam) -> list[Part]:
    generator, found = np.random.default_rng(0), []
    for numbers in ROWS:
        rows = torch.tensor(numbers, dtype=torch.int64)
        copies = table.fetch(rows)
        copies.grad = torch.from_numpy(generator.normal(size=copies.shape).astype(np.float32))
        found.append((rows, copies))
    return found


@pytest.mark.parametrize("kernels", [True, False])
@pytest.mark.parametrize("kind", [DenseTable, RowAdam])
def test_a_step_uses_the_sum_over_the_views(
    kind: type[DenseTable | RowAdam], kernels: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compared with the sum in float64; rows that several views read are counted as often."""
    table = kind(torch.ones(7, 3))
    parts = parts_of(table)
    whole = np.zeros((7, 3))
    for rows, copies in parts:
        assert copies.grad is not None
        np.add.at(whole, rows.numpy(), copies.grad.double().numpy())
    with monkeypatch.context() as patch:
        if not kernels:
            patch.setattr(devices, "has_kernels", lambda *tensors: False)
        use_sum(table, parts)
    assert table.fetched is not None
    rows, copies = table.fetched
    assert rows.tolist() == [0, 1, 4, 5] and copies.grad is not None
    np.testing.assert_allclose(copies.grad, whole[rows], rtol=0, atol=3e-7)
    table.step(0.1)
    # The first step of Adam is as long as its rate, against the sign of the gradient.
    np.testing.assert_allclose(table.flush(), 1 - 0.1 * np.sign(whole), rtol=0, atol=1e-5)


def test_a_single_view_is_used_as_it_is() -> None:
    table = RowAdam(torch.ones(7, 3))
    part = parts_of(table)[0]
    table.fetch(torch.arange(2))
    use_sum(table, [part])
    assert table.fetched is part


def test_gradients_are_added_by_name() -> None:
    total: dict[str, torch.Tensor] = {}
    for grads in ({"a": torch.ones(2)}, {"b": torch.ones(1)}, {"a": 2 * torch.ones(2)}):
        add_gradients(total, grads)
    assert {name: grad.tolist() for name, grad in total.items()} == {"a": [3.0, 3.0], "b": [1.0]}


def test_an_empty_table_and_no_rows_are_possible() -> None:
    for table in (RowAdam(torch.zeros(0, 3)), RowAdam(torch.zeros(4, 0))):
        rows = torch.arange(len(table.value))
        parts = [(rows, table.fetch(rows)) for _ in range(2)]
        for _, copies in parts:
            copies.grad = torch.zeros_like(copies)
        use_sum(table, parts)
        table.step(0.1)
        assert table.flush().shape == table.value.shape
