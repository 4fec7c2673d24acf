"""How the C library of this process deals with memory that was freed."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT = 256 << 20
_LARGEST = 32 << 20
"""The largest threshold that glibc accepts."""


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
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST) and mallopt(_M_TRIM_THRESHOLD, _KEPT))
