"""Training a few steps on a made-up set before the clock starts.

Compiled kernels are compiled, or loaded from their cache, at first use; on the training clock that
would charge the first run of a method more than the next, and shorten a time budget.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.bench.training_loop import seed_everything
from chronoscene.methods import (
    Method,
    MethodSpec,
    TrainingSet,
    TrainingView,
    import_object,
)
from chronoscene.scene.geometry import Sim3, camera_centre

SIZE = 32
"""Pixels per axis of the made-up images."""
STEPS = 120
"""Enough for the first rounds of densification of the methods here."""
SECONDS = 3.0
"""Limit on the time for the steps after the first three."""


def warm_up(spec: MethodSpec, config: Any, *, num_periods: int, device: str) -> str | None:
    """Use a method once; returns why that went wrong, if it did."""
    try:
        seed_everything(0)
        method: Method = import_object(spec.method)(config)
        train = made_up_set(num_periods)
        method.setup(train, seed=0, device=device)
        started = time.perf_counter()
        for index in range(STEPS):
            method.step(index, index / STEPS)
            if index < 2:
                started = time.perf_counter()
            elif time.perf_counter() - started > SECONDS:
                break
        method.render(train.views[0], 0.0)
    except Exception as error:  # what is wrong shows in the run itself; here it only costs time
        return f"warm-up failed ({type(error).__name__}), compilation is on the training clock"
    return None


def made_up_set(num_periods: int) -> TrainingSet:
    """Noise seen by three cameras per period around a cloud of points."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3 * num_periods, SIZE, SIZE, 3), dtype=np.uint8)
    views = tuple(_view(i, i // 3) for i in range(len(images)))
    centres = camera_centre(np.stack([v.cam_from_world for v in views]))
    radius = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    count = 200
    return TrainingSet(
        views=views,
        num_periods=num_periods,
        points=rng.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (count, 3), dtype=np.uint8),
        point_periods=np.ones((count, num_periods), bool),
        training_from_world=Sim3.identity(),
        camera_extent=1.1 * radius,
        background=np.zeros(3, np.float32),
        load_image=lambda i: images[i],
    )


def _view(number: int, period: int) -> TrainingView:
    """A camera one and a half units from the origin, looking at it."""
    angle = 0.4 * number
    cosine, sine = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:3, :3] = [[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]]
    pose[2, 3] = 1.5
    K = np.array([[30.0, 0.0, SIZE / 2], [0.0, 30.0, SIZE / 2], [0.0, 0.0, 1.0]])
    return TrainingView(K, SIZE, SIZE, pose, f"{number}.png", period)


def forget_peak_memory() -> None:
    """Start the peak of resident memory anew, where the system can; compilers are greedy."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return
