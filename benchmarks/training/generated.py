"""Trainings on generated surfaces of any size, without density control."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from benchmarks.rasterizer.scenes import surfaces
from chronoscene.methods import (
    Method,
    TrainingSet,
    TrainingView,
    build_config,
    import_object,
    load_spec,
)
from chronoscene.scene.similarity import Sim3

PERIODS = 3
PROGRESS = 0.3
"""Share of a training that is over when steps are timed: late enough for all colours and the second
stage of 4DGS, and statistics are still collected."""

_STILL: dict[str, Any] = {
    "densify_interval": 10**9,
    "reset_interval": 10**9,
    "initial_opacity": 0.5,
    # One anchor for each point.
    "density_interval": 10**9,
    "voxel_size": 1e-6,
    "voxel_unit": "training",
    "max_initial_anchors": 0,
    "max_anchors": 0,
}


def training_set(count: int, width: int, height: int) -> TrainingSet:
    """Points on spheres, seen by a few cameras side by side in each period."""
    scene, generator = surfaces(count, width, height), np.random.default_rng(0)
    means, colors = (scene.gaussians[i].detach().numpy() for i in (0, 4))
    views = []
    for number in range(4 * PERIODS):
        pose = scene.viewmats[0].double().numpy().copy()
        pose[:3, 3] += generator.normal(0, 0.2, 3)
        K = scene.Ks[0].double().numpy()
        views.append(TrainingView(K, width, height, pose, f"{number}.png", number % PERIODS))
    images = generator.integers(0, 256, (len(views), height, width, 3), np.uint8)
    return TrainingSet(
        views=tuple(views),
        num_periods=PERIODS,
        points=means.astype(np.float32),
        colors=(255 * colors).astype(np.uint8),
        point_periods=np.ones((count, PERIODS), bool),
        training_from_world=Sim3.identity(),
        camera_extent=1.1,
        scene_extent=1.1,
        background=np.zeros(3, np.float32),
        load_image=lambda index: images[index],
    )


def make(
    train: TrainingSet,
    name: str,
    preset: str,
    options: dict[str, Any] | None = None,
    *,
    device: str = "cpu",
) -> Method:
    """A method at the beginning of a training, without density control."""
    spec = load_spec(name)
    known = {field.name for field in dataclasses.fields(import_object(spec.config))}
    still = {key: value for key, value in _STILL.items() if key in known}
    config = build_config(spec, preset=preset, overrides={**still, **(options or {})})
    method: Method = import_object(spec.method)(config)
    method.setup(train, seed=0, device=device)
    return method
