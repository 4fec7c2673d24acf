"""How the shader becomes machine code: one place for Numba's options."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from chronoscene.kernels.compilation import kept_on_disk

NAMES = "compiled light noise probes shade geometry_tables texture_ground texture_walls textures"
"""Modules with compiled code."""

_SOURCES = tuple(Path(__file__).parent / f"{name}.py" for name in NAMES.split())


def inner(function: Callable[..., Any]) -> Any:
    """A function that only compiled code calls; it has no wrapper for Python, so that it compiles
    sooner."""
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(**options)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """A function that Python calls: parallel, and kept on disk between processes."""
    return kept_on_disk(function, _SOURCES, parallel=True)
