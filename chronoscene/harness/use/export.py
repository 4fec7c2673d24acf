"""Quality lost where a finished run is exported as Gaussians."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Scene
from chronoscene.scene.gaussian_cloud import GaussianCloud


class ExportLoss(NamedTuple):
    """Means over the test views of the period, in dB."""

    views: int
    model: float
    """PSNR of the images that the run renders."""
    exported: float
    """PSNR of the Gaussians that were exported."""


def measure_loss(
    run: TrainedRun, scene: Scene, period: float, gaussians: GaussianCloud
) -> ExportLoss | None:
    """Compare exported Gaussians with the model on the photos of the test views of the period.

    Args:
        run: The run that was exported.
        scene: The scene that it was trained on.
        period: Period of the Gaussians.
        gaussians: In the world frame.

    Returns:
        None where no test photo shows the period.
    """
    store = ImageStore(scene, max_width=run.record.max_width)
    back, model = gaussians.transformed(run.training_from_world), run.model(period)
    frames = scene.select(split="test", period=int(period)) if period == int(period) else ()
    values = []
    for frame, view in zip(frames, run.frame_views(scene, frames), strict=True):
        photo, mask = store.load(frame), store.load_mask(frame)
        if mask is None or mask.any():
            own = model.render(view, run.model_period(period))
            images = own, model.render_gaussians(back, view)
            values.append([psnr(to_bytes(image.rgb), photo, mask) for image in images])
    if not values:
        return None
    return ExportLoss(len(values), *np.mean(values, axis=0).tolist())
