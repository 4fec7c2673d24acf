"""Buffers of the kernels, kept between calls.

The first touch of fresh memory can cost more than rendering, so buffers only grow and are handed
from call to call. Nothing may rely on what an earlier call left in them.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

_GROWTH = 1.25
_KEPT = 4
_LINE = 64

_free: list[Workspace] = []
_lock = threading.Lock()


def aligned(size: int, dtype: type) -> NDArray[Any]:
    """Uninitialised array that begins on a cache line, so that no vector straddles two."""
    count = size * np.dtype(dtype).itemsize
    raw = np.empty(count + _LINE, np.uint8)
    start = -raw.ctypes.data % _LINE
    return raw[start : start + count].view(dtype)


class Workspace:
    """Named arrays of one rendering, forward and backward."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}
        self.pairs_per_gaussian = 3.0
        """Room for (Gaussian, tile) pairs; most Gaussians touch one or two tiles. It grows with
        need. Memory that is not used is not touched."""

    def array(self, name: str, size: int, dtype: type) -> NDArray[Any]:
        """Array of ``size`` elements with any content."""
        have = self._arrays.get(name)
        if have is None or have.size < size:
            capacity = size if have is None else max(size, int(have.size * _GROWTH))
            have = self._arrays[name] = aligned(capacity, dtype)
        return have[:size]


def acquire() -> Workspace:
    """A workspace that nobody uses."""
    with _lock:
        return _free.pop() if _free else Workspace()


def release(workspace: Workspace) -> None:
    """Give a workspace back for the next caller."""
    with _lock:
        if len(_free) < _KEPT:
            _free.append(workspace)


def clear() -> None:
    """Give the memory of unused workspaces back to the system."""
    with _lock:
        _free.clear()
