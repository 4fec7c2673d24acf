"""Kernels kept on disk."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import torch
from chronoscene.training.adam_kernel import adam_block
from chronoscene.training.optimizer import Adam
value = torch.ones(40, requires_grad=True)
value.grad = torch.ones(40)
Adam({"x": value}).step({"x": 0.5})
print(float(value.sum()), sum(adam_block.stats.cache_hits.values()))
"""


def run(cache: Path) -> tuple[float, int]:
    """Result of a step, and how many kernels came from disk."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=True,
    )
    total, hits = done.stdout.split()
    return float(total), int(hits)


def test_kept_and_compiled_again_where_the_index_is_damaged(tmp_path: Path) -> None:
    assert run(tmp_path) == (20.0, 0)
    assert run(tmp_path) == (20.0, 1)
    indices = list(tmp_path.rglob("*.nbi"))
    assert indices
    for index in indices:
        data = index.read_bytes()
        index.write_bytes(data[: len(data) // 2])
    assert run(tmp_path) == (20.0, 0)
    assert run(tmp_path) == (20.0, 1)
