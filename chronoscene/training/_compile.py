"""How the training kernels become machine code."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


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
    options = {**_OPTIONS, "parallel": parallel, **options}

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            dispatcher: Any = njit(cache=True, **options)(function)
        except RuntimeError:  # nowhere to keep it: compile in every process
            return njit(**options)(function)
        index: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if hasattr(index, "_source_stamp") and hasattr(index, "_load_index"):
            # Numba compares the age of one file, but a kernel consists of several.
            index._source_stamp = _stamp()
            index._load_index = _forgiving(index._load_index)
        return dispatcher

    return decorate


def _forgiving(load: Callable[[], dict[Any, Any]]) -> Callable[[], dict[Any, Any]]:
    """An index that cannot be read counts as empty: it may be damaged, or name types of an older
    version of this package."""

    def load_or_nothing() -> dict[Any, Any]:
        try:
            return load()
        except (
            AttributeError,
            EOFError,
            ImportError,
            pickle.UnpicklingError,
            TypeError,
            ValueError,
        ):
            return {}

    return load_or_nothing


@cache
def _stamp() -> str:
    """Changes with any source of a kernel."""
    sources = sorted(Path(__file__).parent.glob("_*.py"))
    return sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
