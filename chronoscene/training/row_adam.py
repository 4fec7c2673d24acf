"""Adam for tables of which every step reads only some rows and columns.

A view sees a part of the anchors and needs the features of one period. Adam moves the others too:
their first moment decays over some dozen steps, and they follow it. Here they catch up when they
are next read, all steps at once, so a step costs what it reads, however large the model is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.training import row_adam_kernel as kernel
from chronoscene.training.adam_kernel import BETA1, BETA2
from chronoscene.training.optimizer import Adam

_HORIZON = 256
"""Steps after which a number that is not read no longer moves: what is left of its way is 2e-12 of
it."""
_RATIO = BETA1 / BETA2**0.5
_NAME = "table"


class Table(ABC):
    """A trained tensor with one row per anchor. [R, ...]"""

    value: Tensor
    """The table; up to date after `flush`."""

    @abstractmethod
    def fetch(self, rows: NDArray[np.int64], blocks: Sequence[int] = (0,)) -> Tensor:
        """Copies of some rows and blocks, up to date, as a leaf that collects a gradient.

        `step` uses that gradient; the copies of an earlier call are forgotten. The table is left as
        it is.

        Args:
            rows: Each at most once. [M]
            blocks: Their columns come one after the other.

        Returns:
            [M, ...], with the table's own shape of a row if there is one block.
        """

    @abstractmethod
    def step(self, rate: float) -> None:
        """One step with a learning rate; what was not fetched has the gradient zero."""

    @abstractmethod
    def flush(self) -> Tensor:
        """Bring all rows up to date; returns the table."""

    @abstractmethod
    def snapshot(self) -> Tensor:
        """What `flush` would return, perhaps a copy. Changes nothing: later steps round as if it
        had not been called."""

    @abstractmethod
    def extend(self, new_rows: Tensor) -> Tensor:
        """Append rows with zero moments; returns the table. [n, ...]"""

    @abstractmethod
    def keep(self, mask: Tensor) -> Tensor:
        """Keep the rows where the mask holds; returns the table. bool [R]"""


def make_table(value: Tensor, blocks: Sequence[int] | None, eps: float, *, lazy: bool) -> Table:
    """A `RowAdam` where its kernels run and it is asked for, else a `DenseTable`."""
    if lazy and value.device.type == "cpu" and value.dtype == torch.float32:
        return RowAdam(value, blocks, eps)
    return DenseTable(value, blocks, eps)


class DenseTable(Table):
    """The usual `Adam`, which moves every row in every step.

    Args:
        value: The table. [R, ...]
        blocks: Columns of each block; None for one block.
        eps: Added to the root of the second moment.
    """

    def __init__(
        self, value: Tensor, blocks: Sequence[int] | None = None, eps: float = 1e-15
    ) -> None:
        self._adam = Adam({_NAME: value.detach().requires_grad_()}, eps)
        self._blocks = blocks
        self._fetched: tuple[tuple[Tensor, ...], Tensor] | None = None

    @property
    def value(self) -> Tensor:  # type: ignore[override]
        return self._adam.params[_NAME].detach()

    def fetch(self, rows: NDArray[np.int64], blocks: Sequence[int] = (0,)) -> Tensor:
        cells: tuple[Tensor, ...] = (torch.from_numpy(rows).to(self.value.device),)
        if self._blocks is not None:
            columns = torch.arange(sum(self._blocks)).split(list(self._blocks))
            chosen = torch.cat([columns[block] for block in blocks]).to(self.value.device)
            cells = (cells[0][:, None], chosen)
        leaf = self.value[cells].requires_grad_()
        self._fetched = cells, leaf
        return leaf

    def step(self, rate: float) -> None:
        grad = torch.zeros_like(self.value)
        if self._fetched is not None and (found := self._fetched[1].grad) is not None:
            grad[self._fetched[0]] = found
        self._fetched = None
        self._adam.params[_NAME].grad = grad
        self._adam.step({_NAME: rate})
        self._adam.zero_grad()

    def flush(self) -> Tensor:
        return self.value

    def snapshot(self) -> Tensor:
        return self.value

    def extend(self, new_rows: Tensor) -> Tensor:
        self._fetched = None
        return self._adam.extend(_NAME, new_rows).detach()

    def keep(self, mask: Tensor) -> Tensor:
        self._fetched = None
        return self._adam.keep(_NAME, mask).detach()


class RowAdam(Table):
    """The update of `Adam`, without touching what is not read.

    With s steps done, a number that gets no gradient in the steps s + 1 .. t moves by

        (mean / sqrt(square)) sum_i rate_i root_i^-1 (BETA1 / sqrt(BETA2))^(i - s),

    where rate_i and root_i hold learning rate and bias corrections; the sum is the same for all
    numbers. That is Adam except for rounding, and for eps, which matters only to numbers whose
    gradients are near it. float32 on a CPU.

    Source: Kingma and Ba 2015 (Adam), algorithm 1; the sum is our derivation.

    Args:
        value: The table. [R, ...]
        blocks: Columns of the blocks that are read together or not at all; None for one block.
        eps: Added to the root of the second moment.
    """

    def __init__(
        self, value: Tensor, blocks: Sequence[int] | None = None, eps: float = 1e-15
    ) -> None:
        self.value = value.detach().contiguous()
        self.steps = 0
        self._columns = int(np.prod(value.shape[1:]))
        self._widths = np.array([self._columns] if blocks is None else blocks, np.int64)
        self._starts = np.cumsum(self._widths) - self._widths
        self._eps = eps
        self._mean, self._square = (torch.zeros_like(self.value) for _ in range(2))
        self._stamps = np.zeros((len(value), len(self._widths)), np.int64)
        self._speeds: list[float] = []
        """rate / root of each step."""
        self._ways = self._new_ways()
        self._settled = np.empty(_HORIZON, np.float32)
        """The whole way of what was last read at each step, known up to `_HORIZON` steps ago; the
        rest is spare room."""
        self._fetched: tuple[_Rows, Tensor] | None = None

    def fetch(self, rows: NDArray[np.int64], blocks: Sequence[int] = (0,)) -> Tensor:
        chosen = _Rows(np.ascontiguousarray(rows, np.int64), self._places(blocks))
        out = torch.empty(len(rows), chosen.columns)
        # In units of the root of the second moment without bias correction.
        eps = np.float32(self._eps * (1 - BETA2 ** max(self.steps, 1)) ** 0.5)
        kernel.fetch(*self._addresses(chosen), eps, out.data_ptr())
        if len(self._widths) == 1:
            out = out.view(len(rows), *self.value.shape[1:])
        leaf = out.requires_grad_()
        self._fetched = chosen, leaf
        return leaf

    def step(self, rate: float) -> None:
        root = (1 - BETA2 ** (self.steps + 1)) ** -0.5
        corrected = rate / (1 - BETA1 ** (self.steps + 1))
        if self._fetched is not None and (found := self._fetched[1].grad) is not None:
            chosen, copies = self._fetched
            grads = found.contiguous()
            scalars = (np.float32(corrected), np.float32(root), np.float32(self._eps))
            addresses = (copies.data_ptr(), grads.data_ptr())
            kernel.update(*self._addresses(chosen), *addresses, scalars)
        self._fetched = None
        self.steps += 1
        self._speeds.append(corrected / root)
        self._ways = self._new_ways()
        if self.steps >= _HORIZON:
            self._settle(self._ways[_HORIZON, 0])

    def flush(self) -> Tensor:
        self.value.copy_(self.snapshot())
        gaps = self.steps - self._stamps
        for moments, beta in ((self._mean, BETA1), (self._square, BETA2)):
            left = np.repeat((beta**gaps).astype(np.float32), self._widths, axis=1)
            moments.mul_(torch.from_numpy(left).view(moments.shape))
        self._stamps[:] = self.steps
        return self.value

    def snapshot(self) -> Tensor:
        if not (self._stamps < self.steps).any():
            return self.value
        fetched = self._fetched
        rows = np.arange(len(self.value), dtype=np.int64)
        copies = self.fetch(rows, range(len(self._widths))).detach()
        self._fetched = fetched
        return copies.view(self.value.shape)

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

    def _settle(self, way: np.float32) -> None:
        """Keep the way of what has waited `_HORIZON` steps now; twice the room where it is full."""
        stamp = self.steps - _HORIZON
        if stamp == len(self._settled):
            self._settled = np.concatenate([self._settled, np.empty_like(self._settled)])
        self._settled[stamp] = way

    def _mark_all(self) -> None:
        self._stamps = np.full((len(self.value), len(self._widths)), self.steps, np.int64)
        self._fetched = None

    def _places(self, blocks: Sequence[int]) -> NDArray[np.int64]:
        """(block, first column, columns, first column in the copy) of each. [b, 4]"""
        chosen = np.array(blocks, np.int64)
        widths = self._widths[chosen]
        return np.stack([chosen, self._starts[chosen], widths, np.cumsum(widths) - widths], axis=1)

    def _addresses(self, chosen: _Rows) -> tuple[kernel.Table, kernel.Part, int, int, int, int]:
        """The first arguments of both kernels."""
        tables = (self.value.data_ptr(), self._mean.data_ptr(), self._square.data_ptr())
        rows, places = chosen.rows, chosen.places
        ways, settled = self._ways, self._settled
        return (
            kernel.Table(*tables, self._columns, self._stamps.ctypes.data, len(self._widths)),
            kernel.Part(
                rows.ctypes.data, len(rows), places.ctypes.data, len(places), chosen.columns
            ),
            self.steps,
            ways.ctypes.data,
            len(ways) - 1,
            settled.ctypes.data,
        )

    def _new_ways(self) -> NDArray[np.float32]:
        """For a wait of 0, 1, .. steps up to now: the sum above, and what is left of the two
        moments. [G + 1, 3]"""
        speeds = np.array(self._speeds[-_HORIZON:])
        gaps = np.arange(len(speeds) + 1)
        powers = _RATIO ** gaps[1:]
        # Summed from the last and smallest term on, each in units of the first step after s.
        sums = np.cumsum((speeds * powers)[::-1]) / np.concatenate([[1.0], powers])[:-1][::-1]
        columns = (np.concatenate([[0.0], sums]), BETA1**gaps, BETA2**gaps)
        return np.stack(columns, axis=1).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """What a step reads of a table; see `row_adam_kernel.Part`."""

    rows: NDArray[np.int64]
    places: NDArray[np.int64]

    @property
    def columns(self) -> int:
        return int(self.places[:, 2].sum())
