"""One setting for the threads of torch and of the compiled kernels."""

from __future__ import annotations

import os


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
