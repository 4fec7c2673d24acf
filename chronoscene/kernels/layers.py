"""Backward passes through layers of small networks, inside compiled kernels.

Memory is as in `memory`; widths are multiples of LANES. Rows and parts are summed in their order.
"""

from __future__ import annotations

from numpy import float32

from chronoscene.kernels.compilation import inner
from chronoscene.kernels.memory import load, load_first, store, store_first
from chronoscene.kernels.vectors import LANES, select, splat


@inner
def add_column_sums(rows, start, count, width, sums, at):  # type: ignore[no-untyped-def]
    """Add some rows to the gradient of a bias, which is at ``at``. [count, width] -> [width]"""
    for c in range(0, width, LANES):
        total = load(sums, at + c)
        for i in range(count):
            total = total + load(rows, start + i * width + c)
        store(sums, at + c, total)


@inner
def keep_active(values, start, grads, count):  # type: ignore[no-untyped-def]
    """Take gradients back through a ReLU: 0 where it gave 0. [count], [count]"""
    zero = splat(float32(0))
    for i in range(0, count, LANES):
        store(grads, i, select(zero < load(values, start + i), load(grads, i), zero))


@inner
def sum_parts(parts, count, size, begin, end):  # type: ignore[no-untyped-def]
    """Add the numbers begin..end of the other parts to those of the first. [count, size]"""
    for j in range(begin, end, LANES):
        total = load_first(parts, j, end - j)
        for part in range(1, count):
            total = total + load_first(parts, part * size + j, end - j)
        store_first(parts, j, total, end - j)
