"""Adam for tables of which every step reads only some rows.

A view sees a part of the anchors and needs the features of one period. Adam moves the others too:
their first moment decays over some dozen steps, and they follow it. Here they catch up when they
are next read, all steps at once, so a step costs what it reads, however large the model is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from numba import prange
from numpy import float32
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.memory import load_first, read, read_index, store_first, write_index
from chronoscene.kernels.vectors import LANES, select, splat, sqrt
from chronoscene.training import devices
from chronoscene.training.optimizers.adam import (
    BETA1,
    BETA2,
    EPS,
    GAIN1,
    GAIN2,
    KEEP2,
    TINY_MEAN,
    TINY_SQUARE,
    DenseTable,
)

_HORIZON = 256
"""Steps after which a number that is not read no longer moves: what is left of its way is 2e-12 of
it."""
_RATIO = BETA1 / BETA2**0.5
LOG_BETA2 = math.log(BETA2)
WAY_PARTS = 3
"""Numbers for each gap: way over mean / root of square, and what is left of the two moments."""
CHUNK = 256  # Rows that a task takes at a time
ZERO = float32(0)


def make_table(value: Tensor) -> RowAdam | DenseTable:
    """Make a `RowAdam` where its kernels run, else a `DenseTable`."""
    return RowAdam(value) if devices.has_kernels(value) else DenseTable(value)


class RowAdam:
    """`DenseTable`, where methods are explained, that does not touch rows that are not read.

    With s steps done, a number that gets no gradient in the steps s + 1 .. t moves by

        (mean / sqrt(square)) sum_i rate_i root_i^-1 (BETA1 / sqrt(BETA2))^(i - s),

    where rate_i and root_i hold learning rate and bias corrections; the sum is the same for all
    numbers. That is Adam except for rounding, and for eps, which matters only to numbers whose
    gradients are near it. float32 on a CPU.

    Source: Kingma and Ba 2015 (Adam), algorithm 1; the sum is our derivation.

    Args:
        value: The table. [R, ...]
    """

    def __init__(self, value: Tensor) -> None:
        self.value = value.detach().contiguous()
        self.steps = 0
        self._columns = int(np.prod(value.shape[1:]))
        self._mean, self._square = (torch.zeros_like(self.value) for _ in range(2))
        self._stamps = np.zeros(len(value), np.int64)
        self._speeds: list[float] = []
        """rate / root of each step."""
        self._ways = self._new_ways()
        self._settled = np.empty(_HORIZON, np.float32)
        """The whole way of what was last read at each step, known up to `_HORIZON` steps ago; the
        rest is spare room."""
        self._fetched: tuple[Tensor, Tensor] | None = None
        """Rows of the last copies, and these."""

    def fetch(self, rows: Tensor) -> Tensor:
        rows = rows.contiguous()
        out = torch.empty(len(rows), *self.value.shape[1:])
        # In units of the root of the second moment without bias correction.
        eps = float32(EPS * (1 - BETA2 ** max(self.steps, 1)) ** 0.5)
        _fetch(*self._addresses(rows), eps, out.data_ptr())
        self._fetched = rows, out.requires_grad_()
        return out

    def gradient(self) -> Tensor | None:
        return None if self._fetched is None else self._fetched[1].grad

    def step(self, rate: float) -> None:
        root = (1 - BETA2 ** (self.steps + 1)) ** -0.5
        corrected = rate / (1 - BETA1 ** (self.steps + 1))
        if self._fetched is not None and (found := self._fetched[1].grad) is not None:
            rows, copies = self._fetched
            grads = found.contiguous()
            scalars = (float32(corrected), float32(root), float32(EPS))
            addresses = (copies.data_ptr(), grads.data_ptr())
            _update(*self._addresses(rows), *addresses, scalars)
        self._fetched = None
        self.steps += 1
        self._speeds.append(corrected / root)
        self._ways = self._new_ways()
        if self.steps < _HORIZON:
            return
        # What has waited `_HORIZON` steps now has gone all its way.
        stamp = self.steps - _HORIZON
        if stamp == len(self._settled):  # twice the room
            self._settled = np.concatenate([self._settled, np.empty_like(self._settled)])
        self._settled[stamp] = self._ways[_HORIZON, 0]

    def flush(self) -> Tensor:
        self.value.copy_(self.snapshot())
        gaps = self.steps - self._stamps
        for moments, beta in ((self._mean, BETA1), (self._square, BETA2)):
            left = torch.from_numpy((beta**gaps).astype(np.float32))
            moments.view(len(left), self._columns).mul_(left[:, None])
        self._stamps[:] = self.steps
        return self.value

    def snapshot(self) -> Tensor:
        if not (self._stamps < self.steps).any():
            return self.value
        fetched = self._fetched
        copies = self.fetch(torch.arange(len(self.value))).detach()
        self._fetched = fetched
        return copies

    def state(self) -> dict[str, Tensor]:
        settled = max(self.steps - _HORIZON + 1, 0)
        return {
            "value": self.value,
            "mean": self._mean,
            "square": self._square,
            "stamps": torch.from_numpy(self._stamps),
            "steps": torch.tensor(self.steps),
            "speeds": torch.tensor(self._speeds[-_HORIZON:], dtype=torch.float64),
            "settled": torch.from_numpy(self._settled[:settled]),
        }

    def load_state(self, state: Mapping[str, Tensor]) -> Tensor:
        tables = (state[name].clone() for name in ("value", "mean", "square"))
        self.value, self._mean, self._square = tables
        self._stamps = state["stamps"].numpy().copy()
        self.steps = int(state["steps"])
        self._speeds = state["speeds"].tolist()
        self._ways = self._new_ways()
        settled = state["settled"].numpy()
        room = np.empty(_HORIZON, np.float32)
        self._settled = np.concatenate([settled, room])
        self._fetched = None
        return self.value

    def extend(self, new_rows: Tensor) -> Tensor:
        self.flush()
        zeros = torch.zeros_like(new_rows, dtype=self.value.dtype)
        self._mean, self._square = (torch.cat((x, zeros)) for x in (self._mean, self._square))
        self.value = torch.cat((self.value, new_rows.detach().to(self.value)))
        self._mark_all()
        return self.value

    def keep(self, mask: Tensor) -> Tensor:
        self.flush()
        tables = (self.value, self._mean, self._square)
        self.value, self._mean, self._square = (table[mask] for table in tables)
        self._mark_all()
        return self.value

    def _mark_all(self) -> None:
        self._stamps = np.full(len(self.value), self.steps, np.int64)
        self._fetched = None

    def _addresses(self, rows: Tensor) -> tuple[_Table, _Rows, _Waits]:
        """Return the first arguments of both kernels."""
        tables = (self.value.data_ptr(), self._mean.data_ptr(), self._square.data_ptr())
        ways, settled = self._ways, self._settled
        return (
            _Table(*tables, self._columns, self._stamps.ctypes.data),
            _Rows(rows.data_ptr(), len(rows)),
            _Waits(self.steps, ways.ctypes.data, len(ways) - 1, settled.ctypes.data),
        )

    def _new_ways(self) -> NDArray[np.float32]:
        """Compute, for waits of 0, 1, .. steps, the sum above and the shares left of the moments.

        [G + 1, 3]
        """
        speeds = np.array(self._speeds[-_HORIZON:])
        gaps = np.arange(len(speeds) + 1)
        powers = _RATIO ** gaps[1:]
        # Summed from the last and smallest term on, each in units of the first step after s.
        sums = np.cumsum((speeds * powers)[::-1]) / np.concatenate([[1.0], powers])[:-1][::-1]
        columns = (np.concatenate([[0.0], sums]), BETA1**gaps, BETA2**gaps)
        return np.stack(columns, axis=1).astype(np.float32)


class _Table(NamedTuple):
    """Addresses and lengths of a table and its moments."""

    values: int
    """[R, columns]"""
    means: int
    squares: int
    columns: int
    stamps: int
    """Step up to which a row is done. int64 [R]"""


class _Rows(NamedTuple):
    """The rows that a step reads, each once."""

    numbers: int
    """Their address. int64 [M]"""
    length: int


class _Waits(NamedTuple):
    """Ways of rows that were not read for a while, and the shares left of their moments."""

    now: int
    """Present step."""
    ways: int
    """Address of numbers for each wait of 0..longest steps. float32 [G + 1, WAY_PARTS]"""
    longest: int
    """G; what waited longer has gone all its way."""
    settled: int
    """Address of the way of those, by their stamp. float32"""


@inner
def _clean(mean, square):  # type: ignore[no-untyped-def]
    """Return moments without denormal numbers; see `TINY_MEAN`."""
    tiny, zero = splat(TINY_MEAN), splat(ZERO)
    mean = select(mean < tiny, select(zero - tiny < mean, zero, mean), mean)
    return mean, select(square < splat(TINY_SQUARE), zero, square)


@inner
def _wait_of(table, row, waits):  # type: ignore[no-untyped-def]
    """Return the way, and the shares left of the moments, of a row after its wait."""
    stamp = read_index(table.stamps, row)
    gap = waits.now - stamp
    if gap <= waits.longest:
        at = WAY_PARTS * gap
        return read(waits.ways, at), read(waits.ways, at + 1), read(waits.ways, at + 2)
    return read(waits.settled, stamp), ZERO, float32(math.exp(gap * LOG_BETA2))


@inner
def _copy(table, row, way, eps, out, m):  # type: ignore[no-untyped-def]
    """Copy the numbers of one row after their wait, as copy m."""
    at, to = row * table.columns, m * table.columns
    for c in range(0, table.columns, LANES):
        left = table.columns - c
        value = load_first(table.values, at + c, left)
        if way != ZERO:
            mean = load_first(table.means, at + c, left)
            root = sqrt(load_first(table.squares, at + c, left))
            value = value - way * mean / (root + eps)
        store_first(out, to + c, value, left)


@kernel(parallel=True)
def _fetch(table, rows, waits, eps, out):  # type: ignore[no-untyped-def]
    """Copy rows as they are at the present step to the address ``out``. [M, columns]"""
    for task in prange((rows.length + CHUNK - 1) // CHUNK):
        for m in range(task * CHUNK, min((task + 1) * CHUNK, rows.length)):
            row = read_index(rows.numbers, m)
            way, _, _ = _wait_of(table, row, waits)
            _copy(table, row, way, eps, out, m)


@inner
def _step(table, row, keep1, keep2, copies, grads, m, scalars):  # type: ignore[no-untyped-def]
    rate, root, eps = scalars
    at, to = row * table.columns, m * table.columns
    for c in range(0, table.columns, LANES):
        left = table.columns - c
        grad = load_first(grads, to + c, left)
        mean = keep1 * load_first(table.means, at + c, left)
        mean = mean + GAIN1 * (grad - mean)
        square = (KEEP2 * keep2) * load_first(table.squares, at + c, left)
        mean, square = _clean(mean, square + GAIN2 * grad * grad)
        moved = rate * mean / (sqrt(square) * root + eps)
        store_first(table.values, at + c, load_first(copies, to + c, left) - moved, left)
        store_first(table.means, at + c, mean, left)
        store_first(table.squares, at + c, square, left)


@kernel(parallel=True)
def _update(table, rows, waits, copies, grads, scalars):  # type: ignore[no-untyped-def]
    """Do one step of Adam for rows that `_fetch` wrote to the address ``copies``.

    Args:
        grads: Address of the gradients of the copies.
        scalars: rate, root and eps, as in `adam_block`.
    """
    for task in prange((rows.length + CHUNK - 1) // CHUNK):
        for m in range(task * CHUNK, min((task + 1) * CHUNK, rows.length)):
            row = read_index(rows.numbers, m)
            _, keep1, keep2 = _wait_of(table, row, waits)
            _step(table, row, keep1, keep2, copies, grads, m, scalars)
            write_index(table.stamps, row, waits.now + 1)
