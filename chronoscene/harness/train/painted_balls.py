"""A training set of painted balls with known content, for warm-ups and checks of methods."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from chronoscene.methods import SparseDepths, TrainingSet, TrainingView
from chronoscene.scene.similarity import Sim3

WIDTH, HEIGHT = 40, 30
VIEWS_PER_PERIOD = 5
BALLS = 70


def make_view(angle: float, period: int, name: str) -> TrainingView:
    """Return a camera at distance 1 on a ring, looking slightly down at the origin."""
    centre = np.array([np.cos(angle), -0.4, np.sin(angle)]) / np.hypot(1, 0.4)
    forward = -centre
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    K = np.array([[36.0, 0.0, 20.5], [0.0, 37.0, 14.0], [0.0, 0.0, 1.0]])
    return TrainingView(K, WIDTH, HEIGHT, pose, name, period)


def make_balls(num_periods: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres [B, 3], radii [B] and colours [T, B, 3]; every third ball is repainted."""
    rng = np.random.default_rng(11)
    centres = rng.uniform(-0.35, 0.35, (BALLS, 3))
    radii = rng.uniform(0.03, 0.08, BALLS)
    colors = np.repeat(rng.uniform(0.1, 0.9, (1, BALLS, 3)), num_periods, axis=0)
    for period in range(1, num_periods):
        colors[period, ::3] = rng.uniform(0.1, 0.9, colors[period, ::3].shape)
    return centres, radii, colors


def paint(view: TrainingView, centres: Any, radii: Any, colors: Any) -> np.ndarray:
    """Paint balls as discs, far to near, on black. [H, W, 3] uint8"""
    image = np.zeros((view.height, view.width, 3))
    inside = centres @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    for i in np.argsort(-inside[:, 2]):
        u, v = (view.K @ (inside[i] / inside[i, 2]))[:2]
        disc = (x - u) ** 2 + (y - v) ** 2 < (view.K[0, 0] * radii[i] / inside[i, 2]) ** 2
        image[disc] = colors[i]
    return np.rint(255 * image).astype(np.uint8)


def front_depths(view: TrainingView, centres: Any, radii: Any) -> SparseDepths:
    """Return the depth of each ball in front of its centre, where no other covers that pixel."""
    inside = centres @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    xy = np.floor(inside[:, :2] / inside[:, 2:] @ view.K[:2, :2].T + view.K[:2, 2]).astype(int)
    numbers = np.tile(np.arange(len(centres)), (3, 1)).T / len(centres)
    shown = paint(view, centres, radii, numbers)[..., 0]
    seen = np.flatnonzero(((xy >= 0) & (xy < (view.width, view.height))).all(axis=1))
    seen = seen[shown[xy[seen, 1], xy[seen, 0]] == np.rint(255 * numbers[seen, 0])]
    pixels, first = np.unique(xy[seen, 1] * view.width + xy[seen, 0], return_index=True)
    depths = (inside[:, 2] - radii)[seen[first]]
    return SparseDepths(pixels, depths.astype(np.float32))


def make_training_set(num_periods: int) -> TrainingSet:
    """Return a training set of T periods; images are painted when they are loaded first."""
    centres, radii, colors = make_balls(num_periods)
    views = tuple(
        make_view(2 * np.pi * (i + p / max(num_periods, 2)) / VIEWS_PER_PERIOD, p, f"{p}_{i}.png")
        for p in range(num_periods)
        for i in range(VIEWS_PER_PERIOD)
    )

    @cache
    def load_image(index: int) -> np.ndarray:
        return paint(views[index], centres, radii, colors[views[index].period])

    rng = np.random.default_rng(12)
    spread = rng.normal(0, 0.4, (4, *centres.shape)) * radii[None, :, None]
    return TrainingSet(
        views=views,
        num_periods=num_periods,
        points=(centres + spread).reshape(-1, 3).astype(np.float32),
        colors=np.tile(np.rint(255 * colors[0]).astype(np.uint8), (4, 1)),
        point_periods=np.ones((4 * BALLS, num_periods), bool),
        training_from_world=Sim3(0.25, np.eye(3), np.array([1.0, -2.0, 3.0])),
        camera_extent=1.1,
        scene_extent=1.1,
        background=np.zeros(3, np.float32),
        load_image=load_image,
        load_depths=lambda index: front_depths(views[index], centres, radii),
    )
