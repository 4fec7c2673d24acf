"""The training loop, owned by the harness: seeds, clock, stop, probes."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.bench.image_store import to_bytes
from chronoscene.bench.protocol import Part
from chronoscene.bench.stopping import StopRule, Stopwatch
from chronoscene.errors import ChronoSceneError
from chronoscene.methods import Method, StepReport
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame

PROBE_SHARES = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
"""Shares of the training at which the probe views are rendered."""


class TrainingError(ChronoSceneError):
    """A training that cannot go on: a loss or an image that is not finite, or of a wrong shape."""


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """One line of ``curve.csv``. Seconds and iterations are those of the model named."""

    seconds: float
    iteration: int
    primitives: int
    psnr: float
    """Mean over the probe views, in dB."""
    parameters: int
    model: str


@dataclass(frozen=True, slots=True)
class Trained:
    """How a training went."""

    seconds: float
    setup_seconds: float
    iterations: int
    curve: tuple[CurvePoint, ...]


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
    truth: Mapping[str, NDArray[np.uint8]],
    *,
    seed: int,
    device: str,
    observer: Observer,
) -> Trained:
    """Train one model. Probes and the observer run off the clock.

    Args:
        method: An empty method.
        part: What to train on and what to probe.
        stop: When to end.
        truth: Ground truth of the probe views by name. [H, W, 3]
        seed: For the global generators and the method.
        device: ``cpu`` or ``cuda``.
        observer: Shows the progress.

    Raises:
        TrainingError: If the loss is not finite.
    """
    seed_everything(seed)
    clock = Stopwatch()
    with clock:
        method.setup(part.train, seed=seed, device=device)
    setup_seconds = clock.seconds
    curve: list[CurvePoint] = []
    due = list(PROBE_SHARES)
    iteration = 0
    while (progress := stop.progress(iteration, clock.seconds)) < 1.0:
        with clock:
            report = method.step(iteration, progress)
        iteration += 1
        _check_loss(part, iteration, report)
        done = stop.progress(iteration, clock.seconds)
        if due and done >= due[0]:
            due = [share for share in due if share > done]
            curve.append(_probe(method, part, truth, clock.seconds, iteration))
        observer(iteration, clock.seconds, report, curve[-1].psnr if curve else None)
    return Trained(clock.seconds, setup_seconds, iteration, tuple(curve))


def _check_loss(part: Part, iteration: int, report: StepReport) -> None:
    if not math.isfinite(report.loss):
        raise TrainingError(
            f"model {part.name}, iteration {iteration}",
            expected="a finite loss",
            found=str(report.loss),
            todo="lower the learning rates, or report this with the scene",
        )


def _probe(
    method: Method,
    part: Part,
    truth: Mapping[str, NDArray[np.uint8]],
    seconds: float,
    iteration: int,
) -> CurvePoint:
    frames = probe_frames(part)
    values = [psnr(render_bytes(method, part, f), truth[f.name]) for f in frames]
    size = method.size()
    mean = float(np.mean(values)) if values else math.nan
    return CurvePoint(seconds, iteration, size.primitives, mean, size.parameters, part.name)


def render_bytes(method: Method, part: Part, frame: Frame) -> NDArray[np.uint8]:
    """Render a frame at its own period, quantised to 8 bits. [H, W, 3]

    Raises:
        TrainingError: If the image has another size or is not finite.
    """
    view = part.view(frame)
    rgb = np.asarray(method.render(view, part.method_period(frame)).rgb)
    finite = rgb.dtype.kind != "f" or bool(np.isfinite(rgb).all())
    if rgb.shape != (view.height, view.width, 3) or not finite:
        raise TrainingError(
            f"model {part.name}, view {frame.name}",
            expected=f"a finite image of shape {[view.height, view.width, 3]}",
            found=f"shape {list(rgb.shape)}" if finite else "values that are not finite",
            todo="report this to the author of the method",
        )
    return to_bytes(rgb)


def stop_if_orphaned(parent: int | None) -> None:
    """End silently when the bench that started this process is gone: it may run again already."""
    if parent is not None and os.getppid() != parent:
        raise SystemExit("the bench that this run belongs to has ended")
