"""Warm-up of a method, so that the compilation of kernels is off the training clock."""

from __future__ import annotations

import time
from pathlib import Path

from numba.core.event import TimingListener, install_listener

from chronoscene.harness.train.loop import Clock, seed_everything
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import Method, MethodConfig, MethodSpec, make_method

WARM_UP_STEPS = 120  # Enough for the first rounds of densification of the methods here
WARM_UP_SECONDS = 3.0  # Limit on the time for the steps after the first two, but for compilation
LAST_STEPS = 3  # Taken where the time is over, so that the phases that follow are reached, too


def warm_up(
    spec: MethodSpec,
    config: MethodConfig,
    *,
    num_periods: int,
    device: str,
    now: Clock = time.perf_counter,
) -> str | None:
    """Train a few steps on painted balls and render once; return an error message or None.

    Kernels are compiled, or loaded from their cache, at first use. On the training clock that
    would charge the first run of a method more than the next, and shorten a time budget. Some are
    used late in a training only: a warm-up whose time is over hurries to the end of the schedule.
    """
    try:
        seed_everything(0)
        method = make_method(spec, config)
        train = make_training_set(num_periods)
        method.setup(train, seed=0, device=device)
        with install_listener("numba:compile", TimingListener()) as compiling:
            for index in range(WARM_UP_STEPS):
                method.step(index, index / WARM_UP_STEPS)
                stepping = now() - (compiling.duration if compiling.done else 0.0)
                if index < 2:
                    started = stepping
                elif stepping - started > WARM_UP_SECONDS:
                    _hurry(method, index)
                    break
        method.render(train.views[0], 0.0)
    except Exception as error:  # the run itself will report it; here it only costs time
        return f"warm-up failed ({type(error).__name__}), compilation is on the training clock"
    return None


def _hurry(method: Method, last: int) -> None:
    """Take few more steps, to the end of the schedule."""
    done, end = last / WARM_UP_STEPS, (WARM_UP_STEPS - 1) / WARM_UP_STEPS
    for step in range(1, min(LAST_STEPS, WARM_UP_STEPS - 1 - last) + 1):
        method.step(last + step, done + (end - done) * step / LAST_STEPS)


def forget_peak_memory() -> None:
    """Reset the peak of resident memory where the system can: compilers need much."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return
