"""Adam for parameters whose rows come and go."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.training.adam_kernel import BETA1, BETA2, BLOCK, adam_block, adam_blocks


@dataclass(slots=True, eq=False)
class _Moments:
    """State of one parameter, as torch keeps it."""

    mean: Tensor
    square: Tensor
    steps: int = 0


class Adam:
    """Adam over named tensors, with a learning rate per tensor and step.

    The same update as `torch.optim.Adam`, fused into one pass over memory, with equal bits for any
    number of threads. Rows of a parameter can be added and removed; its step count then stays, as
    in 3DGS.

    Args:
        params: Contiguous leaf tensors that require a gradient.
        eps: Added to the root of the second moment.
    """

    def __init__(self, params: Mapping[str, Tensor], eps: float = 1e-15) -> None:
        self.params: dict[str, Tensor] = {}
        self.eps = eps
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

    @torch.no_grad()
    def step(self, lrs: Mapping[str, float], skip: Collection[str] = ()) -> None:
        """Update every parameter that has a gradient.

        Args:
            lrs: Learning rate of each parameter.
            skip: Names of parameters to leave alone, with their moments and step counts.
        """
        for name, value in self.params.items():
            if value.grad is None or name in skip:
                continue
            moments = self._moments[name]
            moments.steps += 1
            rate = lrs[name] / (1 - BETA1**moments.steps)
            root = (1 - BETA2**moments.steps) ** -0.5
            update = _step_compiled if _is_compiled(value) else _step_torch
            update(value, value.grad, moments, rate, root, self.eps)

    def extend(self, name: str, new_rows: Tensor) -> Tensor:
        """Append rows with zero moments; returns the parameter's new leaf, which has no gradient.

        Args:
            name: Parameter.
            new_rows: [n, ...]
        """
        value = self.params[name]
        check_shape(f"new rows of {name}", new_rows, (None, *value.shape[1:]))
        moments = self._moments[name]
        zeros = torch.zeros_like(new_rows, dtype=value.dtype)
        moments.mean = torch.cat((moments.mean, zeros))
        moments.square = torch.cat((moments.square, zeros))
        return self._replace(name, torch.cat((value.detach(), new_rows.detach().to(value.dtype))))

    def keep(self, name: str, mask: Tensor) -> Tensor:
        """Keep the rows where the mask holds; returns the new leaf, which has no gradient.

        Args:
            name: Parameter.
            mask: bool [rows]
        """
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
        """Moments and step counts by name, for a checkpoint that training resumes from."""
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


def _is_compiled(value: Tensor) -> bool:
    return value.device.type == "cpu" and value.dtype == torch.float32


def _step_compiled(
    value: Tensor, grad: Tensor, moments: _Moments, rate: float, root: float, eps: float
) -> None:
    arrays = [_flat(tensor) for tensor in (value, grad.contiguous(), moments.mean, moments.square)]
    scalars = [np.float32(number) for number in (rate, root, eps)]
    # Starting the threads costs more than a small update.
    kernel = adam_blocks if value.numel() > BLOCK else adam_block
    kernel(*arrays, *scalars)


def _flat(tensor: Tensor) -> NDArray[np.float32]:
    return tensor.detach().view(-1).numpy()


def _step_torch(
    value: Tensor, grad: Tensor, moments: _Moments, rate: float, root: float, eps: float
) -> None:
    moments.mean.lerp_(grad, 1 - BETA1)
    moments.square.mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    value.addcdiv_(moments.mean, (moments.square.sqrt() * root).add_(eps), value=-rate)
