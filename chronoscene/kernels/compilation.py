"""Numba functions that are kept on disk between processes."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import njit


def kept_on_disk(function: Callable[..., Any], sources: Iterable[Path] = (), **options: Any) -> Any:
    """Compile a function with `numba.njit` when it is first called, or load it from disk.

    Numba looks at the age of the function's own file alone; a kernel of several files is compiled
    again when any of them changes. An index on disk that cannot be read, because it is damaged or
    names types of an older version of this package, counts as empty. Where nothing can be written,
    every process compiles.

    Args:
        function: What Python calls.
        sources: All files that it is compiled from; none if it is in one file.
        options: Those of `numba.njit`.
    """
    try:
        dispatcher: Any = njit(cache=True, **options)(function)
    except RuntimeError:  # no folder that we may write to
        return njit(**options)(function)
    index: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if hasattr(index, "_source_stamp") and hasattr(index, "_load_index"):
        paths = tuple(sources)
        if paths:
            index._source_stamp = source_stamp(paths)
        index._load_index = _forgiving(index._load_index)
    return dispatcher


def _forgiving(load: Callable[[], dict[Any, Any]]) -> Callable[[], dict[Any, Any]]:
    """Nothing instead of an error that an unreadable index causes."""

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
def source_stamp(sources: tuple[Path, ...]) -> str:
    """Changes with any of the files."""
    return sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
