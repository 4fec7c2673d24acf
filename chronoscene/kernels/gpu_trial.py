"""A kernel that only shows that kernels can be compiled and run."""

from __future__ import annotations

import torch
import triton
import triton.language as tl


def run(device: str = "cuda") -> None:
    """Compile and run the kernel.

    Raises:
        RuntimeError: If its result is wrong; whatever Triton raises if it cannot compile or run.
    """
    numbers = torch.zeros(4, dtype=torch.int32, device=device)
    _count[(1,)](numbers, LENGTH=4)
    if numbers.tolist() != [0, 1, 2, 3]:
        raise RuntimeError(f"a kernel that counts to 3 wrote {numbers.tolist()}")


@triton.jit
def _count(numbers, LENGTH: tl.constexpr):  # type: ignore[no-untyped-def]
    i = tl.arange(0, LENGTH)
    tl.store(numbers + i, i)
