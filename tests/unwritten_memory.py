"""Memory that was allocated and never written, made visible."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import torch


@contextmanager
def filled_with_nan() -> Iterator[None]:
    """Fill arrays and tensors that Python code allocates: floats with nan, integers with -1.

    A result that is different, or not finite, was computed from what nobody had written.
    """

    def filling(allocate: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
        def filled(*args: Any, **options: Any) -> np.ndarray:
            found = allocate(*args, **options)
            if found.dtype.kind in "fiu":
                found.fill(np.nan if found.dtype.kind == "f" else np.array(-1).astype(found.dtype))
            return found

        return filled

    deterministic = torch.utils.deterministic
    before = torch.are_deterministic_algorithms_enabled(), deterministic.fill_uninitialized_memory
    with pytest.MonkeyPatch.context() as patch:
        for name in ("empty", "empty_like"):
            patch.setattr(np, name, filling(getattr(np, name)))
        torch.use_deterministic_algorithms(True, warn_only=True)
        deterministic.fill_uninitialized_memory = True
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(before[0])
            deterministic.fill_uninitialized_memory = before[1]
