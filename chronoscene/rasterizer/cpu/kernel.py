"""How functions become machine code: three decorators with one set of options."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import njit

from chronoscene.rasterizer.cpu.simd import FLAGS

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "fastmath": set(FLAGS),
    "error_model": "numpy",
}


def inlined(function: Callable[..., Any]) -> Any:
    """Part of a kernel that is always merged into its caller: vectors stay in registers."""
    return njit(forceinline=True, **_OPTIONS)(function)


def helper(function: Callable[..., Any]) -> Any:
    """Part of a kernel."""
    return njit(**_OPTIONS)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """What Python calls; kept on disk between processes."""
    try:
        dispatcher = njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no folder that we may write to: compile in every process
        return njit(**_OPTIONS)(function)
    # Numba looks at the age of one file only; a kernel is made of several.
    index: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if hasattr(index, "_source_stamp"):
        index._source_stamp = _stamp()
    return dispatcher


@cache
def _stamp() -> str:
    """Hash of everything that kernels are compiled from."""
    folder = Path(__file__).parent
    sources = [*sorted(folder.glob("*.py")), folder.parent / "constants.py"]
    return sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
