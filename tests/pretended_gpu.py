"""A CPU that pretends to be a GPU, so that tensors of two devices are not mixed unseen.

Tensors that are made on or moved to ``cuda`` are marked, and say that they are there. As on a GPU,
they have no array, and a function that is given marked and unmarked tensors fails. Backward passes
are not watched: autograd drops the marks.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

from chronoscene.training.checkpoint import load_tensors

ANSWERS = {  # of marked tensors, by the getters of properties
    Tensor.device.__get__: torch.device("cuda"),
    Tensor.is_cpu.__get__: False,
    Tensor.is_cuda.__get__: True,
}
MOVES = ("to", "cpu", "copy_", "__setitem__", "__get__")


class OnGpu(Tensor):
    """A marked tensor."""


def is_gpu(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def moved(x: Tensor, device: Any) -> Tensor:
    return x.as_subclass(OnGpu if is_gpu(device) else Tensor)


class PretendedGpu(TorchFunctionMode):
    """Context in which there seems to be a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.moves: list[str] = []
        """Copies between the devices, by the names of functions."""
        self._watches = True

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(function, "__name__", "")
        marked = bool(args) and isinstance(args[0], OnGpu)
        if marked and function in ANSWERS:
            return ANSWERS[function]
        if marked and function == Tensor.grad.__get__:
            grad = function(*args)
            return grad if grad is None else grad.as_subclass(OnGpu)
        if name == "cpu" or (name == "to" and self._names_a_device(args[1:], kwargs)):
            return self._move(name, args, kwargs)
        if name == "backward":
            self._watches = False
        elif self._watches and name not in MOVES:
            self._check(name, args, kwargs)
        made = is_gpu(kwargs.get("device"))
        if made:
            kwargs["device"] = "cpu"
        try:
            found = function(*args, **kwargs)
        finally:
            self._watches |= name == "backward"
        return found.as_subclass(OnGpu) if made else found

    @staticmethod
    def _names_a_device(args: Any, kwargs: Any) -> bool:
        kinds = str, torch.device, Tensor
        return "device" in kwargs or any(isinstance(a, kinds) for a in args)

    def _move(self, name: str, args: Any, kwargs: Any) -> Tensor:
        x, *rest = args
        target: Any = kwargs.get("device", "cpu" if name == "cpu" else rest[0])
        if isinstance(target, Tensor):
            rest.append(target.dtype)
            target = "cuda" if isinstance(target, OnGpu) else "cpu"
        if is_gpu(target) != isinstance(x, OnGpu):
            self.moves.append(name)
        dtypes = [a for a in rest if isinstance(a, torch.dtype)]
        plain = x.as_subclass(Tensor)
        return moved(plain.to(*dtypes) if dtypes else plain, target)

    @staticmethod
    def _check(name: str, args: Any, kwargs: Any) -> None:
        tensors = [a for a in tree_leaves((args, kwargs)) if isinstance(a, Tensor)]
        on_gpu = [isinstance(a, OnGpu) for a in tensors if a.dim()]  # scalars may be anywhere
        assert all(on_gpu) or not any(on_gpu), f"{name} mixes devices"
        assert name != "numpy" or not any(on_gpu), "a tensor on a GPU has no array"

    # In the place of functions of `chronoscene.training`.

    def load_tensors(self, folder: Path, *, device: str = "cpu", **options: Any) -> Any:
        tensors, meta = load_tensors(folder, **options)
        return {name: moved(tensor, device) for name, tensor in tensors.items()}, meta

    def to_device(self, array: Any, device: Any) -> Tensor:
        if is_gpu(device):
            self.moves.append("to_device")
        return moved(torch.from_numpy(array), device)

    def uniform(self, generator: np.random.Generator, shape: tuple[int, ...], like: Tensor) -> Any:
        return moved(torch.from_numpy(generator.random(shape, np.float32)), like.device)

    def integers(self, generator: np.random.Generator, high: int, count: int, like: Tensor) -> Any:
        return moved(torch.from_numpy(generator.integers(high, size=count)), like.device)
