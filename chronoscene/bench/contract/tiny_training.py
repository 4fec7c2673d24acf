"""A training set of painted balls with known content, and one way to train on it.

``python -m chronoscene.bench.tiny_training METHOD OUT`` trains in a process of its own.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.bench.files.predictions import encode_png
from chronoscene.bench.plan.parts import effective_strategy, make_parts
from chronoscene.bench.train.loop import seed_everything
from chronoscene.images.store import ImageStore
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import (
    Method,
    MethodSpec,
    StepReport,
    TrainingSet,
    TrainingView,
    build_config,
    import_object,
    load_spec,
)
from chronoscene.scene import Camera, Frame, Period, Points, Scene, Split
from chronoscene.scene.similarity import Sim3

WIDTH, HEIGHT = 40, 30
STEPS = 120
VIEWS_PER_PERIOD = 5
BALLS = 70


def make_view(angle: float, period: int, name: str) -> TrainingView:
    """A camera at distance 1 on a ring, looking slightly down at the origin."""
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
    """Centres [B, 3], radii [B] and colours per period [T, B, 3]; every third ball is repainted."""
    rng = np.random.default_rng(11)
    centres = rng.uniform(-0.35, 0.35, (BALLS, 3))
    radii = rng.uniform(0.03, 0.08, BALLS)
    colors = np.repeat(rng.uniform(0.1, 0.9, (1, BALLS, 3)), num_periods, axis=0)
    for period in range(1, num_periods):
        colors[period, ::3] = rng.uniform(0.1, 0.9, colors[period, ::3].shape)
    return centres, radii, colors


def paint(view: TrainingView, centres: Any, radii: Any, colors: Any) -> np.ndarray:
    """Balls as discs, far to near, on black. [H, W, 3] uint8"""
    image = np.zeros((view.height, view.width, 3))
    inside = centres @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    for i in np.argsort(-inside[:, 2]):
        u, v = (view.K @ (inside[i] / inside[i, 2]))[:2]
        disc = (x - u) ** 2 + (y - v) ** 2 < (view.K[0, 0] * radii[i] / inside[i, 2]) ** 2
        image[disc] = colors[i]
    return np.rint(255 * image).astype(np.uint8)


def make_training_set(num_periods: int) -> TrainingSet:
    """The set of T periods; T = 1 has the views of one period only."""
    centres, radii, colors = make_balls(num_periods)
    views = tuple(
        make_view(2 * np.pi * (i + p / max(num_periods, 2)) / VIEWS_PER_PERIOD, p, f"{p}_{i}.png")
        for p in range(num_periods)
        for i in range(VIEWS_PER_PERIOD)
    )
    images = [paint(view, centres, radii, colors[view.period]) for view in views]
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
        background=np.zeros(3, np.float32),
        load_image=lambda i: images[i],
    )


def make_stage(period: int, *, hide_period: bool) -> TrainingSet:
    """One of three periods, as the strategy ``sequential`` gives them."""
    data = make_training_set(3)
    own = [i for i, view in enumerate(data.views) if view.period == period]
    known = 1 if hide_period else period + 1
    return replace(
        data,
        views=tuple(replace(data.views[i], period=known - 1) for i in own),
        num_periods=known,
        point_periods=data.point_periods[:, :known],
        load_image=lambda i: data.load_image(own[i]),
    )


def training_set_on_disk(spec: MethodSpec, root: Path, *, noisy_tests: bool) -> TrainingSet:
    """The training set that bench makes of a scene on disk; one view of each period is for testing.

    Args:
        spec: Says whether the periods are hidden.
        root: Folder for the photos; those of the same names are replaced.
        noisy_tests: Whether the test photos show noise.
    """
    num_periods = periods_for(spec)
    data = make_training_set(num_periods)
    frames = []
    for i, view in enumerate(data.views):
        focal = view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]
        camera = Camera(1, "PINHOLE", view.width, view.height, focal)
        split: Split = "test" if i % VIEWS_PER_PERIOD == 2 else "train"
        frames.append(Frame(view.name, i + 1, camera, view.cam_from_world, view.period, split))
        photo = data.load_image(i)
        if noisy_tests and split == "test":
            photo = np.random.default_rng(i).integers(0, 256, photo.shape, np.uint8)
        (root / view.name).write_bytes(encode_png(photo))
    count, seen_by = len(data.points), np.flatnonzero([f.split == "train" for f in frames])
    points = Points(
        ids=np.arange(1, count + 1),
        xyz=data.points.astype(np.float64),
        rgb=data.colors,
        error=np.zeros(count),
        track_start=len(seen_by) * np.arange(count + 1),
        track_frame=np.tile(seen_by, count).astype(np.int32),
        track_xy=np.zeros((len(seen_by) * count, 2)),
    )
    periods = tuple(Period(i, str(i)) for i in range(num_periods))
    scene = Scene("balls", root, root, tuple(frames), points, periods, "made up", "memory")
    strategy, _ = effective_strategy(spec, "joint")
    return make_parts(scene, ImageStore(scene), strategy)[0].train


def periods_for(spec: MethodSpec) -> int:
    """Three periods, or one where the method takes none."""
    return 1 if spec.period_input == "none" else 3


def small_config(spec: MethodSpec) -> Any:
    """The preset for short trainings."""
    preset = "fast" if "fast" in spec.presets else sorted(spec.presets)[0]
    return build_config(spec, preset=preset, overrides={"iterations": STEPS})


def train(
    spec: MethodSpec,
    data: TrainingSet,
    *,
    seed: int = 0,
    threads: int | None = None,
    steps: int = STEPS,
    probe: bool = False,
) -> tuple[Method, list[StepReport]]:
    """Train as the harness does; ``probe`` renders now and then in between."""
    set_threads(threads)
    seed_everything(seed)
    method: Method = import_object(spec.method)(small_config(spec))
    method.setup(data, seed=seed, device="cpu")
    reports = []
    for index in range(steps):
        reports.append(method.step(index, index / steps))
        if probe and index % 25 == 3:
            method.render(data.views[0], 0.0)
    return method, reports


def main() -> None:
    """Train, probing, and save."""
    spec, out = load_spec(sys.argv[1]), Path(sys.argv[2])
    method, _ = train(spec, make_training_set(periods_for(spec)), probe=True)
    method.save(out)


if __name__ == "__main__":
    main()
