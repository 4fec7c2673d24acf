"""How the training kernels become machine code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from chronoscene.kernels.compilation import kept_on_disk

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_PACKAGE = Path(__file__).parent.parent
_SOURCES = tuple(
    path
    for pattern in ("kernels/*.py", "anchors/decode/*.py", "training/*_kernel.py")
    for path in sorted(_PACKAGE.glob(pattern))
)


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
