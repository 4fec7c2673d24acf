"""Limits that the processor sets to the CPU rasterizer, and how near to them it is.

    python -m benchmarks.rasterizer.limits [--repeats 9]

Measures the rates of vector multiply-adds, and of reading and writing memory, then the stages of
an image and its gradients; all on one thread, in processor time of that thread, medians. Stages
that composite are bound by arithmetic: "at least" is the time of their vector instructions at the
rate of multiply-adds, were there nothing else to do. The others move memory: there it is that of
the bytes that they read and write once, at the rates of long runs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core import cgutils

from benchmarks.rasterizer.scenes import SIZES, Scene, surfaces
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.kernels.compilation import kernel
from chronoscene.kernels.memory import emit_address, emit_load, emit_store
from chronoscene.kernels.runtime import keep_freed_memory, set_threads
from chronoscene.kernels.vectors import LANES, emit_multiply_add, emitted
from chronoscene.rasterizer.cpu import layout
from chronoscene.rasterizer.cpu.passes import Rendering
from chronoscene.rasterizer.inputs import Inputs

INSTRUCTIONS = {"composite": 25, "composite, backward": 44}
"""Vector instructions for a block of 16 pixels without loads and stores, counted in the machine
code for AVX-512."""
GAUSSIAN_BYTES = 14 * 4
"""Means, quaternions, scales, opacities and colours."""
CHAINS = 16
"""Sums that do not depend on each other: they hide the latency of an instruction."""
ROUNDS = 2_000_000
MEMORY = 64 << 20
"""Numbers that are read and written; more than fit into a cache."""

Times = dict[str, float]
"""Seconds by stage."""


class Work(NamedTuple):
    """Amount of work in an image."""

    listed: int
    """Pairs of a Gaussian and a tile that it touches."""
    entries: int
    """Pairs of which something is composited."""
    blocks: int
    """Blocks of 16 pixels of these."""


@emitted(lambda numbers, count: types.void(numbers, types.intp))
def _add_products(context: Any, builder: Any, signature: Any, args: Any) -> None:
    """Add a product to each of `CHAINS` vectors, ``count`` times."""

    def place(index: int) -> Any:
        at = args[1].type(index * LANES)
        return emit_address(context, builder, signature.args[0], args[0], at)

    sums = [cgutils.alloca_once_value(builder, emit_load(builder, place(i))) for i in range(CHAINS)]
    a, b = (emit_load(builder, place(CHAINS + i)) for i in range(2))
    with cgutils.for_range(builder, args[1]):
        for total in sums:
            builder.store(emit_multiply_add(builder, builder.load(total), a, b), total)
    for i, total in enumerate(sums):
        emit_store(builder, builder.load(total), place(i))


@kernel
def _many_products(numbers, count):  # type: ignore[no-untyped-def]
    _add_products(numbers, count)


def seconds(function: Callable[[], object], repeats: int) -> float:
    """Median processor time of this thread."""
    found = []
    for _ in range(repeats + 1):  # the first compiles and touches memory
        start = time.thread_time()
        function()
        found.append(time.thread_time() - start)
    return median(found[1:])


def measure_rates(repeats: int) -> tuple[float, float, float]:
    """Vector multiply-adds, bytes read and bytes written in a second."""
    numbers = np.full((CHAINS + 2) * LANES, 0.5, np.float32)
    products = CHAINS * ROUNDS / seconds(lambda: _many_products(numbers, ROUNDS), repeats)
    memory = np.ones(MEMORY, np.float32)
    read = memory.nbytes / seconds(memory.max, repeats)
    written = memory.nbytes / seconds(lambda: memory.fill(1.0), repeats)
    return products, read, written


class Stages:
    """One scene, stage by stage."""

    def __init__(self, scene: Scene) -> None:
        self.width, self.height = scene.width, scene.height
        self.gaussians: Any = tuple(x.detach().numpy().reshape(-1) for x in scene.gaussians)
        self.count = len(scene.gaussians[0])
        inputs = Inputs(*scene.gaussians, scene.viewmats, scene.Ks, self.width, self.height)
        pose, intrinsics = (x[0].double().numpy() for x in (scene.viewmats, scene.Ks))
        self.view = layout.make_view(pose, intrinsics, inputs)
        self.image_grad = scene.image_grad.numpy().reshape(-1)
        shapes = (3, 4, 3, 1, 3, 2)
        self.grads = tuple(np.empty(self.count * k, np.float32) for k in shapes)
        self.visible: Any = tuple(np.empty(self.count * k, np.float32) for k in (2, 2, 1))

    def run(self) -> tuple[Times, Work]:
        """Time all stages once."""
        pixels, background = self.width * self.height, np.zeros(3, np.float32)
        image, alphas = np.empty(3 * pixels, np.float32), np.empty(pixels, np.float32)
        nothing, times, rendering = np.empty(0, np.float32), {}, Rendering(self.view)
        clock = [time.thread_time()]

        def lap(stage: str) -> None:
            clock.append(time.thread_time())
            times[stage] = clock[-1] - clock[-2]

        rendering.bin_gaussians(self.gaussians, self.visible)
        lap("project, sort, list")
        rendering.composite(background, image, alphas)
        lap("composite")
        summed = rendering.composite_backward(background, self.image_grad, nothing, absgrad=False)
        lap("composite, backward")
        rendering.gaussian_gradients(self.gaussians, summed, self.grads)
        lap("project, backward")
        return times, work_of(rendering)

    def least(self, work: Work, rates: tuple[float, float, float]) -> Times:
        """Seconds of each stage that the measured rates allow."""
        products, read, written = rates
        record, entry = 4 * layout.RECORD, 8 * layout.ENTRY_BLOCKS
        # Gaussians, records and keys; a list of pairs, which is written twice and read once.
        found = {
            "project, sort, list": self.count * (GAUSSIAN_BYTES + record) / read
            + (self.count * (record + 20) + work.listed * (2 * entry + 4)) / written
            + work.listed * (entry + 4) / read,
            "project, backward": (work.entries * record + self.count * GAUSSIAN_BYTES) / read
            + self.count * (GAUSSIAN_BYTES + 8) / written,
        }
        vectors = work.blocks * 16 / layout.LANES
        return found | {stage: vectors * n / products for stage, n in INSTRUCTIONS.items()}


def work_of(rendering: Rendering) -> Work:
    """Count what was composited."""
    starts, stops, _ = rendering.tiles
    words = rendering.entries[0][:: layout.ENTRY_BLOCKS]
    counts = np.concatenate(
        [np.bitwise_count(words[a:b]) for a, b in zip(starts[:-1], stops, strict=True)]
    )
    return Work(int(starts[-1]), int(np.count_nonzero(counts)), int(counts.sum()))


def main() -> None:
    """Print rates, and a table for each size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    keep_freed_memory()
    set_threads(1)
    rates = measure_rates(args.repeats)
    print(f"{processor_name()}, commit {code_version()}, 1 thread, vectors of {LANES} numbers")
    products, read, written = (rate / 1e9 for rate in rates)
    print(f"{products:.2f} G vector multiply-adds/s, {read:.0f} and {written:.0f} GB/s of memory")
    for count, width, height in SIZES:
        stages = Stages(surfaces(count, width, height))
        stages.run()
        runs = [stages.run() for _ in range(args.repeats)]
        work = runs[0][1]
        least = stages.least(work, rates)
        print(f"\n{count:,} Gaussians, {width}x{height}, {work.listed:,} pairs with tiles,")
        print(f"of which {work.entries:,} are composited in {work.blocks:,} blocks")
        print(f"{'stage':<22}{'ms':>8}{'at least':>10}{'share':>8}")
        times = {stage: median(found[stage] for found, _ in runs) for stage in runs[0][0]}
        total = sum(times.values())
        for stage, value in times.items():
            floor = least[stage]
            print(f"{stage:<22}{1e3 * value:8.1f}{1e3 * floor:10.1f}{floor / value:8.0%}")
        print(f"{'all':<22}{1e3 * total:8.1f}{1e3 * sum(least.values()):10.1f}", end="")
        print(f"{sum(least.values()) / total:8.0%}")


if __name__ == "__main__":
    main()
