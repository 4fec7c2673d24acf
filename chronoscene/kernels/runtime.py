"""Resources of this machine (threads, memory, gsplat) and settings of the process."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from chronoscene.errors import BackendError

CONTAINER = Path("/sys/fs/cgroup")
"""Folder with the limits of the process's container on Linux (cgroup v2)."""

GSPLAT_ALPHA_MAX = {"1.5": 0.999, "1.6": 0.99}
"""Cap of alpha in the kernels of gsplat, by version. Others were not looked at and are refused."""

MOST_VIEWS = 4
"""Views of a step with ``views_per_step=auto``, at most."""

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
_KEPT_BYTES = 256 << 20


def available_threads() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def views_for_threads(threads: int) -> int:
    """Return the number of views of a training step with ``views_per_step=auto``.

    It is one view up to two threads, where more bring nothing, then a view for every two threads,
    and `MOST_VIEWS` at most: what more views save is less than what they cost in quality.
    """
    return 1 if threads <= 2 else min(threads // 2, MOST_VIEWS)


def machine_memory() -> tuple[int, int]:
    """Bytes of memory that this machine has, and that programs can still have.

    Both are within the limit of a container. What it keeps of files can be had like free memory.
    """
    import psutil

    machine = psutil.virtual_memory()
    total, free = machine.total, machine.available
    with suppress(OSError, ValueError):  # no container, or one without a limit, which is "max"
        limit = int((CONTAINER / "memory.max").read_text())
        used = int((CONTAINER / "memory.current").read_text())
        files = re.search(r"^inactive_file (\d+)", (CONTAINER / "memory.stat").read_text(), re.M)
        free = min(free, limit - used + (int(files[1]) if files else 0))
        total = min(total, limit)
    return total, free


@cache
def gsplat_release() -> str:
    """Major and minor version of the installed gsplat, which is not imported.

    Raises:
        BackendError: If there is none, or one that is not in `GSPLAT_ALPHA_MAX`.
    """
    try:
        found = version("gsplat")
    except PackageNotFoundError:
        found = "none"
    if (short := ".".join(found.split(".")[:2])) in GSPLAT_ALPHA_MAX:
        return short
    raise BackendError(
        "gsplat",
        expected=f"version {' or '.join(GSPLAT_ALPHA_MAX)}",
        found=found,
        todo="pip install 'chronoscene[cuda]', or use the CPU; it compiles its kernels when it is "
        "first used, with nvcc of the CUDA toolkit",
    )


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
    """Keep freed memory for the next request, up to 256 MB at its end. Only glibc can.

    A training step allocates the same memory as the one before it, tens to hundreds of megabytes.
    By default glibc returns large blocks to the system, which clears every page anew: measured at
    2 ms of a step of 26 ms, and at a tenth to a quarter where photos or models are large.

    Returns:
        Whether the C library has taken the setting.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another C library
        return False
    # No block of its own for what is large: the threshold for that cannot be above 32 MB.
    return bool(mallopt(_M_MMAP_MAX, 0) and mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES))


def check_device(device: str, *, gsplat: bool = True) -> None:
    """Check on the machine that will train that it has the device.

    Args:
        device: ``cpu``, ``cuda`` or ``auto``.
        gsplat: Whether a GPU needs the package.

    Raises:
        BackendError: If a GPU is asked for that is not there, or its kernels are not.
    """
    if device != "cuda":
        return
    import torch

    if not torch.cuda.is_available():
        raise BackendError(
            "--device cuda",
            expected="a CUDA device and a torch build for it",
            found=f"torch {torch.__version__} without one",
            todo="use --device cpu",
        )
    if gsplat:
        gsplat_release()
