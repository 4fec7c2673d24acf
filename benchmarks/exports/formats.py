"""Size and PSNR of each format of `chronoscene export`, measured by other readers and a renderer.

    python -m benchmarks.exports.formats RUN [--period P] [--for plain|antialiased]

Each file is read by `benchmarks.exports.readers` and drawn on the test views of the period by
`benchmarks.exports.plain_renderer`, beside what the command prints. Values are means over views.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.exports import plain_renderer, readers
from chronoscene import Scene, TrainedRun, open_run
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.use.export import make_file, prepare
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files import SUFFIXES


def measure(run: TrainedRun, scene: Scene, period: int, cloud: GaussianCloud) -> float:
    """Compute the mean PSNR of Gaussians, in the frame of the scene, without the filter."""
    store = run.photos(scene)
    model: Any = run.model(period)
    near_plane = model.config.near_plane / run.training_from_world.scale
    background = model.background.double().numpy()
    values = []
    for frame in scene.select(split="test", period=period):
        camera = store.camera(frame)
        image = plain_renderer.render(
            cloud,
            camera.K,
            frame.cam_from_world,
            (camera.width, camera.height),
            background=background,
            near_plane=near_plane,
        )
        values.append(psnr(to_bytes(image), store.load(frame), store.load_mask(frame)))
    return float(np.mean(values))


def main() -> None:
    """Print a row of a table per format."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--period", type=int, default=0)
    parser.add_argument("--for", dest="viewers", choices=["plain", "antialiased"])
    arguments = parser.parse_args()
    run, period = open_run(arguments.run), arguments.period
    scene = run.scene()
    prepared = prepare(run, scene, period, arguments.viewers)
    assert not prepared.offset.any()
    print(f"{len(prepared.cloud):,} Gaussians, antialiased: {prepared.antialiased}")
    print("| format | MB | without the filter [dB] | other renderer [dB] | with it [dB] | model |")
    with tempfile.TemporaryDirectory() as folder:
        for kind, suffix in SUFFIXES.items():
            made = make_file(run, scene, period, prepared, kind)
            file = Path(folder, f"a{suffix}")
            file.write_bytes(made.data)
            other = measure(run, scene, period, readers.read(file))
            loss = made.loss
            assert loss is not None
            filtered = "" if loss.filtered is None else f"{loss.filtered:.2f}"
            print(
                f"| {kind} | {len(made.data) / 1e6:.2f} | {loss.plain:.2f} | {other:.2f} "
                f"| {filtered} | {loss.model:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
