"""The training loop of the harness: seeds, clock, stop, probes."""

from __future__ import annotations

import math
import random
import time
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from chronoscene.arrays import Mask, Pixels
from chronoscene.errors import ChronoSceneError
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.files.records import CurvePoint
from chronoscene.harness.plan.parts import Part
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.train.checkpoints import Checkpoints, LoopState
from chronoscene.harness.train.checks import check_prediction, check_size, check_step
from chronoscene.io.wording import shown
from chronoscene.methods import Method, Prediction, StepReport
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame
from chronoscene.scene.grouping import grouped

PROBE_SHARES = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
"""Shares of the training at which the probe views are rendered."""

NOT_FINITE_LIMIT = 50
"""Steps in a row without a finite loss and finite gradients that end a training; one of several
views counts as so many."""

BLANK_PSNR = 20.0
"""dB; photos that are closer to a blank image are blank themselves, such as those of a night."""

_REMEDY = (
    "lower the learning rates, or take preset paper-scaled instead of paper, if the method has "
    "one, or report this with the scene"
)

_CHECKS = (
    "check that the sparse points are spread over what the photos show, that these are not black "
    "or masked throughout (chronoscene validate), and that lengths such as near_plane fit the unit "
    "of the scene (length_unit=training does in any)"
)

SHORTEST_PAUSE = 1.0
"""Seconds; shorter pauses of the process stay on the clock."""

Clock = Callable[[], float]
"""Return seconds, from any start."""


class TrainingError(ChronoSceneError):
    """A training that cannot end in a model."""


class DivergedError(TrainingError):
    """`NOT_FINITE_LIMIT` steps in a row were skipped; the model is as it was before them."""


class Stopwatch:
    """Sum of the time inside ``with``: training runs inside, evaluation outside."""

    def __init__(self, now: Clock = time.perf_counter) -> None:
        self.seconds = 0.0
        self._now = now
        self._started = 0.0

    def __enter__(self) -> Stopwatch:
        self._started = self._now()
        return self

    def __exit__(self, *error: object) -> None:
        self.seconds += self._now() - self._started


class PauseDetector:
    """Finds steps in which the process was stopped, or its machine asleep.

    They take far longer than the mean of the steps before, and compute hardly more meanwhile.
    """

    def __init__(self) -> None:
        self._steps, self._seconds, self._computed = 0, 0.0, 0.0

    def pause(self, seconds: float, computed: float) -> float:
        """Return how much of the next step was a pause, in seconds.

        Args:
            seconds: Time that it took.
            computed: Computing time of the process in it, in seconds.
        """
        paused, steps = 0.0, max(self._steps, 1)
        is_long = self._steps > 0 and seconds > max(SHORTEST_PAUSE, 10 * self._seconds / steps)
        if is_long and computed < 5 * self._computed / steps:
            paused = seconds - self._seconds / steps
        self._steps += 1
        self._seconds += seconds - paused
        self._computed += computed
        return paused


Truth = Mapping[str, tuple[Pixels, Mask | None]]
"""Photos by name [H, W, 3], with masks that are true where they count [H, W], or None. Photos that
count nowhere are left out."""

Observer = Callable[[int, float, StepReport, float | None], None]
"""Called after each step with the iterations done, the seconds on the training clock, the report of
the step and the latest probe PSNR."""


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, numpy and torch."""
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def probe_frames(part: Part) -> tuple[Frame, ...]:
    """Return the probe views of a model: the middle test view of each period, in name order."""
    by_period = grouped((frame.period, frame) for frame in part.test)
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
    computed: Clock = time.process_time,
    checkpoints: Checkpoints | None = None,
) -> LoopState:
    """Train a model, or a stage of it.

    Probes, checkpoints, the observer, waits for photos and pauses of the process are off the clock.

    Args:
        method: An empty method; at a later stage, the method of the stage before.
        part: Training set and test views.
        stop: End of the training.
        truth: Ground truth of the probe views.
        seed: Seed of the global generators and of the method.
        device: ``cpu`` or ``cuda``.
        observer: Shows the progress.
        now: The clock.
        computed: Computing time of the process.
        checkpoints: Checkpoints to continue from and to write; None for a method that cannot be
            resumed.

    Raises:
        DivergedError: If the method skipped too many steps in a row.
        TrainingError: If the budget is over before the first step, the method took as many steps
            with a loss that is not finite, no view shows the model any more, no view ever did,
            nothing is left of it, or all probe views are blank in the end.
        CheckpointError: If all checkpoints are damaged.
        MethodError: If the method returns a wrong type or value.
    """
    seed_everything(seed)
    clock, waiting = Stopwatch(now), Stopwatch(lambda: part.store.waited)
    pauses = PauseDetector()
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
    if done >= 1.0 and state.iterations == 0 and stop.seconds is not None:
        raise TrainingError(
            f"model {part.name}",
            expected="time for training after the set-up",
            found=f"{seconds:.3g} s of set-up in {stop.seconds:.3g} s",
            todo="give it a longer --budget",
        )
    due = [share for share in PROBE_SHARES if share > done]
    last_good = state.iterations
    # Losses of the latest steps, if those were empty. Views come once per pass, so two passes
    # without the last draw contain all of them.
    unseen = deque[float](maxlen=max(NOT_FINITE_LIMIT, 2 * len(part.train.views)))
    latest = None
    while done < 1.0:
        with clock, waiting, Stopwatch(computed) as working:
            report = method.step(state.iterations, done)
        check_step(report, f"model {part.name}, iteration {state.iterations + 1}")
        spent = clock.seconds - waiting.seconds - state.seconds
        waiting.seconds += pauses.pause(spent, working.seconds)
        state.iterations += report.views
        state.seconds = clock.seconds - waiting.seconds
        state.waited_seconds = waiting.seconds
        done = stop.progress(state.iterations, state.seconds)
        if _was_finite(report, state):
            last_good = state.iterations
        elif state.iterations - last_good >= NOT_FINITE_LIMIT:
            raise _diverged(report, part, last_good, state.iterations)
        if report.skipped == "empty":
            unseen.append(report.loss)
        else:
            unseen.clear()
        if report.primitives == 0:
            raise _useless(part, state, "a model with something in it", "nothing left", _CHECKS)
        if _is_lost(unseen, state):
            expected = "a training view that shows something of the model"
            found = f"{len(unseen)} steps in a row without, and a larger loss than at the start"
            raise _useless(part, state, expected, found, _REMEDY)
        if state.empty_steps == state.iterations and (done >= 1.0 or len(unseen) == unseen.maxlen):
            expected = "a training view that shows something of it"
            found = f"none in {state.iterations} steps"
            raise _useless(part, state, expected, found, _CHECKS)
        if due and done >= due[0]:
            due = [share for share in due if share > done]
            point, is_blank = _probe(method, part, truth, state)
            state.curve.append(point)
            latest = point.psnr
            if is_blank and done >= 1.0:
                expected = "a test view that shows something of the model"
                raise _useless(part, state, expected, "nothing but black or white", _REMEDY)
        observer(state.iterations, state.seconds, report, latest)
        if checkpoints is not None and checkpoints.is_due and last_good == state.iterations:
            checkpoints.write(method, state)
    if checkpoints is not None:
        checkpoints.finish(method, state)
    return state


def _was_finite(report: StepReport, state: LoopState) -> bool:
    """Count skipped steps; return True if the step was finite."""
    if report.skipped == "not finite" or not math.isfinite(report.loss):
        state.skipped_steps += report.views
        return False
    if state.first_loss is None:
        state.first_loss = report.loss
    state.empty_steps += report.views * (report.skipped == "empty")
    return True


def _diverged(report: StepReport, part: Part, last_good: int, reached: int) -> TrainingError:
    todo, names = _REMEDY, shown(report.not_finite)
    if report.skipped:
        todo = f"the model of iteration {last_good} is kept in checkpoint; {todo}"
    return (DivergedError if report.skipped else TrainingError)(
        f"model {part.name}, iteration {reached}",
        expected="a finite loss and finite gradients",
        found=f"{reached - last_good} steps in a row without"
        + (f", the last one in {names}" if names else ""),
        todo=todo,
    )


def _is_lost(unseen: deque[float], state: LoopState) -> bool:
    """Return True if all views are empty, with a larger loss than the first step.

    Nothing is learned from empty views, so such a model stays as it is. Photos of the background
    alone, or behind masks, need no primitives: their loss is small.
    """
    if len(unseen) != unseen.maxlen or state.first_loss is None:
        return False
    return float(np.mean(unseen)) > state.first_loss


def _useless(part: Part, state: LoopState, expected: str, found: str, todo: str) -> TrainingError:
    place = f"model {part.name}, iteration {state.iterations}"
    return TrainingError(place, expected=expected, found=found, todo=todo)


def _probe(method: Method, part: Part, truth: Truth, state: LoopState) -> tuple[CurvePoint, bool]:
    """Render the probe views; also return True if they are blank and the photos are not.

    A radiance field whose colours are saturated is as large as before: only its images tell.
    """
    frames = [f for f in probe_frames(part) if f.name in truth]
    images = [render_bytes(method, part, f) for f in frames]
    values = [psnr(image, *truth[f.name]) for image, f in zip(images, frames, strict=True)]
    size = method.size()
    check_size(size, f"model {part.name}")
    mean = float(np.mean(values)) if values else math.nan
    point = CurvePoint(
        state.seconds, state.iterations, size.primitives, mean, size.parameters, part.name
    )
    blank = all(image.min() == image.max() and image.flat[0] in (0, 255) for image in images)
    return point, blank and mean < BLANK_PSNR


def render_bytes(method: Method, part: Part, frame: Frame) -> Pixels:
    """Render a frame at its own period, quantised to 8 bits. [H, W, 3]

    Raises:
        MethodError: If the image has another size or type, or is not finite.
    """
    prediction = method.render(part.view(frame), part.method_period(frame))
    return checked_bytes(prediction, part, frame)


def checked_bytes(prediction: Prediction, part: Part, frame: Frame) -> Pixels:
    """Quantise the image of a prediction to 8 bits; errors as in `render_bytes`. [H, W, 3]"""
    check_prediction(prediction, part.view(frame), f"model {part.name}, view {frame.name}")
    return to_bytes(prediction.rgb)
