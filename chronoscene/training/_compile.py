"""How the training kernels become machine code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from chronoscene import simd
from chronoscene.compiled import kept_on_disk

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_SOURCES = (*sorted(Path(__file__).parent.glob("_*.py")), Path(simd.__file__))


def inner(function: Callable[..., Any]) -> Any:
    """A function that only compiled code calls; without other ways in it compiles faster."""
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(**_OPTIONS, **options)(function)


def kernel(*, parallel: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A function that Python calls, kept on disk between processes.

    Args:
        parallel: Whether it uses ``prange``.
        options: Others of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        return kept_on_disk(function, _SOURCES, **{**_OPTIONS, "parallel": parallel, **options})

    return decorate
