"""Times of the CPU rasterizer beside other ways to rasterize, in one run.

    python -m benchmarks.rasterizer.speed [--repeats 30] [--largest 4] [--figure FILE] [--csv FILE]

Prints milliseconds of the image and of the image with the gradients of all inputs, as the caller
sees them: median and minimum. All candidates take turns at each size, so a busy machine slows all
of them down; ratios are of medians. On a machine with other work look at the minima. The figure
shows how time grows with Gaussians and with pixels.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.rasterizer.peers import (
    UnavailableError,
    cpu,
    cuda,
    gsplat_torch,
    scalar,
    torch_tiles,
)
from benchmarks.rasterizer.scenes import SIZES, Scene, surfaces
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.io.staging import write_text_atomic
from chronoscene.kernels.runtime import available_threads, keep_freed_memory, set_threads

SLOW_LIMIT = 60.0
"""Seconds: a peer whose one run at a size takes longer than its share of this is not run at the
next one."""
GROWTH = (5_000, 10_000, 20_000, 50_000, 100_000, 200_000, 500_000)
"""Gaussians at 400x300 for the figure."""
WIDTHS = (100, 200, 400, 800, 1600)
"""Widths at 100,000 Gaussians for the figure; 4:3."""


@dataclass(frozen=True)
class Candidate:
    """One way to render, with a number of threads."""

    name: str
    threads: int
    make: Callable[[Scene], Callable[[bool], torch.Tensor]]
    repeats: int

    @property
    def label(self) -> str:
        return f"{self.name}, {self.threads} thread{'s' * (self.threads > 1)}"


@dataclass(frozen=True)
class Row:
    """Times of a candidate at one size, in milliseconds, in the order of the runs."""

    candidate: Candidate
    gaussians: int
    width: int
    height: int
    forward: tuple[float, ...]
    both: tuple[float, ...]


def candidates(repeats: int) -> list[Candidate]:
    """Ours with one thread, two and all; then the others."""
    most = available_threads()
    threads, with_depth = sorted({1, min(2, most), most}), partial(cpu.make, render_depth=True)
    return [
        *(Candidate("cpu", n, cpu.make, repeats) for n in threads),
        *(Candidate("cpu, depth", n, with_depth, repeats) for n in threads),
        Candidate("scalar", 1, scalar.make, 3),
        Candidate("torch", most, torch_tiles.make, 1),
        Candidate("gsplat torch", most, gsplat_torch.make, 1),
        Candidate("cuda", most, cuda.make, repeats),
    ]


class Runner:
    """Measures sizes one after the other and drops candidates that cannot run, or take too long."""

    def __init__(self, chosen: Sequence[Candidate]) -> None:
        self.left = list(chosen)
        self.absent: dict[str, str] = {}

    def measure(self, count: int, width: int, height: int) -> list[Row]:
        """All that are left, in turns: a round runs each of them once."""
        scene = surfaces(count, width, height)
        runs = {c: run for c in self.left if (run := self._prepare(c, scene)) is not None}
        times: dict[Candidate, tuple[list[float], list[float]]] = {c: ([], []) for c in runs}
        for turn in range(max((c.repeats for c in runs), default=0)):
            for candidate, run in runs.items():
                if turn < candidate.repeats:
                    set_threads(candidate.threads)
                    for backward, found in zip((False, True), times[candidate], strict=True):
                        found.append(milliseconds(run, backward))
        self._drop_slow(times)
        return [
            Row(c, count, width, height, tuple(forward), tuple(both))
            for c, (forward, both) in times.items()
        ]

    def _prepare(self, candidate: Candidate, scene: Scene) -> Callable[[bool], torch.Tensor] | None:
        """Ready to be timed: compiled, memory touched."""
        set_threads(candidate.threads)
        try:
            run = candidate.make(scene)
        except UnavailableError as error:
            self.absent[candidate.name] = str(error)
            self.left.remove(candidate)
            return None
        if candidate.repeats > 1:
            for backward in (False, True, True):
                run(backward)
        return run

    def _drop_slow(self, times: dict[Candidate, tuple[list[float], list[float]]]) -> None:
        for candidate, (_, both) in times.items():
            if 1e-3 * min(both) * candidate.repeats > SLOW_LIMIT / 4:
                self.left.remove(candidate)


def milliseconds(run: Callable[[bool], torch.Tensor], backward: bool) -> float:
    """Wall time of one run."""
    start = time.perf_counter()
    run(backward)
    return 1e3 * (time.perf_counter() - start)


def print_size(rows: Sequence[Row]) -> None:
    """The lines of one size. The ratio is to ours with as many threads, or with the most."""
    for row in rows:
        peers = [r for r in rows if r.candidate.name == "cpu"]
        same = [r for r in peers if r.candidate.threads == row.candidate.threads] or peers[-1:]
        ratio = np.median(row.both) / np.median(same[0].both)
        cells = "  ".join(
            f"{np.median(times):9.1f} {min(times):9.1f}" for times in (row.forward, row.both)
        )
        shown = "" if row.candidate.name == "cpu" else f"{ratio:8.1f}x"
        size = f"{row.width}x{row.height}"
        print(f"{row.gaussians:>10} {size:>10}  {row.candidate.label:<22} {cells} {shown}")
    print(flush=True)


def table(sizes: Sequence[tuple[int, int, int]], chosen: Sequence[Candidate]) -> list[Row]:
    """Print all sizes and what could not run."""
    print(f"{'':>10} {'':>10}  {'':<22} {'image, ms':^19}  {'and gradients, ms':^19}")
    titles = "  ".join(f"{'median':>9} {'min':>9}" for _ in range(2))
    print(f"{'Gaussians':>10} {'image':>10}  {'':<22} {titles} {'to ours':>9}")
    runner, rows = Runner(chosen), []
    for size in sizes:
        found = runner.measure(*size)
        print_size(found)
        rows += found
    for name, reason in runner.absent.items():
        print(f"{name}: not run: {reason}")
    return rows


def growth(chosen: Sequence[Candidate]) -> tuple[list[Row], list[Row]]:
    """Measurements for the two panels of the figure."""
    by_count, by_pixels = Runner(chosen), Runner(chosen)
    first = [row for n in GROWTH for row in by_count.measure(n, 400, 300)]
    second = [row for w in WIDTHS for row in by_pixels.measure(100_000, w, 3 * w // 4)]
    return first, second


def draw(panels: tuple[list[Row], list[Row]], path: Path) -> None:
    """Time of image and gradients against Gaussians and against pixels, both axes logarithmic."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    from chronoscene.io.staging import replacing

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    titles = ("Gaussians (400x300 pixels)", "pixels (100,000 Gaussians)")
    for panel, axis, title in zip(panels, axes, titles, strict=True):
        labels = list(dict.fromkeys(row.candidate.label for row in panel))
        for label, marker in zip(labels, "osD^vP", strict=False):
            rows = [row for row in panel if row.candidate.label == label]
            x = [r.gaussians if axis is axes[0] else r.width * r.height for r in rows]
            axis.plot(x, [np.median(r.both) for r in rows], marker=marker, ms=4, label=label)
        axis.set(xscale="log", yscale="log", xlabel=title)
        axis.grid(alpha=0.3, which="both", lw=0.4)
    axes[0].set_ylabel("image and gradients, ms (median)")
    axes[1].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], dpi=150)
    plt.close(figure)


def to_csv(rows: Sequence[Row]) -> str:
    """One line per candidate and size."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    head = ("name", "threads", "gaussians", "width", "height", "runs")
    times = ("image_median", "image_min", "both_median", "both_min")
    writer.writerow((*head, *(f"{name}_ms" for name in times)))
    for r in rows:
        values = (np.median(r.forward), min(r.forward), np.median(r.both), min(r.both))
        key = (r.candidate.name, r.candidate.threads, r.gaussians, r.width, r.height, len(r.both))
        writer.writerow((*key, *(f"{value:.3f}" for value in values)))
    return text.getvalue()


def _named(names: Sequence[str], repeats: int) -> list[Candidate]:
    return [candidate for candidate in candidates(repeats) if candidate.name in names]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=30, help="counted runs of ours")
    parser.add_argument("--largest", type=int, default=len(SIZES), help="how many of the sizes")
    parser.add_argument("--only", action="append", help="a candidate; may be repeated")
    parser.add_argument("--figure", type=Path, help="also measure growth, and draw it here")
    parser.add_argument("--csv", type=Path, help="write everything that was measured here")
    options = parser.parse_args()
    keep_freed_memory()
    policy = os.environ.get("OMP_WAIT_POLICY", "default")
    print(f"{processor_name()}, {available_threads()} threads, torch {torch.__version__}")
    print(f"commit {code_version()}, OpenMP wait policy {policy}")
    for peer in (cpu, scalar, torch_tiles, gsplat_torch, cuda):
        print(f"  {peer.NAME}: {peer.WHAT}")
    print()
    names = options.only or [c.name for c in candidates(1)]
    rows = table(SIZES[: options.largest], _named(names, options.repeats))
    if options.figure:
        panels = growth(_named(names, max(3, options.repeats // 3)))
        draw(panels, options.figure)
        rows += [*panels[0], *panels[1]]
    if options.csv:
        write_text_atomic(options.csv, to_csv(rows))


if __name__ == "__main__":
    main()
