"""Time gained by approximations of the CPU rasterizer, and the accuracy that they cost.

    python -m benchmarks.rasterizer.tradeoff [--rounds 30] [--gaussians 100000] [--width 400]

Every variant is a copy of the package with a few lines changed, compiled in a process of its own;
the processes take turns, so that a busy machine slows all of them down. Time is the median over the
rounds of the ratio to the package as it is. Errors are measured against a copy with thresholds so
low that they change nothing any more in float32.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from benchmarks.checkout_process import CheckoutProcess

PACKAGE = Path(__file__).resolve().parents[2] / "chronoscene"
CPU = "rasterizer/cpu/"

Patch = tuple[str, str, str]
"""File below the package, text that occurs there once, its replacement."""


@dataclass(frozen=True)
class Variant:
    """A change of the package."""

    name: str
    patches: tuple[Patch, ...] = ()


def constant(name: str, old: str, new: str) -> Patch:
    """Return the patch that gives a constant another value."""
    return ("rasterizer/constants.py", f"{name} = {old}", f"{name} = {new}")


def alpha_min(value: str) -> Patch:
    """Return the patch for another least alpha."""
    return constant("ALPHA_MIN", "1.0 / 255.0", value)


def light_min(value: str) -> Patch:
    """Return the patch for another least transmittance."""
    return constant("TRANSMITTANCE_MIN", "1e-4", value)


CUBIC = """    ff = f * f
    low = f * 0.69326099 + 0.99992807
    high = f * 0.05517169 + 0.24261117
    p = high * ff + low
"""
"""Cubic of least maximal relative error on half an octave either side: 7.5e-5."""

EXACT = Variant("(what errors refer to)", (alpha_min("1e-6"), light_min("1e-7")))
VARIANTS = (
    Variant("as it is"),
    Variant("alpha from 1/512", (alpha_min("1.0 / 512.0"),)),
    Variant("alpha from 1/128", (alpha_min("1.0 / 128.0"),)),
    Variant("alpha from 1/64", (alpha_min("1.0 / 64.0"),)),
    Variant("light to 1e-5", (light_min("1e-5"),)),
    Variant("light to 1e-3", (light_min("1e-3"),)),
    Variant("light to 1e-2", (light_min("1e-2"),)),
    Variant(
        "ellipse of 3 sigma",
        (
            (
                CPU + "project.py",
                "    reach = (level - layout.LEVEL_MIN) * (2.0 / layout.LOG2_E)\n",
                "    reach = minimum((level - layout.LEVEL_MIN) * (2.0 / layout.LOG2_E), 9.0)\n",
            ),
            (
                CPU + "bins.py",
                "record[at + layout.LEVEL] - _LEVEL_MIN\n",
                "min(record[at + layout.LEVEL] - _LEVEL_MIN, np.float32(4.5 * layout.LOG2_E))\n",
            ),
        ),
    ),
    Variant(
        "all blocks of a tile",
        ((CPU + "bins.py", "blocks = _tile_blocks(left, right, tile_x)\n",
          "blocks = _tile_blocks(left, right, tile_x)\n"
          "                if blocks != 0:\n"
          "                    blocks = np.uint64(0xFFFFFFFFFFFFFFFF)\n"),),
    ),
    Variant(
        "cubic exponential",
        (("kernels/vector_math.py",
          """    ff = f * f
    low = f * 0.6931469440460205 + 1.0000001192092896
    middle = f * 0.05550713092088699 + 0.24022120237350464
    high = f * 0.0013276472454890609 + 0.009675540961325169
    p = (high * ff + middle) * ff + low
""", CUBIC),),
    ),
)  # fmt: skip


def patched_files(variant: Variant) -> dict[str, str]:
    """Return the text of each file of the package that a variant changes.

    Raises:
        SystemExit: If a patch does not fit: the package has changed, and this file must follow.
    """
    files: dict[str, str] = {}
    for name, old, new in variant.patches:
        text = files.get(name) or (PACKAGE / name).read_text(encoding="utf-8")
        if text.count(old) != 1:
            raise SystemExit(f"{variant.name}: {name}: expected once, found otherwise: {old!r}")
        files[name] = text.replace(old, new)
    return files


def copy_of_package(variant: Variant, folder: Path) -> None:
    """Copy the package with the patches of a variant."""
    target = folder / "chronoscene"
    shutil.copytree(PACKAGE, target, ignore=shutil.ignore_patterns("__pycache__"))
    for name, text in patched_files(variant).items():
        (target / name).write_text(text, encoding="utf-8")


class Process(CheckoutProcess):
    """Process that renders with one variant on request."""

    def __init__(self, variant: Variant, folder: Path, options: argparse.Namespace) -> None:
        copy_of_package(variant, folder)
        self.result = folder / "result.npz"
        given = [options.gaussians, options.width, options.threads, self.result]
        arguments = [__file__, "--worker", *map(str, given)]
        super().__init__(variant.name, arguments, [folder, PACKAGE.parent])


def work(arguments: Sequence[str], inputs: IO[str]) -> None:
    """Render in the process of a variant: once for the errors, then at each line of input."""
    from benchmarks.rasterizer.peers import cpu
    from benchmarks.rasterizer.scenes import surfaces
    from chronoscene.kernels.runtime import set_threads

    count, width, threads = map(int, arguments[:3])
    set_threads(threads)
    scene = surfaces(count, width, 3 * width // 4)
    run = cpu.make(scene)
    image = run(True).numpy()
    grads = {
        f"grad_{i}": x.grad.numpy() for i, x in enumerate(scene.gaussians) if x.grad is not None
    }
    np.savez(arguments[3], image=image, **grads)
    for _ in inputs:
        run(True)  # while it waited, others had the caches
        times = []
        for backward in (False, True):
            start = time.perf_counter()
            run(backward)
            times.append(1e3 * (time.perf_counter() - start))
        print(json.dumps(times), flush=True)


def errors(found: Path, exact: Path) -> tuple[float, float, float]:
    """PSNR in dB and largest error of the image; error of the gradients of the centres, relative
    in the root mean square."""
    with np.load(found) as a, np.load(exact) as b:
        difference = a["image"].astype(np.float64) - b["image"]
        mse = float(np.square(difference).mean())
        centre = np.linalg.norm(a["grad_0"] - b["grad_0"]) / np.linalg.norm(b["grad_0"])
        return -10 * np.log10(max(mse, 1e-30)), float(np.abs(difference).max()), float(centre)


def compare(options: argparse.Namespace) -> None:
    """Run all variants in turns and print the table."""
    with tempfile.TemporaryDirectory() as name:
        processes = []
        for i, variant in enumerate((EXACT, *VARIANTS)):
            process = Process(variant, Path(name) / str(i), options)
            process.ask("warm up")  # one after the other: compiling takes seconds
            processes.append(process)
        exact, *others = processes
        rounds = np.array([[p.ask("go") for p in others] for _ in range(options.rounds)])
        ratios = rounds / rounds[:, :1]
        head = ("image", "gradients", "PSNR", "largest", "gradients'")
        units = ("time", "too, time", "dB", "error", "error")
        for words in (head, units):
            print(f"{'':<22}" + "".join(f"{word:>12}" for word in words))
        for i, process in enumerate(others):
            image, both = np.median(ratios[:, i], axis=0)
            db, largest, centre = errors(process.result, exact.result)
            cells = (
                f"{image:.2f}x",
                f"{both:.2f}x",
                f"{db:.1f}",
                f"{largest:.1e}",
                f"{centre:.1e}",
            )
            print(f"{process.name:<22}" + "".join(f"{cell:>12}" for cell in cells))
        base = np.median(rounds[:, 0], axis=0)
        print(f"as it is: image {base[0]:.1f} ms, with gradients {base[1]:.1f} ms (medians)")
        for process in processes:
            process.close()


def main() -> None:
    if sys.argv[1:2] == ["--worker"]:
        work(sys.argv[2:], sys.stdin)
        return
    from chronoscene.harness.files.provenance import code_version, processor_name
    from chronoscene.kernels.runtime import available_threads

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=400, help="of a 4:3 image")
    parser.add_argument("--threads", type=int, default=available_threads())
    options = parser.parse_args()
    print(f"{processor_name()}, {options.threads} threads, commit {code_version()}")
    print(f"{options.gaussians} Gaussians, {options.width}x{3 * options.width // 4}\n")
    compare(options)


if __name__ == "__main__":
    main()
