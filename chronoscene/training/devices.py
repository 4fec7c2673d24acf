"""Devices: compiled kernels on a CPU; on a GPU, for which the host need not wait, torch and Triton.

A copy from the host's ordinary memory, and every question to a tensor that Python wants to know
the answer of, makes the host wait until a GPU has done all that it was asked for before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.kernels import gpu


def has_kernels(*tensors: Tensor) -> bool:
    """Return True if compiled kernels can work on tensors: float32 on a CPU."""
    return all(t.is_cpu and t.dtype is torch.float32 for t in tensors)


def has_gpu_kernels(*tensors: Tensor) -> bool:
    """Return True if our kernels for a GPU can work on tensors: float32 there, and Triton."""
    return all(t.is_cuda and t.dtype is torch.float32 for t in tensors) and gpu.compiles()


def to_device(array: NDArray[np.generic], device: str | torch.device) -> Tensor:
    """Make a tensor of an array; a CPU shares its memory, a GPU gets a copy without waiting."""
    tensor = torch.from_numpy(array)
    if torch.device(device).type == "cpu":
        return tensor
    return tensor.pin_memory().to(device, non_blocking=True)


def array_of(tensor: Tensor) -> NDArray[Any]:
    """Return a tensor on a CPU as a contiguous array, which shares its memory where it can."""
    return tensor.detach().contiguous().numpy()


def flat(tensor: Tensor) -> NDArray[Any]:
    """Return `array_of` a tensor in one dimension."""
    return array_of(tensor).reshape(-1)


def uniform(generator: np.random.Generator, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Draw random numbers 0..1 on the device of a tensor. float32"""
    if like.is_cuda:
        return torch.rand(shape, generator=_on_gpu(generator, like), device=like.device)
    return torch.from_numpy(generator.random(shape, np.float32))


def integers(generator: np.random.Generator, high: int, count: int, like: Tensor) -> Tensor:
    """Draw random numbers 0..high - 1 on the device of a tensor. int64 [count]"""
    if like.is_cuda:
        drawn = _on_gpu(generator, like)
        return torch.randint(high, (count,), generator=drawn, device=like.device)
    return torch.from_numpy(generator.integers(high, size=count))


def normal(generator: np.random.Generator, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Draw normal random numbers on the device of a tensor. float64"""
    if like.is_cuda:
        drawn = _on_gpu(generator, like)
        return torch.randn(shape, generator=drawn, device=like.device, dtype=torch.float64)
    return torch.from_numpy(generator.standard_normal(shape))


def _on_gpu(generator: np.random.Generator, like: Tensor) -> torch.Generator:
    """Make a generator on the device of a tensor, seeded by the given one."""
    return torch.Generator(like.device).manual_seed(int(generator.integers(2**63)))


def exp(x: Tensor) -> Tensor:
    """Compute ``torch.exp`` without a gradient, with equal bits for any number of threads."""
    # Torch may take another code path at the end of each thread's share of the rows; NumPy makes
    # one pass.
    if x.is_cuda:
        return x.exp()
    with np.errstate(over="ignore"):
        return torch.from_numpy(np.exp(x.contiguous().numpy()))


class _CappedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, limit: float) -> Tensor:
        y = exp(x.detach().clamp(max=limit))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (y,) = ctx.saved_tensors
        return grads[0] * y, None


def capped_exp(x: Tensor, limit: float) -> Tensor:
    """Compute ``exp`` up to a limit of the exponent, beyond which value and slope stay as there.

    Differentiable; bits are those of `exp`.
    """
    return _CappedExp.apply(x, limit)
