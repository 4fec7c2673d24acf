"""Milliseconds to draw a view of a finished run: the Gaussians of each period made once, or anew.

    python -m benchmarks.methods.consecutive_views RUN... [--threads 1] [--rounds 5]

RUN is the folder of a seed of a method with explicit Gaussians, with one model. All views of a
period are drawn before those of the next, as evaluation does; a round draws all of them both ways,
in turns. Prints medians over rounds of the mean over the views, and their ratio.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from chronoscene.errors import ChronoSceneError, ConfigError
from chronoscene.gaussians.method import GaussianMethod
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.harness.use.trained_run import open_run
from chronoscene.kernels.runtime import set_threads


def measure(folder: Path, rounds: int) -> tuple[int, float, float]:
    """Return the number of Gaussians, and the milliseconds of a view: made once, made anew.

    Raises:
        ConfigError: If the run has no explicit Gaussians.
    """
    run = open_run(folder)
    scene = run.scene()
    frames = sorted(scene.select(split="test"), key=lambda frame: frame.period)
    method = run.model(0)
    if not isinstance(method, GaussianMethod):
        raise ConfigError(
            str(folder),
            expected="a method with explicit Gaussians",
            found=run.record.method,
            todo="give a run of 3dgs, 4dgs, realtime4dgs or cl-splats",
        )
    views = run.frame_views(scene, frames)
    method.render(views[0], frames[0].period)  # Compile, touch memory.
    spent: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(rounds):
        for kept, times in spent.items():
            method.model.is_final = kept
            start = time.perf_counter()
            for view, frame in zip(views, frames, strict=True):
                method.render(view, frame.period)
            times.append(1e3 * (time.perf_counter() - start) / len(views))
    once, anew = (float(np.median(times)) for times in spent.values())
    return method.size().primitives, once, anew


def main() -> None:
    """Measure all runs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    set_threads(args.threads)
    print(f"{processor_name()}, {args.threads} thread(s), commit {code_version()}")
    for folder in args.runs:
        try:
            count, once, anew = measure(folder, args.rounds)
        except ChronoSceneError as error:
            parser.error(str(error))
        print(f"{folder}: {count} Gaussians, once {once:.1f} ms, anew {anew:.1f} ms", end="")
        print(f", ratio {anew / once:.2f}")


if __name__ == "__main__":
    main()
