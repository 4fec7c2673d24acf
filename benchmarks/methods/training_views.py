"""PSNR of finished runs on their training views beside that on their test views.

    python -m benchmarks.methods.training_views RUN... [--every N]

Renders every N-th training view, and all test views, at their own periods. Values are means over
the periods of their means over views.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from chronoscene import Scene, TrainedRun, open_run
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Split


def macro_psnr(run: TrainedRun, scene: Scene, split: Split, every: int) -> float:
    """Return the mean over periods of the mean PSNR over views of a split, in dB."""
    store = run.photos(scene)
    values: dict[int, list[float]] = defaultdict(list)
    for frame in scene.select(split=split)[::every]:
        image = run.render(store.camera(frame), frame.cam_from_world, frame.period).rgb
        mask = store.load_mask(frame)
        if mask is None or mask.any():
            values[frame.period].append(psnr(to_bytes(image), store.load(frame), mask))
    return float(np.mean([np.mean(of_period) for of_period in values.values()]))


def main() -> None:
    """Print one line per run."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    parser.add_argument("--every", type=int, default=3, help="render every N-th training view")
    arguments = parser.parse_args()
    print("test, dB | training, dB | difference | run")
    for folder in arguments.runs:
        run = open_run(folder)
        scene = run.scene()
        test = macro_psnr(run, scene, "test", 1)
        training = macro_psnr(run, scene, "train", arguments.every)
        print(f"{test:.2f} | {training:.2f} | {training - test:.2f} | {folder}")


if __name__ == "__main__":
    main()
