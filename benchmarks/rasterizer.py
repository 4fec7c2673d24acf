"""Times of the CPU rasterizer on scenes of points on surfaces.

    python benchmarks/rasterizer.py [--repeats 30] [--largest 4] [--no-reference]

Prints milliseconds of rasterize() and of rasterize() with backward(), as the caller sees them:
checks off, new output tensors every time, gradients of all inputs. On a machine with other work
look at the minimum. The last line compares with the vectorised torch reference at the smallest
size, in the same run.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from chronoscene.rasterizer import rasterize
from chronoscene.threads import available_threads, set_threads

SIZES = ((20_000, 256, 256), (100_000, 400, 300), (200_000, 800, 600), (1_000_000, 1600, 1200))


@dataclass(frozen=True)
class Scene:
    """Arguments of one rendering, and the gradient that comes back from a loss."""

    gaussians: list[torch.Tensor]
    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int
    image_grad: torch.Tensor


def surfaces(count: int, width: int, height: int, seed: int = 0) -> Scene:
    """Flat Gaussians on eight overlapping spheres, as large as the distance between them."""
    g = np.random.default_rng(seed)
    spheres = 8
    centres = g.uniform(-1, 1, (spheres, 3)) * [1.2, 0.9, 0.6] + [0, 0, 4]
    radii = g.uniform(0.4, 1.0, spheres)
    which = g.integers(0, spheres, count)
    directions = g.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    spacing = np.sqrt(4 * np.pi * radii[which] ** 2 / (count / spheres))
    scales = 0.9 * spacing[:, None] * np.exp(g.normal(0, 0.4, (count, 3))) * [1, 1, 0.5]
    focal = 1.1 * width
    arrays = (
        centres[which] + directions * radii[which, None],
        g.normal(size=(count, 4)),
        scales,
        g.uniform(0.1, 0.99, count),
        g.uniform(0, 1, (count, 3)),
    )
    return Scene(
        [torch.tensor(x, dtype=torch.float32).requires_grad_() for x in arrays],
        torch.eye(4)[None],
        torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]]),
        width,
        height,
        torch.tensor(g.normal(size=(1, height, width, 3)), dtype=torch.float32),
    )


def render(scene: Scene, backend: str, backward: bool) -> None:
    """One image, and its gradients if asked for."""
    for x in scene.gaussians:
        x.grad = None
    with torch.set_grad_enabled(backward):
        means, quats, scales, opacities, colors = scene.gaussians
        result = rasterize(
            means,
            quats,
            scales,
            opacities,
            colors,
            scene.viewmats,
            scene.Ks,
            scene.width,
            scene.height,
            backend=backend,
            check_finite=False,
        )
        if backward:
            result.image.backward(scene.image_grad)


def milliseconds(function: Callable[[], None], repeats: int) -> tuple[float, float]:
    """Median and minimum wall time after two runs that are not counted."""
    times = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times[2:])), min(times[2:])


def processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def table(sizes: tuple[tuple[int, int, int], ...], threads: list[int], repeats: int) -> float:
    """Print one line per size and number of threads. Returns the best time at the first size."""
    print(f"{'Gaussians':>10} {'image':>10} {'threads':>7}  {'forward':>15}  {'and backward':>15}")
    print(f"{'':>10} {'':>10} {'':>7}  {'median':>7} {'min':>7}  {'median':>7} {'min':>7}")
    best = float("inf")
    for count, width, height in sizes:
        scene = surfaces(count, width, height)
        for number in threads:
            set_threads(number)
            times = [
                milliseconds(partial(render, scene, "cpu", backward), repeats)
                for backward in (False, True)
            ]
            cells = "  ".join(f"{median:7.1f} {low:7.1f}" for median, low in times)
            print(f"{count:>10} {f'{width}x{height}':>10} {number:>7}  {cells}", flush=True)
            if count == sizes[0][0]:
                best = min(best, times[1][1])
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=30, help="counted runs of each")
    parser.add_argument("--largest", type=int, default=len(SIZES), help="how many of the sizes")
    parser.add_argument("--no-reference", action="store_true", help="leave out the reference")
    options = parser.parse_args()
    available = available_threads()
    threads = sorted({1, min(2, available), available})
    policy = os.environ.get("OMP_WAIT_POLICY", "default")
    print(f"{processor()}, {available} threads, torch {torch.__version__}")
    print(f"OpenMP wait policy {policy}; milliseconds\n")
    best = table(SIZES[: options.largest], threads, options.repeats)
    if not options.no_reference:
        scene = surfaces(*SIZES[0])
        set_threads(threads[-1])
        reference = milliseconds(lambda: render(scene, "reference", True), 1)[1]
        print(
            f"\nreference at {SIZES[0][0]}: {reference:.0f} ms, {reference / best:.0f} times that"
        )


if __name__ == "__main__":
    main()
