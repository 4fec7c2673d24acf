"""Small training sets with known content."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.methods import TrainingSet, TrainingView
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.scene.similarity import Sim3

WIDTH, HEIGHT = 40, 30


def ring_view(angle: float, period: int, name: str) -> TrainingView:
    """A camera two units above the middle, one unit aside, looking down at the origin."""
    tilt = rotation_from_quaternion([np.cos(1.37), np.sin(1.37), 0.0, 0.0])
    turn = rotation_from_quaternion([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
    pose = np.eye(4)
    pose[:3, :3] = tilt @ turn
    centre = 2.0 * pose[2, :3]
    pose[:3, 3] = pose[:3, :3] @ centre
    K = np.array([[40.0, 0.0, 20.5], [0.0, 41.0, 14.0], [0.0, 0.0, 1.0]])
    return TrainingView(
        K=K, width=WIDTH, height=HEIGHT, cam_from_world=pose, name=name, period=period
    )


@pytest.fixture(scope="session")
def noise_set() -> Callable[[int], TrainingSet]:
    """Makes sets of T periods with three views each, whose images are blurred noise."""

    def make(num_periods: int) -> TrainingSet:
        generator = np.random.default_rng(5)
        views = tuple(
            ring_view(2.1 * i, p, f"{p}_{i}.png") for p in range(num_periods) for i in range(3)
        )
        images = generator.integers(0, 256, (len(views), HEIGHT // 5, WIDTH // 5, 3), np.uint8)
        images = images.repeat(5, axis=1).repeat(5, axis=2)
        points = generator.uniform(-0.5, 0.5, (60, 3)).astype(np.float32)
        return TrainingSet(
            views=views,
            num_periods=num_periods,
            points=points,
            colors=np.full((60, 3), 128, np.uint8),
            point_periods=np.ones((60, num_periods), bool),
            training_from_world=Sim3(0.5, np.eye(3), np.array([1.0, 2.0, 3.0])),
            camera_extent=1.1,
            scene_extent=1.1,
            background=np.array([0.1, 0.2, 0.3], np.float32),
            load_image=lambda index: images[index],
        )

    return make


@pytest.fixture
def method(noise_set: Callable[[int], TrainingSet]) -> Callable[..., ChronoGS]:
    """Makes a method that is set up for T periods, with features that are not zero."""

    def make(num_periods: int = 3, *, random_features: bool = True, **options: object) -> ChronoGS:
        defaults = {"iterations": 40, "voxel_size": 0.02, "voxel_unit": "training"}
        config = ChronoGSConfig(**(defaults | options))  # type: ignore[arg-type]
        made = ChronoGS(config)
        made.setup(noise_set(num_periods), seed=1, device="cpu")
        if random_features:
            generator = torch.Generator().manual_seed(2)
            with torch.no_grad():
                for tensor in (made.model.features, made.model.blocks, made.model.offsets):
                    tensor.copy_(torch.randn(tensor.shape, generator=generator) * 0.3)
        return made

    return make
