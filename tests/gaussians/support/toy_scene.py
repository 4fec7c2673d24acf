"""A scene whose answer is known: rendered Gaussians, seen from a ring of cameras."""

import numpy as np
import torch

from baselines.gaussian_splatting.method import GaussianSplatting
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.methods import TrainingSet, TrainingView
from chronoscene.rasterizer import NEAR_PLANE
from chronoscene.scene.similarity import Sim3
from chronoscene.training.drawing import Splats, draw

WIDTH, HEIGHT = 48, 36
EXTENT = 1.1

SHORT = GaussianConfig(
    iterations=250, stretch=True, reset_interval=30_000, densify_interval=25, max_gaussians=300
)


def ring_of_views(count, *, periods=1):
    """Cameras at distance 1 from the origin that look at it; every one once per period."""
    views = []
    for period in range(periods):
        for i in range(count):
            angle = 2 * np.pi * i / count
            centre = np.array([np.cos(angle), np.sin(angle), 0.3 * np.sin(3 * angle)])
            centre /= np.linalg.norm(centre)
            forward = -centre
            right = np.cross(forward, [0, 0, 1.0])
            right /= np.linalg.norm(right)
            rotation = np.stack([right, np.cross(forward, right), forward])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
            K = np.array([[50.0, 0, 25.5], [0, 52.0, 17.0], [0, 0, 1]])
            views.append(
                TrainingView(
                    K=K,
                    width=WIDTH,
                    height=HEIGHT,
                    cam_from_world=pose,
                    name=f"{period}/{i}.png",
                    period=period,
                )
            )
    return tuple(views)


def solid_gaussians(count, seed):
    generator = np.random.default_rng(seed)
    means = generator.uniform(-0.3, 0.3, (count, 3)).astype(np.float32)
    colors = generator.uniform(0.1, 0.9, (count, 3)).astype(np.float32)
    return torch.from_numpy(means), torch.from_numpy(colors)


def photo_of(means, colors, view):
    count = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    splats = Splats(means, quats, torch.full((count, 3), 0.06), torch.full((count,), 0.9), colors)
    image = draw(splats, view, torch.zeros(3), near_plane=NEAR_PLANE).image[0].clamp(0, 1)
    return (image * 255).round().byte().numpy()


def toy_scene(count=60, views=10, *, colors_per_period=1):
    """A training set whose points are the true centres, with noise; colours per period."""
    means, _ = solid_gaussians(count, 0)
    palettes = [solid_gaussians(count, 1 + period)[1] for period in range(colors_per_period)]
    cameras = ring_of_views(views, periods=colors_per_period)
    images = [photo_of(means, palettes[v.period], v) for v in cameras]
    noise = np.random.default_rng(5).normal(size=(count, 3)) * 0.01
    return TrainingSet(
        views=cameras,
        num_periods=1,
        points=(means.numpy() + noise).astype(np.float32),
        colors=(palettes[0].numpy() * 255).astype(np.uint8),
        point_periods=np.ones((count, 1), bool),
        training_from_world=Sim3.identity(),
        camera_extent=EXTENT,
        scene_extent=EXTENT,
        background=np.zeros(3, np.float32),
        load_image=images.__getitem__,
    )


def train(scene, config, *, seed=0, method_class=GaussianSplatting):
    method = method_class(config)
    method.setup(scene, seed=seed, device="cpu")
    for i in range(config.iterations):
        method.step(i, i / config.iterations)
    return method


def mean_squared_error(method, scene):
    errors = [
        np.mean((method.render(view, view.period).rgb - scene.load_image(i) / 255.0) ** 2)
        for i, view in enumerate(scene.views)
    ]
    return float(np.mean(errors))
