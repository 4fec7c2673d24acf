"""Decorators that compile Python functions to machine code.

`kernel` is for functions that Python calls, `inner` and `inlined` for those that only other
compiled functions call. All release Python's lock, and division by zero gives inf or nan.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any

from numba import njit

FAST_MATH = ("contract", "nsz", "arcp", "afn")
"""Rounding may differ from IEEE in the last place (fused multiply-add, reciprocals); infinities
and nan are kept, since comparisons with them decide what is culled."""

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_FOLDER = Path(__file__).parent
_UNREADABLE = (AttributeError, EOFError, ImportError, pickle.PickleError, TypeError, ValueError)


def inner(
    function: Callable[..., Any] | None = None, *, fast_math: bool = False, **options: Any
) -> Any:
    """Compile a function that only compiled code calls, which is faster without other entry points.

    Args:
        function: What to compile; without one, the decorator for these options is returned.
        fast_math: Whether scalar arithmetic may round as `FAST_MATH` says.
        options: Others of `numba.njit`.
    """
    if function is None:
        return lambda function: inner(function, fast_math=fast_math, **options)
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, **_njit_options(fast_math)}
    return njit(**options)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function with fast math and always inline it, so that vectors stay in registers."""
    return inner(function, fast_math=True, forceinline=True)


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    fast_math: bool = False,
    extras: Iterable[ModuleType] = (),
    **options: Any,
) -> Any:
    """Compile a function that Python calls, when it is first called, or load it from disk.

    Numba looks at the age of the function's own file alone. A kernel is compiled again when
    anything changes in the function's folder, in this package or in the extras. An index on disk
    that cannot be read, because it is damaged or names types of an older version of this package,
    counts as empty. Where nothing can be written, every process compiles.

    Args:
        function: What to compile; without one, the decorator for these options is returned.
        fast_math: Whether scalar arithmetic may round as `FAST_MATH` says.
        extras: Modules of other folders whose code or constants are compiled in.
        options: Others of `numba.njit`, such as ``parallel`` for a function with ``prange``.
    """
    if function is None:
        return lambda function: kernel(function, fast_math=fast_math, extras=extras, **options)
    options = {**_njit_options(fast_math), **options}
    try:
        dispatcher: Any = njit(cache=True, **options)(function)
    except RuntimeError:  # no folder that we may write to
        return njit(**options)(function)
    index: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if hasattr(index, "_source_stamp") and hasattr(index, "_load_index"):
        folder = Path(function.__code__.co_filename).parent
        index._source_stamp = source_stamp(folder, *(Path(str(e.__file__)) for e in extras))
        index._load_index = _forgiving(index._load_index)
    return dispatcher


def _njit_options(fast_math: bool) -> dict[str, Any]:
    return {**_OPTIONS, "fastmath": set(FAST_MATH)} if fast_math else _OPTIONS


@cache
def source_stamp(folder: Path, *files: Path) -> str:
    """Hash of some files, of the modules in a folder, and of those of this package."""
    modules = {*folder.glob("*.py"), *_FOLDER.glob("*.py"), *files}
    return sha256(b"".join(path.read_bytes() for path in sorted(modules))).hexdigest()


def _forgiving(load: Callable[[], dict[Any, Any]]) -> Callable[[], dict[Any, Any]]:
    """Make a loader of the index return an empty one instead of failing on an unreadable file."""

    def load_or_nothing() -> dict[Any, Any]:
        try:
            return load()
        except _UNREADABLE:
            return {}

    return load_or_nothing
