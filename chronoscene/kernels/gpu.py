"""Kernels for a GPU: whether Triton can compile them here."""

from __future__ import annotations

import warnings
from functools import cache
from importlib.util import find_spec


@cache
def has_triton() -> bool:
    """Return True if Triton is installed, as it is with torch for CUDA on Linux."""
    return find_spec("triton") is not None


@cache
def compiles() -> bool:
    """Return True if Triton compiles a kernel that runs on the GPU; tried once.

    It needs a C compiler and the headers of Python. Without them there is a warning, and plain
    torch takes the place of our kernels.
    """
    if not has_triton():
        return False
    try:
        from chronoscene.kernels.gpu_trial import run

        run()
    except Exception as error:  # of a compiler, a linker or a driver
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        warnings.warn(
            f"Triton cannot compile kernels for this GPU ({reason}). Plain torch takes their "
            "place, and up to twice the time. Install a C compiler and the headers of Python "
            "(apt install gcc python3-dev).",
            stacklevel=2,
        )
        return False
    return True
