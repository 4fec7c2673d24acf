"""Freed memory is kept: a process that allocates again touches no new pages."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
import numpy as np
from chronoscene.kernels.runtime import keep_freed_memory
if sys.argv[1] == "keep" and not keep_freed_memory():
    print(-1)
    sys.exit()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def touch():
    blocks = [np.ones(1_000_000) for _ in range(8)]  # 64 MB
touch()
before = faults()
touch()
print(faults() - before)
"""


def new_pages(mode: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, mode], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


def test_memory_is_kept() -> None:
    kept = new_pages("keep")
    if kept < 0:
        pytest.skip("the C library has no mallopt")
    default = new_pages("default")
    assert kept < 0.1 * default
