"""Resources that a process finds on its machine, and freed memory, which is kept."""

from __future__ import annotations

import psutil
import pytest
from fresh_process import run_python

from chronoscene.kernels import runtime

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
    blocks.append(np.ones(12_000_000))  # 96 MB at once
touch()
before = faults()
touch()
print(faults() - before)
"""


def new_pages(mode: str) -> int:
    return int(run_python(PROGRAM, mode))


def test_memory_is_kept() -> None:
    kept = new_pages("keep")
    if kept < 0:
        pytest.skip("the C library has no mallopt")
    default = new_pages("default")
    assert kept < 0.1 * default


def test_memory_is_that_of_the_machine_within_the_limit_of_a_container(monkeypatch, tmp_path):
    monkeypatch.setattr(runtime, "CONTAINER", tmp_path)
    machine = psutil.virtual_memory().total
    total, free = runtime.machine_memory()
    assert total == machine and 0 < free < total
    (tmp_path / "memory.max").write_text("max\n")
    assert runtime.machine_memory()[0] == machine
    (tmp_path / "memory.max").write_text("90000000\n")
    (tmp_path / "memory.current").write_text("70000000\n")
    (tmp_path / "memory.stat").write_text("anon 20000000\nfile 30000000\ninactive_file 10000000\n")
    assert runtime.machine_memory() == (90_000_000, 30_000_000)
