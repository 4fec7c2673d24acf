"""Milliseconds of a training step of 4DGS, realtime4DGS and GS-W beside one of 3DGS.

    python -m benchmarks.methods.deformation_step [--gaussians 60000] [--size 320 240] [--steps 100]

All methods train on the same generated surfaces and photos, with equal Gaussians, in turns, in the
second stage of 4DGS and with all colours; no round of density control falls into what is timed.
Prints median and minimum of the wall time, the median of the processor time of all threads, and the
ratio of each to that of 3DGS. On a machine with other work look at the minimum and the processor
time.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch

from benchmarks.training.generated import PROGRESS, make, training_set
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.kernels.runtime import available_threads, keep_freed_memory, set_threads
from chronoscene.methods import Method

PLAIN = {"deform_opacity": False, "deform_color": False}
CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "3dgs": ("3dgs", "balanced", {}),
    "4dgs fast": ("4dgs", "fast", {}),
    "4dgs balanced": ("4dgs", "balanced", {}),
    "4dgs balanced, shape only": ("4dgs", "balanced", PLAIN),
    "realtime4dgs balanced": ("realtime4dgs", "balanced", {}),
    "gs-w fast": ("gs-w", "fast", {}),
    "gs-w balanced": ("gs-w", "balanced", {}),
}
"""Name: method, preset, options."""


def measure(methods: dict[str, Method], steps: int) -> dict[str, list[tuple[float, float]]]:
    """Wall and processor milliseconds of each step, the methods in turns."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
    for index in range(steps):
        for name, method in methods.items():
            wall, processor = time.perf_counter(), time.process_time()
            method.step(index, PROGRESS + 0.1 * index / steps)
            spent = time.perf_counter() - wall, time.process_time() - processor
            found[name].append((1e3 * spent[0], 1e3 * spent[1]))
    return found


def main() -> None:
    """Time all cases, with one thread and with all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("W", "H"))
    parser.add_argument("--steps", type=int, default=100, help="timed steps of each method")
    args = parser.parse_args()
    keep_freed_memory()
    train = training_set(args.gaussians, *args.size)
    methods = {name: make(train, *case) for name, case in CASES.items()}
    print(f"{processor_name()}, torch {torch.__version__}, commit {code_version()}")
    width, height = args.size
    print(f"{args.gaussians} Gaussians, {width}x{height}")
    for threads in sorted({1, available_threads()}):
        set_threads(threads)
        measure(methods, 5)  # Compile, touch memory.
        found = measure(methods, args.steps)
        head = f"{threads} thread(s), ms per step"
        print(f"\n{head:<30}{'median':>9}{'min':>9}{'cpu':>9}{'beside 3dgs':>24}")
        base = [0.0]
        for name, spent in found.items():
            wall, processor = np.array(spent).T
            row = [np.median(wall), wall.min(), np.median(processor)]
            base = row if name == "3dgs" else base
            ratios = "".join(f"{a / b:8.2f}" for a, b in zip(row, base, strict=True))
            print(f"{name:<30}" + "".join(f"{value:9.1f}" for value in row) + ratios)


if __name__ == "__main__":
    main()
