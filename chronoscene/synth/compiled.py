"""How the shader becomes machine code: one place for Numba's options."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import njit

SOURCES = "compiled light noise probes shade tables texture_ground texture_walls textures"
"""Modules with compiled code."""


def inner(function: Callable[..., Any]) -> Any:
    """A function that only compiled code calls; it has no wrapper for Python, so that it compiles
    sooner."""
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(**options)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """A function that Python calls: parallel, and kept on disk between processes."""
    try:
        dispatcher: Any = njit(cache=True, parallel=True)(function)
    except RuntimeError:  # nowhere to keep it: it is compiled in every process
        return njit(parallel=True)(function)
    index: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if hasattr(index, "_source_stamp"):
        # Numba looks at the age of the kernel's own file; its textures are in others.
        index._source_stamp = _stamp()
    return dispatcher


@cache
def _stamp() -> str:
    """Changes with any module that takes part."""
    folder = Path(__file__).parent
    texts = [(folder / f"{name}.py").read_bytes() for name in SOURCES.split()]
    return sha256(b"".join(texts)).hexdigest()
