"""Short trainings on painted balls.

``python -m chronoscene.harness.contract.tiny_training OUT METHOD ...`` trains in a process of its
own and saves each model in a folder of OUT with the name of its method.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from chronoscene.harness.files.predictions import encode_png
from chronoscene.harness.plan.parts import effective_strategy, make_parts
from chronoscene.harness.train.loop import seed_everything
from chronoscene.harness.train.painted_balls import VIEWS_PER_PERIOD, make_training_set
from chronoscene.images.store import ImageStore
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import (
    Method,
    MethodConfig,
    MethodSpec,
    StepReport,
    TrainingSet,
    build_config,
    load_spec,
    make_method,
)
from chronoscene.scene import Camera, Frame, Period, Points, Scene, Split

STEPS = 120


def make_stage(period: int, *, hide_period: bool) -> TrainingSet:
    """Return one of three periods, as the strategy ``sequential`` gives them."""
    data = make_training_set(3)
    own = [i for i, view in enumerate(data.views) if view.period == period]
    known = 1 if hide_period else period + 1
    stage = data.with_views(own)
    return replace(
        stage,
        views=tuple(replace(view, period=known - 1) for view in stage.views),
        num_periods=known,
        point_periods=data.point_periods[:, :known],
    )


def training_set_on_disk(spec: MethodSpec, root: Path, *, noisy_tests: bool) -> TrainingSet:
    """Make the training set of a scene on disk, as bench does, with a test view per period.

    Args:
        spec: The method; periods are hidden if it takes none.
        root: Folder for the photos; files of the same names are replaced.
        noisy_tests: Replace the test photos by noise.
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
    """Return the number of periods: three, or one if the method takes none."""
    return 1 if spec.period_input == "none" else 3


def small_config(spec: MethodSpec) -> MethodConfig:
    """Return the config for short trainings."""
    preset = "fast" if "fast" in spec.presets else sorted(spec.presets)[0]
    return build_config(spec, preset=preset, overrides={"iterations": STEPS})


def train(
    spec: MethodSpec,
    data: TrainingSet,
    *,
    seed: int = 0,
    threads: int = 1,
    steps: int = STEPS,
    probe: bool = False,
) -> tuple[Method, list[StepReport]]:
    """Train as the harness does; ``probe`` renders now and then in between.

    So small a scene is quicker on one thread.
    """
    set_threads(threads)
    seed_everything(seed)
    method = make_method(spec, small_config(spec))
    method.setup(data, seed=seed, device="cpu")
    reports = []
    for index in range(steps):
        reports.append(method.step(index, index / steps))
        if probe and index % 25 == 3:
            method.render(data.views[0], 0.0)
    return method, reports


def main() -> None:
    """Train methods, probing, and save them."""
    out = Path(sys.argv[1])
    for name in sys.argv[2:]:
        spec = load_spec(name)
        method, _ = train(spec, make_training_set(periods_for(spec)), probe=True)
        (out / spec.name).mkdir()
        method.save(out / spec.name)


if __name__ == "__main__":
    main()
