"""The model of a finished run as Gaussians for other programs, and what that costs in quality."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from chronoscene.bench.files.predictions import to_bytes
from chronoscene.bench.use.trained_run import OpenRun
from chronoscene.errors import ConfigError
from chronoscene.images.store import ImageStore
from chronoscene.methods import View
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame, Scene
from chronoscene.scene.gaussian_cloud import GaussianCloud


class ExportLoss(NamedTuple):
    """Means over the test views of the period, in dB."""

    views: int
    model: float
    """PSNR of what the run renders."""
    exported: float
    """PSNR of the Gaussians that were exported."""


def export_gaussians(run: OpenRun, scene: Scene, period: float) -> GaussianCloud:
    """What the run shows as of a period, in the world of the scene.

    Raises:
        ConfigError: If no model claims the period, or the method has no Gaussians to give.
        CheckpointError: If the model is missing.
    """
    run.check_period(period)
    model = run.model(period)
    if not hasattr(model, "to_gaussians"):
        raise ConfigError(
            run.folder,
            expected="a method that gives its Gaussians by to_gaussians",
            found=run.spec.title,
            todo="export a run of another method",
        )
    frames = scene.select(split="train", period=_own_period(run, period))
    frames = tuple(frame for frame in frames if frame.period < run.num_periods)
    gaussians = model.to_gaussians(run.told(period), list(_views(run, scene, frames)))
    return gaussians.transformed(run.training_from_world.inverse())


def measure_loss(
    run: OpenRun, scene: Scene, period: float, gaussians: GaussianCloud
) -> ExportLoss | None:
    """Compare what was exported with the model, by the photos of the test views of the period.

    Args:
        run: What was exported.
        scene: The one that it was trained on.
        period: Of the Gaussians.
        gaussians: In the world.

    Returns:
        None where no test photo shows the period.
    """
    store = ImageStore(scene, max_width=run.record.max_width)
    back, model = gaussians.transformed(run.training_from_world), run.model(period)
    frames = scene.select(split="test", period=int(period)) if period == int(period) else ()
    values = []
    for frame, view in zip(frames, _views(run, scene, frames), strict=True):
        photo, mask = store.load(frame), store.load_mask(frame)
        if mask is None or mask.any():
            images = model.render(view, run.told(period)), model.render_gaussians(back, view)
            values.append([psnr(to_bytes(image.rgb), photo, mask) for image in images])
    if not values:
        return None
    return ExportLoss(len(values), *np.mean(values, axis=0).tolist())


def _own_period(run: OpenRun, period: float) -> int | None:
    """The one period that a model was trained on; None for all of them."""
    return int(period) if run.strategy.model_per_period else None


def _views(run: OpenRun, scene: Scene, frames: Iterable[Frame]) -> Iterable[View]:
    store = ImageStore(scene, max_width=run.record.max_width)
    return (run.view(store.camera(frame), frame.cam_from_world) for frame in frames)
