"""Quality and time of trainings with 1, 2 and 4 views to a step.

    python -m benchmarks.training.views_per_step SCENE [--preset fast] [--seeds 3]
    python -m benchmarks.training.views_per_step --generated 20000 --size 320 240 --threads 1 2

The first is of quality by computing time. Part of the training views are held back, and the PSNR is
on these; the test views are not used. The time is that of the processor, so other work on the
machine does not count: one thread, and no time for what several would do at once.

The second is of time alone, on so many generated points: milliseconds of a view, median and minimum
over the steps, and milliseconds of computing for it. All numbers of threads and views take turns.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.training.generated import PROGRESS, make, training_set
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.harness.plan.parts import Part, make_parts
from chronoscene.harness.train.loop import Stopwatch, render_bytes, seed_everything
from chronoscene.images.store import ImageStore
from chronoscene.kernels.runtime import keep_freed_memory, set_threads
from chronoscene.methods import (
    Method,
    MethodConfig,
    build_config,
    import_object,
    load_spec,
    method_names,
)
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene.split_making import hold_out_validation

SHARES = (0.25, 0.5, 1.0)
"""Shares of the training after which views are rendered."""


def score(method: Method, part: Part) -> float:
    """Mean over periods of the mean PSNR of the views that were held back."""
    values: dict[int, list[float]] = {}
    for frame in part.test:
        value = psnr(render_bytes(method, part, frame), part.store.load(frame))
        values.setdefault(frame.period, []).append(value)
    return float(np.mean([np.mean(of_period) for of_period in values.values()]))


def curve(part: Part, make: type[Method], config: MethodConfig, seed: int) -> list[float]:
    """Seconds and PSNR of a training at each of the `SHARES`, and anchors or Gaussians."""
    seed_everything(seed)
    method, index, clock = make(config), 0, Stopwatch(time.process_time)
    method.setup(part.train, seed=seed, device="cpu")
    found: list[float] = []
    for share in SHARES:
        with clock:
            while index < share * config.iterations:
                index += method.step(index, index / config.iterations).views
        found += [clock.seconds, score(method, part)]
    return [*found, method.size().primitives]


def time_steps(args: argparse.Namespace) -> None:
    """Time steps on generated points and print a line for each number of threads and of views."""
    train = training_set(args.generated, *args.size)
    methods = {
        views: make(train, args.method, args.preset, {"views_per_step": views})
        for views in args.views
    }
    found = defaultdict[tuple[int, int], list[tuple[float, float]]](list)
    for turn in range(args.steps + 2):
        for threads, (views, method) in product(args.threads, methods.items()):
            set_threads(threads)
            wall, computed = time.perf_counter(), time.process_time()
            seen = method.step(100 + 4 * turn, PROGRESS).views
            spent = time.perf_counter() - wall, time.process_time() - computed
            if turn > 1:  # the first ones compile and touch memory
                found[threads, views].append((1e3 * spent[0] / seen, 1e3 * spent[1] / seen))
    print(f"{args.generated:,} points, {args.size[0]}x{args.size[1]}, {args.steps} steps of each")
    print("threads views   ms of a view: median, minimum   computing")
    for (threads, views), times in found.items():
        walls, computing = zip(*times, strict=True)
        cells = f"{median(walls):22.2f}{min(walls):10.2f}{median(computing):12.2f}"
        print(f"{threads:7}{views:6}{cells}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--generated", type=int, metavar="POINTS", help="instead of a scene")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("W", "H"))
    parser.add_argument("--threads", type=int, nargs="+", default=(1, 2))
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--method", default="chronogs", choices=method_names())
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--views", type=int, nargs="+", default=(1, 2, 4))
    args = parser.parse_args()
    if (args.scene is None) == (args.generated is None):
        parser.error("name a scene, or --generated")
    keep_freed_memory()
    print(f"{processor_name()}, commit {code_version()}, {args.method} {args.preset}")
    if args.generated:
        time_steps(args)
        return
    set_threads(1)
    scene = hold_out_validation(read_scene(args.scene))
    (part,) = make_parts(scene, ImageStore(scene), "joint")
    spec = load_spec(args.method)
    print("views" + "".join(f"{f'seconds, dB at {share:.0%}':>24}" for share in SHARES))
    for views in args.views:
        config = build_config(spec, preset=args.preset, overrides={"views_per_step": views})
        rows = [curve(part, import_object(spec.method), config, n) for n in range(args.seeds)]
        *means, size = np.mean(rows, axis=0)
        spreads = np.std(rows, axis=0, ddof=1) if len(rows) > 1 else np.zeros(len(rows[0]))
        pairs = zip(means[::2], means[1::2], spreads[1::2], strict=True)
        cells = "".join(f"{s:11.1f} {dB:6.2f} ±{d:4.2f}" for s, dB, d in pairs)
        print(f"{views:5}{cells}   {size:.0f} primitives", flush=True)


if __name__ == "__main__":
    main()
