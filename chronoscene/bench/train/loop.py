"""The training loop, owned by the harness: seeds, clock, stop, probes."""

from __future__ import annotations

import math
import random
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.bench.files.predictions import to_bytes
from chronoscene.bench.files.records import CurvePoint
from chronoscene.bench.plan.parts import Part
from chronoscene.bench.plan.stop import StopRule
from chronoscene.bench.train.checkpoints import Checkpoints, LoopState
from chronoscene.bench.train.checks import check_prediction, check_size, check_step
from chronoscene.errors import ChronoSceneError
from chronoscene.methods import (
    Method,
    MethodSpec,
    Prediction,
    StepReport,
    TrainingSet,
    TrainingView,
    import_object,
)
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import Sim3

PROBE_SHARES = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
"""Shares of the training at which the probe views are rendered."""


NOT_FINITE_LIMIT = 50
"""Steps in a row without a finite loss and finite gradients that end a training."""

Clock = Callable[[], float]
"""Seconds from some moment on."""


class TrainingError(ChronoSceneError):
    """A training that cannot continue, since numbers are not finite."""


class DivergedError(TrainingError):
    """`NOT_FINITE_LIMIT` steps in a row were skipped; the model is as it was before them."""


class Stopwatch:
    """Adds up the time spent inside ``with``: training runs inside, evaluation outside."""

    def __init__(self, now: Clock = time.perf_counter) -> None:
        self.seconds = 0.0
        self._now = now
        self._started = 0.0

    def __enter__(self) -> Stopwatch:
        self._started = self._now()
        return self

    def __exit__(self, *error: object) -> None:
        self.seconds += self._now() - self._started


Truth = Mapping[str, tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]
"""Photos by name with what counts of them, None for everything; those of which nothing counts are
left out. [H, W, 3], [H, W]"""

Observer = Callable[[int, float, StepReport, float | None], None]
"""Called after each step with the number of iterations done, the seconds on the training clock,
the step's report and the latest probe PSNR."""


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, numpy and torch."""
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def probe_frames(part: Part) -> tuple[Frame, ...]:
    """The probe views of a model: the middle test view of each of its periods, in name order."""
    by_period: dict[int, list[Frame]] = {}
    for frame in part.test:
        by_period.setdefault(frame.period, []).append(frame)
    return tuple(frames[len(frames) // 2] for _, frames in sorted(by_period.items()))


def train(
    method: Method,
    part: Part,
    stop: StopRule,
    truth: Truth,
    *,
    seed: int,
    device: str,
    observer: Observer,
    now: Clock = time.perf_counter,
    checkpoints: Checkpoints | None = None,
) -> LoopState:
    """Train a model, or a stage of it. Probes, checkpoints, the observer and waits for photos are
    off the clock.

    Args:
        method: An empty method; at a later stage, that of the stage before.
        part: What to train on and what to probe.
        stop: When to end.
        truth: Ground truth of the probe views.
        seed: For the global generators and the method.
        device: ``cpu`` or ``cuda``.
        observer: Shows the progress.
        now: The clock.
        checkpoints: Where to go on from, and to keep what is done; None for a method that cannot
            be resumed.

    Raises:
        DivergedError: If the method skipped too many steps in a row.
        TrainingError: If it took as many with a loss that is not finite, or if no view shows
            anything of the model any more.
        CheckpointError: If all checkpoints are damaged.
        MethodError: If the method returns something that it should not.
    """
    seed_everything(seed)
    clock, waiting = Stopwatch(now), Stopwatch(lambda: part.store.waited)
    with clock, waiting:
        if part.extends:
            method.extend(part.train)
        else:
            method.setup(part.train, seed=seed, device=device)
    seconds = clock.seconds - waiting.seconds
    state = LoopState(seconds=seconds, setup_seconds=seconds, waited_seconds=waiting.seconds)
    if checkpoints is not None and (restored := checkpoints.restore(method)) is not None:
        state, waiting.seconds = restored, restored.waited_seconds
        clock.seconds = state.seconds + state.waited_seconds
    done = stop.progress(state.iterations, state.seconds)
    due = [share for share in PROBE_SHARES if share > done]
    last_good = state.iterations
    # Losses of the latest steps, if those were empty. Views come once per pass, so two passes
    # without the last draw contain all of them.
    unseen = deque[float](maxlen=max(NOT_FINITE_LIMIT, 2 * len(part.train.views)))
    latest = None
    while done < 1.0:
        with clock, waiting:
            report = method.step(state.iterations, done)
        check_step(report, f"model {part.name}, iteration {state.iterations + 1}")
        state.iterations += 1
        state.seconds = clock.seconds - waiting.seconds
        state.waited_seconds = waiting.seconds
        done = stop.progress(state.iterations, state.seconds)
        if _was_finite(report, state):
            last_good = state.iterations
        elif state.iterations - last_good == NOT_FINITE_LIMIT:
            raise _diverged(report, part, last_good)
        if report.skipped == "empty":
            unseen.append(report.loss)
        else:
            unseen.clear()
        if _is_lost(unseen, state):
            raise _lost(part, state.iterations, len(unseen))
        if due and done >= due[0]:
            due = [share for share in due if share > done]
            state.curve.append(_probe(method, part, truth, state))
            latest = state.curve[-1].psnr
        observer(state.iterations, state.seconds, report, latest)
        if checkpoints is not None and checkpoints.is_due and last_good == state.iterations:
            checkpoints.write(method, state)
    if checkpoints is not None:
        checkpoints.finish(method, state)
    return state


def _was_finite(report: StepReport, state: LoopState) -> bool:
    """Count a step that taught nothing; whether it was finite."""
    if report.skipped == "not finite" or not math.isfinite(report.loss):
        state.skipped_steps += 1
        return False
    if state.first_loss is None:
        state.first_loss = report.loss
    state.empty_steps += report.skipped == "empty"
    return True


def _diverged(report: StepReport, part: Part, last_good: int) -> TrainingError:
    todo = "lower the learning rates, or report this with the scene"
    if report.skipped:
        todo = f"the model of iteration {last_good} is kept in checkpoint; {todo}"
    return (DivergedError if report.skipped else TrainingError)(
        f"model {part.name}, iteration {last_good + NOT_FINITE_LIMIT}",
        expected="a finite loss and finite gradients",
        found=f"{NOT_FINITE_LIMIT} steps in a row without",
        todo=todo,
    )


def _is_lost(unseen: deque[float], state: LoopState) -> bool:
    """Whether all views are empty, with a larger loss than the first step had.

    Nothing is learned from empty views, so that such a model stays as it is. Photos of nothing but
    the background, or behind masks, need no primitives: their loss is small.
    """
    if len(unseen) != unseen.maxlen or state.first_loss is None:
        return False
    return float(np.mean(unseen)) > state.first_loss


def _lost(part: Part, iteration: int, count: int) -> TrainingError:
    return TrainingError(
        f"model {part.name}, iteration {iteration}",
        expected="a training view that shows something of the model",
        found=f"{count} steps in a row without, and a larger loss than at the start",
        todo="lower the learning rates, or report this with the scene",
    )


def _probe(method: Method, part: Part, truth: Truth, state: LoopState) -> CurvePoint:
    frames = [f for f in probe_frames(part) if f.name in truth]
    values = [psnr(render_bytes(method, part, f), *truth[f.name]) for f in frames]
    size = method.size()
    check_size(size, f"model {part.name}")
    mean = float(np.mean(values)) if values else math.nan
    return CurvePoint(
        state.seconds, state.iterations, size.primitives, mean, size.parameters, part.name
    )


def render_bytes(method: Method, part: Part, frame: Frame) -> NDArray[np.uint8]:
    """Render a frame at its own period, quantised to 8 bits. [H, W, 3]

    Raises:
        MethodError: If the image has another size or type, or is not finite.
    """
    prediction = method.render(part.view(frame), part.method_period(frame))
    return checked_bytes(prediction, part, frame)


def checked_bytes(prediction: Prediction, part: Part, frame: Frame) -> NDArray[np.uint8]:
    """The image of a prediction, quantised to 8 bits; errors as in `render_bytes`. [H, W, 3]"""
    check_prediction(prediction, part.view(frame), f"model {part.name}, view {frame.name}")
    return to_bytes(prediction.rgb)


WARM_UP_SIZE = 32  # Pixels per axis of the made-up images
WARM_UP_STEPS = 120  # Enough for the first rounds of densification of the methods here
WARM_UP_SECONDS = 3.0  # Limit on the time for the steps after the first three


def warm_up(
    spec: MethodSpec, config: Any, *, num_periods: int, device: str, now: Clock = time.perf_counter
) -> str | None:
    """Train a few steps and render once on made-up images; returns what went wrong, if anything.

    Kernels are compiled, or loaded from their cache, at first use. On the training clock that
    would charge the first run of a method more than the next, and shorten a time budget.
    """
    try:
        seed_everything(0)
        method: Method = import_object(spec.method)(config)
        train = made_up_set(num_periods)
        method.setup(train, seed=0, device=device)
        started = now()
        for index in range(WARM_UP_STEPS):
            method.step(index, index / WARM_UP_STEPS)
            if index < 2:
                started = now()
            elif now() - started > WARM_UP_SECONDS:
                break
        method.render(train.views[0], 0.0)
    except Exception as error:  # the run itself will report it; here it only costs time
        return f"warm-up failed ({type(error).__name__}), compilation is on the training clock"
    return None


def made_up_set(num_periods: int) -> TrainingSet:
    """Noise seen by three cameras per period around a cloud of points."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3 * num_periods, WARM_UP_SIZE, WARM_UP_SIZE, 3), dtype=np.uint8)
    views = tuple(_made_up_view(i, i // 3) for i in range(len(images)))
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


def _made_up_view(number: int, period: int) -> TrainingView:
    """A camera one and a half units from the origin, looking at it."""
    angle = 0.4 * number
    cosine, sine = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:3, :3] = [[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]]
    pose[2, 3] = 1.5
    K = np.array([[30.0, 0.0, WARM_UP_SIZE / 2], [0.0, 30.0, WARM_UP_SIZE / 2], [0.0, 0.0, 1.0]])
    return TrainingView(K, WARM_UP_SIZE, WARM_UP_SIZE, pose, f"{number}.png", period)


def forget_peak_memory() -> None:
    """Reset the peak of resident memory where the system can: compilers need much."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return
