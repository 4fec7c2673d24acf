"""Trainings at the extremes of what a scene may be, through the harness, and what becomes of them.

The scenes are those of `tiny_training`, in world coordinates, so that the frame of the training is
found as for any scene.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import ChronoSceneError
from chronoscene.harness.plan.parts import Part, effective_strategy, make_parts
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.train import painted_balls
from chronoscene.harness.train.loop import render_bytes, train
from chronoscene.methods import Method, MethodSpec, StepReport, build_config, import_object
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Camera, Frame, Period, Points, Scene

ROUNDS = 10  # Of density control in a whole training; growth ends halfway


@dataclass(frozen=True)
class Extreme:
    """What differs from a scene of 3 periods with 5 photos of 40 x 30 px each and 280 points."""

    name: str
    periods: int = 3
    photos: int | tuple[int, ...] = 5
    """Per period, or those of each."""
    points: int = 280
    points_apart: bool = True
    cameras_apart: bool = True
    origin: float = 0.0
    """Distance of the scene from the origin of the world, in radii of the ring of cameras."""
    unit: float = 1.0
    """Radius of the ring of cameras in the world."""
    size: float = 1.0
    """Of the photos; times 40 x 30 px."""
    level: int | None = None
    """Value of all pixels of all photos, instead of a picture."""
    rates: float = 1.0
    """Factor of all learning rates."""
    steps: int = 100
    advice: str | None = None
    """Part of the message of an error in which a training may end."""
    cheap: bool = True
    """False for those that the tests leave to the benchmark."""

    @property
    def counts(self) -> tuple[int, ...]:
        """Photos of each period."""
        photos = self.photos
        return photos if isinstance(photos, tuple) else (photos,) * self.periods


EXTREMES = (
    Extreme("none of them"),
    Extreme("1 period", periods=1),
    Extreme("2 periods", periods=2),
    Extreme("40 periods of 2 photos", periods=40, photos=2),
    Extreme("300 periods of 2 photos", periods=300, photos=2, cheap=False),
    Extreme("1,000 periods of 2 photos", periods=1000, photos=2, cheap=False),
    Extreme("3 periods of 1 photo", photos=1),
    Extreme("1 photo beside 500", periods=2, photos=(1, 500), cheap=False),
    # Their Gaussians are so large that density control splits or prunes them all.
    Extreme("3 points", points=3, advice="check that the sparse points"),
    Extreme("1,000,000 points", points=1_000_000, steps=1, cheap=False),
    Extreme("all points in one place", points_apart=False, advice="triangulate"),
    Extreme("all cameras in one place", cameras_apart=False),
    Extreme("1,000,000 units from the origin", origin=1e6),
    Extreme("a scene of 1,000,000 m", unit=1e6),
    Extreme("a scene of 0.001 m", unit=1e-3),
    Extreme("photos of 16 x 12 px", size=0.4),
    Extreme("photos of 64 x 48 px", size=1.6),
    Extreme("photos of 4,000 x 3,000 px", size=100.0, steps=4, cheap=False),
    Extreme("black photos", level=0, advice="check that the sparse points"),
    Extreme("white photos", level=255),
    # A step that is too long may leave a model that no view shows.
    Extreme("learning rates times 100", rates=100.0, advice="lower the learning rates"),
)


@dataclass(frozen=True)
class Outcome:
    """What became of a training."""

    error: str | None
    """Why there is no model; None if there is."""
    clear: bool
    """Whether the error, if any, is one that is meant for the user."""
    reports: tuple[StepReport, ...]
    before: float
    """PSNR of one to three training views as the training starts, in dB."""
    after: float
    """The same at its end; NaN without a model."""
    seconds: float


class Photos:
    """Takes the place of the store of images: pictures in memory."""

    waited = 0.0

    def __init__(self, images: dict[str, NDArray[np.uint8]]) -> None:
        self.images = images

    def camera(self, frame: Frame) -> Camera:
        return frame.camera

    def load(self, frame: Frame) -> NDArray[np.uint8]:
        return self.images[frame.name]

    def load_mask(self, frame: Frame) -> None:
        return None

    def expect(self, frames: Sequence[Frame]) -> None:
        """All are at hand."""


@lru_cache(maxsize=1)
def make_scene(extreme: Extreme) -> tuple[Scene, Photos]:
    """The scene and its photos."""
    centres, radii, colors = painted_balls.make_balls(extreme.periods)
    offset = extreme.unit * np.array([extreme.origin, 0.0, 0.0])
    painted_size = min(extreme.size, 1.0)
    repeats = round(extreme.size / painted_size)
    frames: list[Frame] = []
    images: dict[str, NDArray[np.uint8]] = {}
    shots = [(period, i) for period, count in enumerate(extreme.counts) for i in range(count)]
    for index, (period, number) in enumerate(shots):
        name = f"{period:04}_{number:04}.png"
        share = (number + period / max(extreme.periods, 2)) / extreme.counts[period]
        view = painted_balls.make_view(2 * np.pi * share, period, name)
        if not extreme.cameras_apart:
            # Turned a little about the centre of the first one.
            view = painted_balls.make_view(0.3 * share, period, name)
            first = painted_balls.make_view(0.0, 0, "").cam_from_world
            view.cam_from_world[:3, 3] = (
                view.cam_from_world[:3, :3] @ first[:3, :3].T @ first[:3, 3]
            )
        K = np.diag([painted_size, painted_size, 1.0]) @ view.K
        width, height = round(view.width * painted_size), round(view.height * painted_size)
        view = dataclasses.replace(view, K=K, width=width, height=height)
        image = painted_balls.paint(view, centres, radii, colors[period])
        if extreme.level is not None:
            image[:] = extreme.level
        images[name] = image.repeat(repeats, axis=0).repeat(repeats, axis=1)
        params = repeats * np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        camera = Camera(1, "PINHOLE", width * repeats, height * repeats, tuple(params.tolist()))
        pose = view.cam_from_world.copy()
        pose[:3, 3] *= extreme.unit
        pose[:3, 3] -= pose[:3, :3] @ offset
        frames.append(Frame(name, index, camera, pose, period, "train"))
    # The harness tests some of the training views.
    tested = {0, len(frames) // 2, len(frames) - 1} if extreme.steps > 1 else {0}
    for index in sorted(tested):
        name = f"test_{frames[index].name}"
        images[name] = images[frames[index].name]
        frames.append(dataclasses.replace(frames[index], name=name, split="test"))
    rng = np.random.default_rng(12)
    ball = np.arange(extreme.points) % len(centres)
    xyz = centres[ball] + rng.normal(0, 0.4, (len(ball), 3)) * radii[ball, None]
    seen = np.cumsum((0, *extreme.counts[:-1]), dtype=np.int32)
    points = Points(
        ids=np.arange(len(ball)),
        xyz=xyz * extreme.points_apart * extreme.unit + offset,
        rgb=np.rint(255 * colors[0][ball]).astype(np.uint8),
        error=np.zeros(len(ball)),
        track_start=np.arange(len(ball) + 1) * extreme.periods,
        track_frame=np.tile(seen, len(ball)),
        track_xy=np.zeros((len(ball) * extreme.periods, 2)),
    )
    scene = Scene(
        name=extreme.name,
        root=Path(),
        images_root=Path(),
        frames=tuple(frames),
        points=points,
        periods=tuple(Period(i, str(i)) for i in range(extreme.periods)),
        split_rule="",
        format="",
    )
    return scene, Photos(images)


def make_part(extreme: Extreme, spec: MethodSpec) -> Part:
    """The scene as the method gets it."""
    scene, photos = make_scene(extreme)
    strategy, _ = effective_strategy(spec, "joint")
    store: Any = photos
    return make_parts(scene, store, strategy)[0]


def make_config(extreme: Extreme, spec: MethodSpec, preset: str) -> Any:
    """The preset with its whole schedule in few steps, and other learning rates, if so wanted."""
    options = {f.name for f in dataclasses.fields(import_object(spec.config))}
    overrides: dict[str, Any] = {"iterations": extreme.steps}
    for interval in options & {"density_interval", "densify_interval"}:
        overrides[interval] = max(1, extreme.steps // ROUNDS)
    if "stretch" in options:
        overrides["stretch"] = True
    config = build_config(spec, preset=preset, overrides=overrides)
    rates = {name: getattr(config, name) for name in options if "_lr" in name or "_rate" in name}
    return dataclasses.replace(
        config,
        **{
            name: tuple(extreme.rates * x for x in rate)
            if isinstance(rate, tuple)
            else extreme.rates * rate
            for name, rate in rates.items()
        },
    )


def score(method: Method, part: Part) -> float:
    """Mean PSNR of the training views that `make_part` gives as test views."""
    load: Any = part.store.load
    return float(np.mean([psnr(render_bytes(method, part, f), load(f)) for f in part.test]))


def run(extreme: Extreme, spec: MethodSpec, preset: str) -> Outcome:
    """Train one method as the harness does."""
    reports: list[StepReport] = []
    error, clear = None, True
    before = after = math.nan
    started = time.perf_counter()
    try:
        part, config = make_part(extreme, spec), make_config(extreme, spec, preset)
        method: Method = import_object(spec.method)(config)
        method.setup(part.train, seed=0, device="cpu")
        before = score(method, part)
        method = import_object(spec.method)(config)
        train(
            method,
            part,
            StopRule(extreme.steps, None),
            {f.name: (part.store.load(f), None) for f in part.test},
            seed=0,
            device="cpu",
            observer=lambda done, seconds, report, probe: reports.append(report),
        )
        after = score(method, part)
    except Exception as failure:  # the table has a line for it
        error, clear = str(failure), isinstance(failure, ChronoSceneError)
        if not clear:
            error = f"{type(failure).__name__}: {error}"
    return Outcome(error, clear, tuple(reports), before, after, time.perf_counter() - started)
