"""A red cluster that moves among Gaussians that stay, photographed in five periods."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from toy_scene import EXTENT, photo_of, ring_of_views, solid_gaussians

from chronoscene.gaussians.method import GaussianMethod
from chronoscene.methods import TrainingSet, TrainingView
from chronoscene.scene.similarity import Sim3

Path3D = Callable[[float], tuple[float, float, float]]
RED = torch.tensor([0.95, 0.2, 0.1])
PERIODS = 5


def photo(view: TrainingView, path: Path3D, period: float) -> np.ndarray:
    """Forty Gaussians that stay, and a red cluster on its path."""
    return photo_of(*painted(path, period), view)


def painted(path: Path3D, period: float) -> tuple[torch.Tensor, torch.Tensor]:
    means, colors = solid_gaussians(40, 0)
    cluster = 0.3 * solid_gaussians(12, 3)[0] + torch.tensor(path(period))
    return torch.cat([means, cluster]), torch.cat([colors, RED.repeat(12, 1)])


def moving_scene(path: Path3D) -> TrainingSet:
    """Four photos of each period; the sparse points are those of period 1."""
    ring = ring_of_views(4 * PERIODS)
    views = [replace(v, period=p) for p in range(PERIODS) for v in ring[p::PERIODS]]
    images = [photo(view, path, view.period) for view in views]
    points, colors = painted(path, 1)
    return TrainingSet(
        views=tuple(views),
        num_periods=PERIODS,
        points=points.numpy(),
        colors=(colors.numpy() * 255).astype(np.uint8),
        point_periods=np.ones((len(points), PERIODS), bool),
        training_from_world=Sim3(0.2, np.eye(3), np.zeros(3)),
        camera_extent=EXTENT,
        scene_extent=EXTENT,
        background=np.zeros(3, np.float32),
        load_image=images.__getitem__,
    )


def decibels(method: GaussianMethod, path: Path3D, periods: list[float]) -> float:
    """PSNR in views of their own at whole or fractional periods."""
    errors = [
        np.mean((method.render(view, period).rgb - photo(view, path, period) / 255.0) ** 2)
        for period in periods
        for view in ring_of_views(7)
    ]
    return float(-10 * np.log10(np.mean(errors)))


def arc(period: float) -> tuple[float, float, float]:
    angle = np.pi * period / (PERIODS - 1)
    return (0.25 * np.cos(angle), 0.25 * np.sin(angle) - 0.1, 0.0)
