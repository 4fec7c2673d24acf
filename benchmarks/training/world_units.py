"""Effect of lengths in units of the scene, as in released code, on a training of ChronoGS.

    python -m benchmarks.training.world_units SCENE [--preset fast] [--iterations N] [--seeds 1]

Trains as if the farthest training camera were 0.5, 1, 30 and 500 units from their mean: with all
lengths in units of the training frame, whose result does not depend on that; with all of them in
units of the scene (`length_unit=world`); and with each alone. Prints PSNR on the test views.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from chronogs import SPEC
from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.harness.plan.parts import Part, make_parts
from chronoscene.harness.train.loop import render_bytes, seed_everything
from chronoscene.images.store import ImageStore
from chronoscene.kernels.runtime import keep_freed_memory, set_threads
from chronoscene.methods import build_config
from chronoscene.metrics.psnr_ssim import psnr

RADII = (0.5, 1.0, 30.0, 500.0)  # Distance of the farthest camera in units of the scene
LENGTHS = ("near_plane", "offset_lr", "scale_weight", "max_log_scale")


def variants(config: ChronoGSConfig, radius: float) -> Iterator[tuple[str, ChronoGSConfig]]:
    """Configurations in units of the training frame, by what is in units of the scene."""
    world = replace(config, length_unit="world").in_training_frame(1.0 / radius)
    yield "all four", world
    for name in LENGTHS:
        yield name, replace(config, **{name: getattr(world, name)})


def score(part: Part, config: ChronoGSConfig, seed: int) -> float:
    """Mean over periods of the mean PSNR of their test views, after a training."""
    seed_everything(seed)
    method = ChronoGS(config)
    method.setup(part.train, seed=seed, device="cpu")
    for index in range(config.iterations):
        method.step(index, index / config.iterations)
    values: dict[int, list[float]] = {}
    for frame in part.test:
        value = psnr(render_bytes(method, part, frame), part.store.load(frame))
        values.setdefault(frame.period, []).append(value)
    return float(np.mean([np.mean(of_period) for of_period in values.values()]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--seeds", type=int, default=1)
    args = parser.parse_args()
    keep_freed_memory()
    threads = set_threads()
    print(f"{processor_name()}, {threads} threads, {code_version()}, preset {args.preset}")
    scene = read_scene(args.scene)
    (part,) = make_parts(scene, ImageStore(scene), "joint")
    changes = {"iterations": args.iterations} if args.iterations else {}
    config = build_config(SPEC, preset=args.preset, overrides=changes)

    def report(radius: str, name: str, config: ChronoGSConfig) -> None:
        values = [score(part, config, seed) for seed in range(args.seeds)]
        spread = f" +- {np.std(values, ddof=1):.2f}" if len(values) > 1 else ""
        print(f"{radius:>6}  {name:<14} {np.mean(values):6.2f}{spread} dB", flush=True)

    report("any", "none", config)
    for radius in RADII:
        for name, changed in variants(config, radius):
            if changed != config:
                report(f"{radius:g}", name, changed)


if __name__ == "__main__":
    main()
