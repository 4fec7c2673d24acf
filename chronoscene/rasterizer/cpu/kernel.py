"""How functions become machine code: three decorators with one set of options."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from chronoscene.kernels import simd
from chronoscene.kernels.compilation import kept_on_disk

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "fastmath": set(simd.FLAGS),
    "error_model": "numpy",
}
_FOLDER = Path(__file__).parent
_SOURCES = (
    *sorted(_FOLDER.glob("*.py")),
    _FOLDER.parent / "constants.py",
    Path(simd.__file__),
)


def inlined(function: Callable[..., Any]) -> Any:
    """Part of a kernel that is always merged into its caller: vectors stay in registers."""
    return njit(forceinline=True, **_OPTIONS)(function)


def helper(function: Callable[..., Any]) -> Any:
    """Part of a kernel."""
    return njit(**_OPTIONS)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """What Python calls; kept on disk between processes."""
    return kept_on_disk(function, _SOURCES, **_OPTIONS)
