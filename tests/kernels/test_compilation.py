"""Kernels kept on disk."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from chronoscene.kernels.compilation import source_stamp
from chronoscene.rasterizer import constants
from chronoscene.rasterizer.cpu import composite
from chronoscene.synth.render import shade

SCRIPT = """
import torch
from chronoscene.training.optimizers.adam import Adam, adam_tensors_alone
value = torch.ones(40, requires_grad=True)
value.grad = torch.ones(40)
Adam({"x": value}).step({"x": 0.5})
print(float(value.sum()), sum(adam_tensors_alone.stats.cache_hits.values()))
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


@pytest.mark.slow
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


def test_a_kernel_is_compiled_again_when_a_source_changes(tmp_path: Path) -> None:
    """Sources are the kernel's folder, the package `kernels`, and what the kernel names."""
    (tmp_path / "a.py").write_text("A = 1")
    extra = tmp_path / "folder" / "extra.py"
    extra.parent.mkdir()
    extra.write_text("B = 1")
    stamps = []
    for path, text in ((None, ""), (tmp_path / "b.py", "C = 1"), (extra, "B = 2")):
        if path is not None:
            path.write_text(text)
        source_stamp.cache_clear()
        stamps.append(source_stamp(tmp_path, extra))
    assert len(set(stamps)) == 3


def test_kernels_know_their_sources() -> None:
    def stamp(kernel: Any) -> Any:
        return kernel._cache._cache_file._source_stamp

    room = Path(constants.__file__).parent
    assert stamp(composite.composite) == source_stamp(room / "cpu", room / "constants.py")
    assert stamp(shade.shade) == source_stamp(Path(shade.__file__).parent)
