"""Adam for tables of which every step reads only some rows.

A view sees a part of the anchors and needs the features of one period. Adam moves the others too:
their first moment decays over some dozen steps, and they follow it. Here they catch up when they
are next read, all steps at once, so a step costs what it reads, however large the model is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from numba import prange
from numpy import float32
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.memory import (
    load_first,
    prefetch,
    read,
    read_index,
    store_first,
    write_index,
)
from chronoscene.kernels.vectors import LANES, select, splat, sqrt
from chronoscene.training import devices
from chronoscene.training.optimizers.adam import (
    BETA2,
    EPS,
    ONE_VIEW,
    TINY_MEAN,
    TINY_SQUARE,
    DenseTable,
    Pace,
)

_HORIZON = 256
"""Steps after which a number that is not read no longer moves: what is left of its way is 2e-12 of
it."""
_WAITS = np.arange(_HORIZON + 1)
LOG_BETA2 = math.log(BETA2)
WAY_PARTS = 3
"""Numbers for each gap: way over mean / root of square, and what is left of the two moments."""
_LENGTH = 6  # Place of `_Rows.length` in a job
AHEAD = 8  # Rows between the request for one and its use
CHUNK = 256  # Rows that a task takes at a time
ZERO = float32(0)


def make_table(value: Tensor, pace: Pace = ONE_VIEW) -> RowAdam | DenseTable:
    """Make a `RowAdam` where its kernels run, else a `DenseTable`."""
    return (RowAdam if devices.has_kernels(value) else DenseTable)(value, pace)


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
        pace: As of `Adam`; has the betas.
    """

    def __init__(self, value: Tensor, pace: Pace = ONE_VIEW) -> None:
        self.value = value.detach().contiguous()
        self.steps = 0
        self._pace = pace
        self._powers = (pace.beta1 / pace.beta2**0.5) ** _WAITS
        self._shares = np.stack([beta**_WAITS for beta in (pace.beta1, pace.beta2)], axis=1)
        self._columns = int(np.prod(value.shape[1:]))
        self._mean, self._square = (torch.zeros_like(self.value) for _ in range(2))
        self._stamps = np.zeros(len(value), np.int64)
        self._speeds: list[float] = []
        """rate / root of each step."""
        self._ways = self._new_ways()
        self._settled = np.empty(_HORIZON, np.float32)
        """The whole way of what was last read at each step, known up to `_HORIZON` steps ago; the
        rest is spare room."""
        self.fetched: tuple[Tensor, Tensor] | None = None

    def fetch(self, rows: Tensor) -> Tensor:
        return fetch_together([(self, rows)])[0]

    def step(self, rate: float) -> None:
        step_together([(self, rate)])

    def _corrections(self, rate: float) -> tuple[float, float]:
        """Return the rate and the root of the next step, as in `adam_block`."""
        pace, steps = self._pace, self.steps + 1
        root = (1 - pace.beta2**steps) ** -0.5
        return pace.rate * rate / (1 - pace.beta1**steps), root

    def _count_step(self, corrected: float, root: float) -> None:
        self.fetched = None
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
        for moments, beta in ((self._mean, self._pace.beta1), (self._square, self._pace.beta2)):
            left = torch.from_numpy((beta**gaps).astype(np.float32))
            moments.view(len(left), self._columns).mul_(left[:, None])
        self._stamps[:] = self.steps
        return self.value

    def snapshot(self) -> Tensor:
        if not (self._stamps < self.steps).any():
            return self.value
        fetched = self.fetched
        copies = self.fetch(torch.arange(len(self.value))).detach()
        self.fetched = fetched
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
        self.fetched = None
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
        self.fetched = None

    def _job(self, rows: Tensor, copies: Tensor, grads: int = 0) -> tuple[int, ...]:
        """Return the numbers of `_Table`, `_Rows` and `_Waits`, as the kernels take them."""
        ways, settled = self._ways, self._settled
        return (
            self.value.data_ptr(),
            self._mean.data_ptr(),
            self._square.data_ptr(),
            self._columns,
            self._stamps.ctypes.data,
            rows.data_ptr(),
            len(rows),
            copies.data_ptr(),
            grads,
            self.steps,
            ways.ctypes.data,
            len(ways) - 1,
            settled.ctypes.data,
            self._pace.views,
        )

    def _new_ways(self) -> NDArray[np.float32]:
        """Compute, for waits of 0, 1, .. steps, the sum above and the shares left of the moments.

        [G + 1, 3]
        """
        speeds = np.array(self._speeds[-_HORIZON:])
        count = len(speeds)
        # Summed from the last and smallest term on, each in units of the first step after s.
        powers = self._powers
        sums = np.cumsum((speeds * powers[1 : count + 1])[::-1]) / powers[:count][::-1]
        ways = np.empty((count + 1, WAY_PARTS), np.float32)
        ways[0, 0], ways[1:, 0], ways[:, 1:] = 0.0, sums, self._shares[: count + 1]
        return ways


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
    copies: int
    """Address of their copies. [M, columns]"""
    grads: int
    """Address of the gradients of the copies."""


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
    views: int
    """`Pace.views`."""


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
    return read(waits.settled, stamp), ZERO, float32(math.exp(gap * waits.views * LOG_BETA2))


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


@inner
def _prefetch(table, rows, m):  # type: ignore[no-untyped-def]
    """Ask for a later row: it may be far from those before."""
    if m < rows.length:
        at = read_index(rows.numbers, m) * table.columns
        for c in range(0, table.columns, LANES):
            prefetch(table.values, at + c)
            prefetch(table.means, at + c)
            prefetch(table.squares, at + c)


@inner
def _part_of(jobs, starts, task):  # type: ignore[no-untyped-def]
    """Return the number of the job that a task is of, the job, and the task's first and last row.

    ``jobs`` are rows of `RowAdam._job`, and ``starts`` the first task of each.
    """
    n = np.searchsorted(starts, task, side="right") - 1
    j = jobs[n]
    rows = _Rows(j[5], j[6], j[7], j[8])
    first = (task - starts[n]) * CHUNK
    job = (_Table(j[0], j[1], j[2], j[3], j[4]), rows, _Waits(j[9], j[10], j[11], j[12], j[13]))
    return n, job, first, min(first + CHUNK, rows.length)


@kernel(parallel=True)
def _fetch(jobs, starts, eps):  # type: ignore[no-untyped-def]
    """Copy rows of several tables as they are at the present step. ``eps`` has one per table."""
    for task in prange(starts[-1]):
        n, (table, rows, waits), first, stop = _part_of(jobs, starts, task)
        for m in range(first, stop):
            row = read_index(rows.numbers, m)
            _prefetch(table, rows, m + AHEAD)
            way, _, _ = _wait_of(table, row, waits)
            _copy(table, row, way, eps[n], rows.copies, m)


@inner
def _step(table, rows, m, row, shares, scalars):  # type: ignore[no-untyped-def]
    (kept1, kept2), (rate, root, eps, gain1, keep2, gain2) = shares, scalars
    at, to = row * table.columns, m * table.columns
    for c in range(0, table.columns, LANES):
        left = table.columns - c
        grad = load_first(rows.grads, to + c, left)
        mean = kept1 * load_first(table.means, at + c, left)
        mean = mean + gain1 * (grad - mean)
        square = (keep2 * kept2) * load_first(table.squares, at + c, left)
        mean, square = _clean(mean, square + gain2 * grad * grad)
        moved = rate * mean / (sqrt(square) * root + eps)
        store_first(table.values, at + c, load_first(rows.copies, to + c, left) - moved, left)
        store_first(table.means, at + c, mean, left)
        store_first(table.squares, at + c, square, left)


@kernel(parallel=True)
def _update(jobs, starts, scalars):  # type: ignore[no-untyped-def]
    """Do one step of Adam for the rows of several tables that `_fetch` copied.

    Args:
        jobs: See `_part_of`, like ``starts``.
        scalars: Of each table, as in `adam_block`. float32 [n, SCALARS]
    """
    for task in prange(starts[-1]):
        n, (table, rows, waits), first, stop = _part_of(jobs, starts, task)
        s = scalars[n]
        given = s[0], s[1], s[2], s[3], s[4], s[5]
        for m in range(first, stop):
            row = read_index(rows.numbers, m)
            _prefetch(table, rows, m + AHEAD)
            _, kept1, kept2 = _wait_of(table, row, waits)
            _step(table, rows, m, row, (kept1, kept2), given)
            write_index(table.stamps, row, waits.now + 1)


def fetch_together(wanted: Sequence[tuple[RowAdam, Tensor]]) -> list[Tensor]:
    """Do `RowAdam.fetch` for several tables, in one compiled call."""
    eps, jobs, found = [], [], []
    for table, rows in wanted:
        rows = rows.contiguous()
        copies = torch.empty(len(rows), *table.value.shape[1:])
        # In units of the root of the second moment without bias correction.
        eps.append(EPS * (1 - table._pace.beta2 ** max(table.steps, 1)) ** 0.5)
        jobs.append(table._job(rows, copies))
        found.append(copies.requires_grad_())
        table.fetched = rows, copies
    _fetch(*_packed(jobs), np.array(eps, np.float32))
    return found


def step_together(rates: Sequence[tuple[RowAdam, float]]) -> None:
    """Do `RowAdam.step` for several tables, in one compiled call."""
    scalars, jobs, alive = [], [], []
    corrections = [table._corrections(rate) for table, rate in rates]
    for (table, _), (corrected, root) in zip(rates, corrections, strict=True):
        if table.fetched is not None and (found := table.fetched[1].grad) is not None:
            alive.append(found.contiguous())
            jobs.append(table._job(*table.fetched, alive[-1].data_ptr()))
            scalars.append(table._pace.scalars(corrected, root))
    if jobs:
        _update(*_packed(jobs), np.array(scalars, np.float32))
    for (table, _), correction in zip(rates, corrections, strict=True):
        table._count_step(*correction)


def _packed(jobs: Sequence[tuple[int, ...]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return jobs as rows, and the first task of each and the end of all."""
    tasks = [-(-job[_LENGTH] // CHUNK) for job in jobs]
    return np.array(jobs), np.array([0, *accumulate(tasks)])
