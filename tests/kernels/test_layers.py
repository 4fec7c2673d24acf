"""Backward passes of layers beside NumPy, to the bit: sums have one order."""

from __future__ import annotations

import numpy as np

from chronoscene.kernels.compilation import kernel
from chronoscene.kernels.layers import add_column_sums, keep_active, sum_parts
from chronoscene.kernels.vectors import LANES


@kernel
def _add_column_sums(rows, start, count, width, sums, at):  # type: ignore[no-untyped-def]
    add_column_sums(rows, start, count, width, sums, at)


@kernel
def _keep_active(values, start, grads, count):  # type: ignore[no-untyped-def]
    keep_active(values, start, grads, count)


@kernel
def _sum_parts(parts, count, size, begin, end):  # type: ignore[no-untyped-def]
    sum_parts(parts, count, size, begin, end)


def _draw(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


def test_column_sums_are_added_in_the_order_of_the_rows() -> None:
    width = 2 * LANES
    rows, sums = _draw(6, width), _draw(width + 3)
    expected = sums.copy()
    for row in rows[1:5]:
        expected[3:] += row
    _add_column_sums(rows.ravel(), width, 4, width, sums, 3)
    np.testing.assert_array_equal(sums, expected)


def test_gradients_are_kept_where_a_unit_is_active() -> None:
    values, grads = _draw(3 * LANES), np.ones(2 * LANES, np.float32)
    values[LANES : LANES + 2] = 0.0, np.nan
    _keep_active(values, LANES, grads, 2 * LANES)
    np.testing.assert_array_equal(grads, values[LANES:] > 0)


def test_parts_are_summed_within_bounds_only() -> None:
    size, begin, end = 3 * LANES + 1, LANES, 3 * LANES + 1
    parts = _draw(3, size)
    expected = parts.copy()
    for part in parts[1:]:
        expected[0, begin:end] += part[begin:end]
    _sum_parts(parts.ravel(), 3, size, begin, end)
    np.testing.assert_array_equal(parts, expected)
