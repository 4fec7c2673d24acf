"""Adam for parameters whose rows come and go, and for tables of which a step reads some rows."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numba import prange
from numpy import float32
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.memory import floats_at
from chronoscene.training import devices

BETA1 = 0.9
BETA2 = 0.999
EPS = 1e-15  # Added to the root of the second moment, as in 3DGS

BLOCK = 16384
"""Elements per task. Fixed, so that vector bodies and remainders fall on the same elements, and
results are equal bit by bit, for any number of threads."""

# Moments below these are zero for every practical purpose: the update that they cause is under
# 1e-18 of a learning rate. Left to decay they end up as denormals, which are slow on many CPUs.
TINY_MEAN = float32(1e-34)
TINY_SQUARE = float32(1e-37)


@dataclass(frozen=True, slots=True)
class Pace:
    """Scale of learning rates and moments in a step from the sum of several gradients.

    A step of n views shall move the model about as far as n steps of one view do. If gradients of
    different views are independent, that takes the rate times sqrt(n), as Adam divides by the root
    of a sum of n squares, and moments that fade as in n steps. The number 1 changes nothing.

    Source: Zhao et al. 2024 (Grendel), "On Scaling Up 3D Gaussian Splatting Training".
    """

    views: int = 1
    """n: number of views of a step."""

    @property
    def rate(self) -> float:
        """Factor of all learning rates."""
        return self.views**0.5

    @property
    def beta1(self) -> float:
        """Share of the first moment that a step leaves."""
        return BETA1**self.views

    @property
    def beta2(self) -> float:
        """Share of the second moment that a step leaves."""
        return BETA2**self.views

    def scalars(self, rate: float, root: float) -> tuple[float, ...]:
        """Return `SCALARS` numbers for a step; arguments as in `adam_block`."""
        # Rounded once: 1 - float32(0.999) would be off by 5e-5.
        return rate, root, EPS, 1 - self.beta1, self.beta2, 1 - self.beta2


ONE_VIEW = Pace()
SCALARS = 6
"""Numbers of a step: rate, root, eps, and by what moments change; see `adam_block`."""


@dataclass(slots=True, eq=False)
class _Moments:
    """State of one parameter, as torch keeps it."""

    mean: Tensor
    square: Tensor
    steps: int = 0


class Update(NamedTuple):
    """One step of Adam that is to be done for one tensor; see `adam_block`."""

    value: Tensor
    """Contiguous."""
    grad: Tensor
    moments: _Moments
    rate: float
    root: float
    pace: Pace = ONE_VIEW


class Adam:
    """Adam over named tensors, with a learning rate per tensor and step.

    The same update as `torch.optim.Adam`, fused into one pass over memory, with equal bits for any
    number of threads. Rows of a parameter can be added and removed; its step count then stays, as
    in 3DGS.

    Args:
        params: Contiguous leaf tensors that require a gradient.
        pace: By how many views the gradients of a step are.
    """

    def __init__(self, params: Mapping[str, Tensor], pace: Pace = ONE_VIEW) -> None:
        self._pace = pace
        self.params: dict[str, Tensor] = {}
        self._moments: dict[str, _Moments] = {}
        for name, value in params.items():
            if not (value.is_leaf and value.requires_grad and value.is_contiguous()):
                raise ShapeError(
                    f"parameter {name}",
                    expected="a contiguous leaf tensor that requires a gradient",
                    found=f"leaf {value.is_leaf}, requires_grad {value.requires_grad}, "
                    f"contiguous {value.is_contiguous()}",
                    todo="pass value.detach().clone().requires_grad_()",
                )
            self.params[name] = value
            self._moments[name] = _Moments(torch.zeros_like(value), torch.zeros_like(value))

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for value in self.params.values():
            value.grad = None

    def gradients(self) -> dict[str, Tensor]:
        """Return all gradients that there are, by the names of their parameters."""
        return {n: value.grad for n, value in self.params.items() if value.grad is not None}

    def step(self, lrs: Mapping[str, float], skip: Collection[str] = ()) -> None:
        """Update every parameter that has a gradient.

        Args:
            lrs: Learning rate of each parameter.
            skip: Names of parameters to leave alone, with their moments and step counts.
        """
        apply_updates(self.updates(lrs, skip))

    def updates(self, lrs: Mapping[str, float], skip: Collection[str] = ()) -> list[Update]:
        """Count a step and return what `apply_updates` has to do for it; arguments as `step`."""
        found = []
        for name, value in self.params.items():
            if value.grad is None or name in skip:
                continue
            moments = self._moments[name]
            moments.steps += 1
            pace = self._pace
            rate = pace.rate * lrs[name] / (1 - pace.beta1**moments.steps)
            root = (1 - pace.beta2**moments.steps) ** -0.5
            found.append(Update(value, value.grad, moments, rate, root, pace))
        return found

    def extend(self, name: str, new_rows: Tensor) -> Tensor:
        """Append rows [n, ...] with zero moments; return the new leaf, which has no gradient."""
        value = self.params[name]
        check_shape(f"new rows of {name}", new_rows, (None, *value.shape[1:]))
        moments = self._moments[name]
        zeros = torch.zeros_like(new_rows, dtype=value.dtype)
        moments.mean = torch.cat((moments.mean, zeros))
        moments.square = torch.cat((moments.square, zeros))
        return self._replace(name, torch.cat((value.detach(), new_rows.detach().to(value.dtype))))

    def keep(self, name: str, mask: Tensor) -> Tensor:
        """Keep the rows of a mask, bool [rows]; return the new leaf, which has no gradient."""
        value = self.params[name]
        check_shape(f"mask of {name}", mask, (value.shape[0],))
        moments = self._moments[name]
        moments.mean, moments.square = moments.mean[mask], moments.square[mask]
        return self._replace(name, value.detach()[mask])

    def reset_moments(self, name: str) -> None:
        """Zero both moments of a parameter; its step count stays."""
        self._moments[name].mean.zero_()
        self._moments[name].square.zero_()

    def state(self) -> dict[str, Tensor]:
        """Return moments and step counts by name, for a checkpoint."""
        state: dict[str, Tensor] = {}
        for name, moments in self._moments.items():
            state[f"{name}.mean"] = moments.mean
            state[f"{name}.square"] = moments.square
            state[f"{name}.steps"] = torch.tensor(moments.steps)
        return state

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state` gave, for parameters of the same names and shapes."""
        for name, value in self.params.items():
            for part in ("mean", "square"):
                check_shape(f"{name}.{part}", state[f"{name}.{part}"], tuple(value.shape))
            self._moments[name] = _Moments(
                state[f"{name}.mean"].to(value, copy=True),
                state[f"{name}.square"].to(value, copy=True),
                int(state[f"{name}.steps"]),
            )

    def _replace(self, name: str, value: Tensor) -> Tensor:
        self.params[name] = value.requires_grad_()
        return self.params[name]


@torch.no_grad()
def apply_updates(updates: Iterable[Update]) -> None:
    """Do updates, of any number of tensors in one compiled call."""
    compiled, on_gpu = [], []
    for update in updates:
        if devices.has_kernels(update.value):
            compiled.append(update._replace(grad=update.grad.contiguous()))
        elif update.value.is_cuda and update.value.dtype is torch.float32:
            on_gpu.append(update)
        else:
            _step_torch(*update)
    step_fused(on_gpu)
    if not compiled:
        return
    addresses = np.array(
        [
            (value.data_ptr(), grad.data_ptr(), m.mean.data_ptr(), m.square.data_ptr())
            for value, grad, m, *_ in compiled
        ]
    )
    scalars = np.array([u.pace.scalars(u.rate, u.root) for u in compiled], dtype=np.float32)
    sizes = np.array([u.value.numel() for u in compiled])
    # Starting the threads costs more than a small update.
    run = adam_tensors if sizes.max() > BLOCK else adam_tensors_alone
    # A warm-up has small updates alone, and is to compile what the training needs.
    if not adam_tensors.signatures:
        adam_tensors(addresses[:0], _block_starts(sizes[:0]), sizes[:0], scalars[:0])
    run(addresses, _block_starts(sizes), sizes, scalars)


def step_fused(updates: Iterable[Update]) -> None:
    """Do updates of float32 tensors by torch's fused Adam, one call for each learning rate.

    It knows the corrections of the bias from the number of the step. Ours are in the rate, and the
    step is one after which there is nothing to correct.
    """
    groups = defaultdict[tuple[float, ...], list[Update]](list)
    for update in updates:
        if update.value.numel():
            rate, root, pace = update.rate, update.root, update.pace
            numbers = (rate / root, EPS / root, pace.beta1, pace.beta2)
            groups[numbers].append(update)
    for (rate, eps, beta1, beta2), group in groups.items():
        values, grads, moments, *_ = zip(*group, strict=True)
        torch._fused_adam_(
            values,
            [grad.contiguous() for grad in grads],
            [m.mean for m in moments],
            [m.square for m in moments],
            [],
            [_endless(values[0].device)] * len(group),
            lr=rate,
            beta1=beta1,
            beta2=beta2,
            weight_decay=0.0,
            eps=eps,
            amsgrad=False,
            maximize=False,
        )


@cache
def _endless(device: torch.device) -> Tensor:
    """Number of a step so late that no moment has a bias."""
    return torch.tensor(1e9, device=device)


def _block_starts(sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of the first block of each array, and of all blocks at the end. [n + 1]"""
    starts = np.zeros(len(sizes) + 1, np.int64)
    np.cumsum((sizes + BLOCK - 1) // BLOCK, out=starts[1:])
    return starts


def _step_torch(
    value: Tensor, grad: Tensor, moments: _Moments, rate: float, root: float, pace: Pace
) -> None:
    moments.mean.lerp_(grad, 1 - pace.beta1)
    moments.square.mul_(pace.beta2).addcmul_(grad, grad, value=1 - pace.beta2)
    value.addcdiv_(moments.mean, (moments.square.sqrt() * root).add_(EPS), value=-rate)


@kernel(fastmath={"contract", "nsz", "arcp"})
def adam_block(values, grads, means, squares, scalars):  # type: ignore[no-untyped-def]
    """Update a flat array in place (Kingma and Ba 2015, algorithm 1).

    mean += gain1 (grad - mean);  square = keep2 square + gain2 grad²;
    value -= rate * mean / (sqrt(square) * root + eps).

    Args:
        scalars: rate, the learning rate over the bias correction of the first moment; root, 1 over
            the root of the bias correction of the second moment; eps; gain1 = 1 - beta1,
            keep2 = beta2 and gain2 = 1 - beta2. [SCALARS]
    """
    zero = float32(0)
    rate, root, eps = scalars[0], scalars[1], scalars[2]
    gain1, keep2, gain2 = scalars[3], scalars[4], scalars[5]
    for i in range(values.shape[0]):
        grad = grads[i]
        mean = means[i] + gain1 * (grad - means[i])
        square = keep2 * squares[i] + gain2 * grad * grad
        mean = zero if abs(mean) < TINY_MEAN else mean
        square = zero if square < TINY_SQUARE else square
        values[i] -= rate * mean / (math.sqrt(square) * root + eps)
        means[i] = mean
        squares[i] = square


@inner
def _adam_of_block(addresses, starts, sizes, scalars, block):  # type: ignore[no-untyped-def]
    n = np.searchsorted(starts, block, side="right") - 1
    first = (block - starts[n]) * BLOCK
    count, move = min(BLOCK, sizes[n] - first), 4 * first
    value, grad = floats_at(addresses[n, 0] + move, count), floats_at(addresses[n, 1] + move, count)
    mean, square = (
        floats_at(addresses[n, 2] + move, count),
        floats_at(addresses[n, 3] + move, count),
    )
    adam_block(value, grad, mean, square, scalars[n])


@kernel(parallel=True)
def adam_tensors(addresses, starts, sizes, scalars):  # type: ignore[no-untyped-def]
    """Update flat arrays in place, their blocks spread over the threads.

    Args:
        addresses: Of values, gradients, means and squares of each array. int64 [n, 4]
        starts: Number of the first block of each array, and of all blocks at the end. [n + 1]
        sizes: Elements of each. int64 [n]
        scalars: Of each, as in `adam_block`. float32 [n, SCALARS]
    """
    for block in prange(starts[-1]):
        _adam_of_block(addresses, starts, sizes, scalars, block)


@kernel
def adam_tensors_alone(addresses, starts, sizes, scalars):  # type: ignore[no-untyped-def]
    """Do what `adam_tensors` does on one thread."""
    for block in range(starts[-1]):
        _adam_of_block(addresses, starts, sizes, scalars, block)


@torch.no_grad()
def all_finite(tensors: Sequence[Tensor]) -> Tensor:
    """Return True if no number is nan or infinite; far cheaper than an update of the same size.

    Returns:
        A scalar on the device of the tensors. bool
    """
    tensors = [tensor for tensor in tensors if tensor.numel()]
    if not tensors:
        return torch.tensor(True)
    if not devices.has_kernels(*tensors):
        # The largest magnitude is nan if any number is.
        return torch.nn.utils.get_total_norm(tensors, norm_type=math.inf).isfinite()
    tensors = [tensor.contiguous() for tensor in tensors]
    sizes = np.array([tensor.numel() for tensor in tensors])
    starts = _block_starts(sizes)
    finite = np.empty(starts[-1], np.bool_)
    _finite_blocks(np.array([t.data_ptr() for t in tensors]), starts, sizes, finite)
    return torch.tensor(bool(finite.all()))


@kernel(parallel=True)
def _finite_blocks(addresses, starts, sizes, finite):  # type: ignore[no-untyped-def]
    """Tell for each block of flat arrays whether it is finite; arguments as of `adam_tensors`."""
    for block in prange(starts[-1]):
        n = np.searchsorted(starts, block, side="right") - 1
        first = (block - starts[n]) * BLOCK
        numbers = floats_at(addresses[n] + 4 * first, min(BLOCK, sizes[n] - first))
        finite[block] = _is_finite(numbers)


@inner
def _is_finite(numbers):  # type: ignore[no-untyped-def]
    """Return True if no exponent is that of nan and infinity."""
    bits, worst = numbers.view(np.int32), np.int32(0)
    for i in range(bits.shape[0]):
        worst = max(worst, bits[i] & np.int32(0x7FFFFFFF))
    return worst < np.int32(0x7F800000)


class DenseTable:
    """A trained tensor with one row per anchor, of which a step reads some rows. [R, ...]

    The usual `Adam`, which moves every row in every step.

    Args:
        value: The table. [R, ...]
        pace: As of `Adam`.
    """

    def __init__(self, value: Tensor, pace: Pace = ONE_VIEW) -> None:
        self._pace = pace
        self._adam = Adam({"table": value.detach().requires_grad_()}, pace)
        self.fetched: tuple[Tensor, Tensor] | None = None
        """Rows, and their copies of which `step` uses the gradient; may be set."""

    @property
    def value(self) -> Tensor:
        """Table; up to date after `flush`."""
        return self._adam.params["table"].detach()

    def gradient(self) -> Tensor | None:
        """Return the gradient that `step` will use, if there is one."""
        return None if self.fetched is None else self.fetched[1].grad

    def fetch(self, rows: Tensor) -> Tensor:
        """Copy some rows, up to date, as a leaf that collects a gradient. [M, ...]

        `step` uses the gradient of the last copies. The table is left as it is. Several threads may
        fetch at a time.

        Args:
            rows: Each at most once. int64 [M]
        """
        leaf = self.value[rows].requires_grad_()  # on a GPU faster than index_select
        self.fetched = rows, leaf
        return leaf

    def step(self, rate: float) -> None:
        """Do one step with a learning rate; rows that were not fetched have the gradient zero."""
        apply_updates(self.updates(rate))

    def updates(self, rate: float) -> list[Update]:
        """Count a step and return what `apply_updates` has to do for it."""
        grad = torch.zeros_like(self.value)
        if self.fetched is not None and (found := self.fetched[1].grad) is not None:
            grad[self.fetched[0]] = found
        self.fetched = None
        self._adam.params["table"].grad = grad
        updates = self._adam.updates({"table": rate})
        self._adam.zero_grad()
        return updates

    def flush(self) -> Tensor:
        """Bring all rows up to date; return the table."""
        return self.value

    def snapshot(self) -> Tensor:
        """Return what `flush` would, perhaps a copy, and change nothing.

        Later steps round as if it had not been called.
        """
        return self.value

    def state(self) -> dict[str, Tensor]:
        """Return everything that later steps depend on, by name."""
        return {"value": self.value, **self._adam.state()}

    def load_state(self, state: Mapping[str, Tensor]) -> Tensor:
        """Restore what `state` gave, with any number of rows; return the table."""
        self.fetched = None
        value = state["value"].to(self.value, copy=True).requires_grad_()
        self._adam = Adam({"table": value}, self._pace)
        self._adam.load_state(state)
        return self.value

    def extend(self, new_rows: Tensor) -> Tensor:
        """Append rows with zero moments; return the table. [n, ...]"""
        self.fetched = None
        return self._adam.extend("table", new_rows).detach()

    def keep(self, mask: Tensor) -> Tensor:
        """Keep the rows of a mask; return the table. bool [R]"""
        self.fetched = None
        return self._adam.keep("table", mask).detach()
