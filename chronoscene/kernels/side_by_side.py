"""Calls of one function in several threads, which share the threads that kernels may use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba

from chronoscene.kernels.runtime import set_threads
from chronoscene.kernels.thread_pool import num_workers, spare_pools, use_pool

Item = TypeVar("Item")
Result = TypeVar("Result")

_SHARED = ("omp", "tbb")
"""Layers of Numba whose kernels several threads may call at a time."""


def side_by_side(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Call a function for each item, in as many threads as kernels may use.

    Python holds its lock between kernels, so that one thread at a time does what is not compiled.
    With one thread, or where Numba's kernels must not be called from several, the calls follow one
    another.

    Args:
        function: What to call. Its kernels have the bits that they have with any number of threads.
        items: Its arguments.

    Returns:
        What the calls returned, in the order of the items.
    """
    threads = num_workers()
    workers = min(threads, len(items))
    if workers < 2 or not _may_share():
        return [function(item) for item in items]

    pools = iter(spare_pools(workers))

    def begin() -> None:
        set_threads(threads // workers)  # of this thread
        use_pool(next(pools))

    with ThreadPoolExecutor(workers, initializer=begin) as executor:
        return list(executor.map(function, items))


def _may_share() -> bool:
    try:
        return numba.threading_layer() in _SHARED
    except ValueError:  # no kernel has run yet, so Numba has chosen none
        return False
