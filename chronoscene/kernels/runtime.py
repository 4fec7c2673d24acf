"""Settings of a process that runs kernels: how many threads, and what becomes of freed memory."""

from __future__ import annotations

import ctypes
import os
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT_BYTES = 256 << 20
_MAX_MMAP_THRESHOLD = 32 << 20  # The largest that glibc accepts


def available_threads() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def set_threads(count: int | None = None) -> int:
    """Give torch and Numba the same number of threads and return it.

    Results do not depend on the number: every kernel on the training path reduces in a fixed order.

    Args:
        count: Threads to use, or None for all processors that the process may use.
    """
    import numba
    import torch

    count = min(count or available_threads(), numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    torch.set_num_threads(count)
    numba.set_num_threads(count)
    return count


def keep_freed_memory() -> bool:
    """Keep freed memory for the next request, up to 256 MB. Does nothing except with glibc.

    A training step allocates the same tens of megabytes as the one before it. By default glibc
    returns such blocks to the kernel, which clears every page anew: measured at about 2 ms of a
    step of 26 ms.

    Returns:
        Whether the C library has taken the setting.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another C library
        return False
    return bool(
        mallopt(_M_MMAP_THRESHOLD, _MAX_MMAP_THRESHOLD) and mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
    )
