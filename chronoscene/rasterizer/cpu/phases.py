# mypy: allow-untyped-defs
# Numba infers the types of kernels.
"""How workers share the jobs of a kernel, and wait for each other between its phases.

Each phase has a counter that jobs are drawn from and a counter of finished jobs. A worker waits
for jobs, not for workers: who comes late finds everything done and passes through.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from chronoscene.rasterizer.cpu.kernel import helper, inlined, kernel
from chronoscene.rasterizer.cpu.simd import fetch_add, load_shared

_STRIDE = 16  # numbers per phase, so that phases do not share cache lines
_FINISHED = 8
_PATIENCE = 64  # looks before the processor is offered to others

_CAN_YIELD = hasattr(os, "sched_yield")
_sched_yield = types.ExternalFunction("sched_yield", types.int32())


def new_control(phases: int = 1) -> NDArray[np.int64]:
    """Counters of a launch."""
    return np.zeros(phases * _STRIDE, np.int64)


@inlined
def draw(control: Any, phase: int) -> int:
    """Number of a job that nobody else has; as many as there are or more when all are taken."""
    return fetch_add(control, _STRIDE * phase, 1)


@inlined
def finish(control: Any, phase: int) -> None:
    """A drawn job is done."""
    fetch_add(control, _STRIDE * phase + _FINISHED, 1)


@helper
def wait_for(control, phase, jobs):
    """Until all jobs of a phase are done."""
    looks = 0
    while load_shared(control, _STRIDE * phase + _FINISHED) < jobs:
        looks += 1
        if _CAN_YIELD and looks % _PATIENCE == 0:
            _sched_yield()


@kernel
def look_for_change(shared, offset, value, looks):
    """Wait a while for a number to become another one. Returns whether it did."""
    for look in range(looks):
        if load_shared(shared, offset) != value:
            return True
        if _CAN_YIELD and look % _PATIENCE == _PATIENCE - 1:
            _sched_yield()
    return False
