"""A place of two periods, small enough to train: what each kind of feature is there for.

In period 1 a box stands on the ground and the wall has another colour. Images are traced
analytically, so nothing of ours is on both sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.harness.train.checks import check_sharing
from chronoscene.methods import TrainingSet, TrainingView
from chronoscene.scene.geometry import look_at
from chronoscene.scene.similarity import Sim3

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
BOX = np.array([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]])
STEPS = 500

Array = NDArray[np.float64]


def camera(angle: float, radius: float, height: float) -> Array:
    """Pose that looks from a ring at a point above the middle. [4, 4]"""
    centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    return look_at(centre, np.array([0.0, 0.0, 0.15]))


def paint(points: Array, tint: Array) -> Array:
    """A smooth texture around a colour. [N, 3]"""
    wave = np.sin(9.0 * points[:, :1] + np.sin(7.0 * points[:, 1:2]) + 8.0 * points[:, 2:])
    return tint * (0.75 + 0.25 * wave)


def trace(pose: Array, period: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The image and where it shows the box. [H, W, 3], [H, W]"""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    rays = rays.reshape(-1, 3) @ pose[:3, :3]
    origin = -pose[:3, :3].T @ pose[:3, 3]
    image, depth = np.zeros((len(rays), 3)), np.full(len(rays), np.inf)
    wall = [[0.8, 0.3, 0.2], [0.2, 0.4, 0.8]][period]
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, level, tint in ((2, 0.0, [0.6, 0.6, 0.5]), (1, 1.2, wall)):
            t = (level - origin[axis]) / rays[:, axis]
            points = origin + t[:, None] * rays
            inside = (np.abs(points[:, 0]) < 1.2) & (points[:, 1] < 1.2 + 1e-9)
            inside &= (points[:, 1] > -1.2) & (points[:, 2] > -1e-9) & (points[:, 2] < 0.8)
            hit = (t > 0) & (t < depth) & inside
            image[hit], depth[hit] = paint(points[hit], np.array(tint)), t[hit]
        slabs = (BOX[:, None] - origin) / rays
        enter, leave = slabs.min(axis=0).max(axis=1), slabs.max(axis=0).min(axis=1)
    box = (enter < leave) & (enter > 0) & (enter < depth) & (period == 1)
    points = origin + enter[box, None] * rays[box]
    image[box] = paint(points, np.array([0.2, 0.7, 0.3]))
    pixels = np.round(image.reshape(HEIGHT, WIDTH, 3) * 255).astype(np.uint8)
    return pixels, box.reshape(HEIGHT, WIDTH)


def surface_points() -> NDArray[np.float32]:
    """Points on ground, wall and box. [P, 3]"""
    generator = np.random.default_rng(0)
    ground = generator.uniform(-1.2, 1.2, (500, 3)) * [1, 1, 0]
    wall = generator.uniform([-1.2, 1.2, 0], [1.2, 1.2, 0.8], (200, 3))
    box = generator.uniform(BOX[0], BOX[1], (200, 3))
    side = generator.integers(0, 5, 200)
    for i, (axis, end) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1), (2, 1)]):
        box[side == i, axis] = BOX[end, axis]
    return np.concatenate([ground, wall, box]).astype(np.float32)


@dataclass(frozen=True)
class Held:
    """A held-out view and its truth."""

    view: TrainingView
    image: NDArray[np.uint8]
    box: NDArray[np.bool_]


def make_views(period: int, angles: Array, radius: float, height: float) -> list[TrainingView]:
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return [
        TrainingView(
            K=K, width=WIDTH, height=HEIGHT, cam_from_world=camera(a, radius, height),
            name=f"{period}_{a:.3f}_{radius}.png", period=period,
        )
        for a in angles
    ]  # fmt: skip


def training_set(periods: tuple[int, ...]) -> TrainingSet:
    """Views of some of the periods, numbered from 0, from other places in each."""
    truth, views = [], []
    for number, period in enumerate(periods):
        arc = np.linspace(-np.pi * 0.95, -0.05 * np.pi, 14) + 0.08 * number
        for view in (*make_views(period, arc, 1.9, 1.2), *make_views(period, arc, 1.6, 0.8)):
            truth.append(trace(view.cam_from_world, period)[0])
            views.append(
                TrainingView(
                    K=view.K, width=WIDTH, height=HEIGHT, cam_from_world=view.cam_from_world,
                    name=view.name, period=number,
                )
            )  # fmt: skip
    points = surface_points()
    return TrainingSet(
        views=tuple(views),
        num_periods=len(periods),
        points=points,
        colors=np.zeros((len(points), 3), np.uint8),
        point_periods=np.ones((len(points), len(periods)), bool),
        training_from_world=Sim3.identity(),
        camera_extent=1.1,
        scene_extent=1.1,
        background=np.zeros(3, np.float32),
        load_image=lambda index: truth[index],
    )


def held_out(period: int) -> list[Held]:
    arc = np.linspace(-np.pi * 0.9, -0.1 * np.pi, 6) + 0.07
    views = make_views(period, arc, 1.75, 1.0)
    return [Held(v, *trace(v.cam_from_world, period)) for v in views]


def train(
    periods: tuple[int, ...] = (0, 1),
    *,
    steps: int = STEPS,
    train_set: TrainingSet | None = None,
    **options: Any,
) -> ChronoGS:
    config = ChronoGSConfig(
        iterations=steps,
        offsets_per_anchor=5,
        voxel_size=0.5,
        voxel_unit="spacing",
        density_interval=25,
        **options,
    )
    made = ChronoGS(config)
    made.setup(train_set or training_set(periods), seed=0, device="cpu")
    for index in range(steps):
        made.step(index, index / steps)
    return made


def psnr(
    made: ChronoGS,
    period: int,
    label: int,
    region: Callable[[Held], NDArray[np.bool_]] = lambda held: np.ones((HEIGHT, WIDTH), bool),
) -> float:
    """Mean PSNR of the held-out views of a period, rendered as period ``label``."""
    values = []
    for held in held_out(period):
        mask = region(held)
        error = made.render(held.view, label).rgb[mask] - held.image[mask] / 255.0
        values.append(-10.0 * np.log10(np.square(error).mean()))
    return float(np.mean(values))


def box_of_period_1(held: Held) -> NDArray[np.bool_]:
    return trace(held.view.cam_from_world, 1)[1]


LEAN = {
    "period_dim": 4,
    "base_dim": 28,
    "merge_share": 0.01,
    "global_init": "zero",
    "trim_global": True,
}


def owners(made: ChronoGS) -> float:
    """Share of the anchors that have more than one block."""
    rows = made.model.block_rows
    return float((rows != rows[:, :1]).any(1).float().mean())


def test_where_nothing_changes_no_anchor_keeps_a_block_of_its_own() -> None:
    made = train((1, 1, 1), steps=160, **LEAN)
    assert owners(made) < 0.01
    sharing = made.sharing()
    assert sharing is not None and sharing.invariant_share == pytest.approx(1 - owners(made))
    check_sharing(sharing, made.size(), "sharing")


@pytest.mark.parametrize(
    ("periods", "decay"), [((1, 1), 3.0), pytest.param((0, 1), 0.3, marks=pytest.mark.slow)]
)
def test_a_decay_makes_periods_alike_where_their_photos_are(
    periods: tuple[int, int], decay: float
) -> None:
    options = {**LEAN, "merge_share": 0.0}
    steps = 160 if periods == (1, 1) else 300
    free, bound = (train(periods, steps=steps, period_decay=d, **options) for d in (0.0, decay))
    if periods == (1, 1):
        spread = [made.model.blocks[made.model.block_rows].std(1).mean() for made in (free, bound)]
        assert spread[1] < 0.5 * spread[0]
    for label, period in enumerate(periods):
        assert psnr(bound, period, label) > psnr(free, period, label) - 0.4
    assert psnr(bound, 1, 1, box_of_period_1) > psnr(free, 1, 1, box_of_period_1) - 1.2


def test_a_period_with_one_image_shows_what_the_others_saw() -> None:
    everything = training_set((0, 0, 0))
    kept = [i for i, v in enumerate(everything.views) if v.period != 1 or i == 30]
    assert sum(everything.views[i].period == 1 for i in kept) == 1
    views = tuple(everything.views[i] for i in kept)
    images = {n: everything.load_image(i) for n, i in enumerate(kept)}
    few = replace(everything, views=views, load_image=images.__getitem__)
    made = train(train_set=few, steps=250, **LEAN)
    assert owners(made) < 0.1
    assert psnr(made, 0, 1) > psnr(made, 0, 0) - 3.0


def test_one_period_has_one_block_for_each_anchor_and_no_global_feature() -> None:
    made = train((0,), steps=100, **LEAN)
    assert made.model.global_features.shape == (1, 0)
    assert made.model.block_rows.shape == (len(made.model), 1)
    assert len(made.model.blocks) == len(made.model)
    assert made.sharing() is None
    assert psnr(made, 0, 0) > 20.0


@pytest.mark.slow
def test_forty_periods() -> None:
    made = train((0,) * 20 + (1,) * 20, **LEAN)
    assert len(made.model.blocks) < 0.2 * made.model.block_rows.numel()
    assert psnr(made, 0, 0) > 25.0


@pytest.mark.slow
def test_what_changes_keeps_its_blocks() -> None:
    whole = train(period_dim=4, base_dim=28, global_init="zero")
    shared = train(**LEAN)
    rows, at = shared.model.block_rows, shared.model.anchors.numpy()
    kept = (rows != rows[:, :1]).any(1).numpy()
    wall = np.abs(at[:, 1] - 1.2) < 0.06
    box = ((at > BOX[0] - 0.05) & (at < BOX[1] + 0.05)).all(1)
    assert kept[wall].mean() > 1.4 * kept[~wall & ~box].mean()
    for period in (0, 1):
        assert psnr(shared, period, period) > psnr(whole, period, period) - 0.6


@pytest.mark.slow
def test_what_the_features_are_for() -> None:
    joint = train()
    whole = [psnr(joint, p, p) for p in (0, 1)]
    # One model of both periods is as good as one model each, for the same number of steps.
    separate = [psnr(train((p,), steps=STEPS // 2), p, 0) for p in (0, 1)]
    assert whole[0] > separate[0] - 1.0
    assert whole[1] > separate[1] - 1.0

    timeless = train(period_dim=0, global_dim=0)
    for p in (0, 1):
        assert psnr(timeless, p, p) < whole[p] - 4.0
    # Its box is a ghost: half there in both periods.
    for p in (0, 1):
        assert psnr(timeless, p, p, box_of_period_1) < psnr(joint, p, p, box_of_period_1) - 4.0

    no_global = train(global_dim=0)
    assert np.mean([psnr(no_global, p, p) for p in (0, 1)]) > np.mean(whole) - 3.0
