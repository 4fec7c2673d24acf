"""Milliseconds of a training step by part.

    python -m benchmarks.training.step SCENE [--train 1500] [--anchors 31000] [--steps 200]
    python -m benchmarks.training.step SCENE --model RUN/checkpoint
    python -m benchmarks.training.step --generated 1200000 --size 1600 1200 --device cuda
    python -m benchmarks.training.step --scaling 20000 100000 1000000 --size 1200 900 --steps 30

The first two are of ChronoGS on a CPU: it trains on a scene until the model is of a realistic size,
then every part of ordinary steps is timed, neither the rounds that grow and prune, nor the reading
of photos from disk. ``--model`` starts from a checkpoint instead. Prints milliseconds per step by
part, median and minimum over the steps, with one thread and with all. On a machine with other work
look at the minimum.

The parts are timed inside real steps; what torch's autograd and Python need between them is the
line "rest".

The third is of any method, on so many generated points: each becomes an anchor or a Gaussian. Steps
are timed as they are. Then once more by parts, with the host waiting for the GPU before and after
each, which takes longer but says what the parts take. Then under torch's profiler, which says for
for how long the GPU does anything, what is copied, and how often the host waits.

The last is of ChronoGS, 3DGS and 4DGS on such points, with 1 thread, 2, 4, .. and all that the
machine has, in turn: each part's share that runs in parallel, by Amdahl's law.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from baselines.deformation_4dgs import model as deformed_model
from benchmarks.training.generated import PROGRESS, make, training_set
from benchmarks.training.gpu_trace import Summary, summary
from benchmarks.training.scaling import METHODS, measure_scaling, print_scaling
from chronogs import SPEC
from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.anchors import direct
from chronoscene.anchors.decode.function import Job
from chronoscene.anchors.density import DensityStatistics
from chronoscene.anchors.model import AnchorModel
from chronoscene.anchors.optimizer import AnchorOptimizer
from chronoscene.anchors.rounds import DensityControl
from chronoscene.anchors.trainer import AnchorTrainer
from chronoscene.formats import read_scene
from chronoscene.gaussians import model as gaussian_model
from chronoscene.gaussians import trainer as gaussian_trainer
from chronoscene.gaussians.density import GradientStatistics
from chronoscene.harness.files.provenance import code_version, library_versions, processor_name
from chronoscene.harness.plan.parts import Part, make_parts
from chronoscene.images.store import ImageStore
from chronoscene.kernels.runtime import (
    available_threads,
    check_device,
    keep_freed_memory,
    set_threads,
)
from chronoscene.methods import method_names
from chronoscene.rasterizer.cpu import DirectRender, Render
from chronoscene.training import drawing, gradients, losses, photometric, spherical_harmonics
from chronoscene.training.optimizers.adam import Adam, DenseTable

Timed = tuple[str, Any, str]
PARTS: tuple[Timed, ...] = (
    ("frustum culling", AnchorModel, "visible"),
    ("fetch anchors", AnchorOptimizer, "seen"),
    ("decode", Job, "__init__"),
    ("decode", Job, "forward"),
    ("spherical harmonics", spherical_harmonics._Evaluate, "forward"),
    ("rasterize", DirectRender, "__init__"),
    ("rasterize", Render, "forward"),
    ("loss and its gradient", direct, "loss_and_gradient"),
    ("loss and its gradient", photometric._PhotometricLoss, "forward"),
    ("volume term", direct, "add_mean_volume"),
    ("rasterize, backward", DirectRender, "backward"),
    ("rasterize, backward", Render, "backward"),
    ("spherical harmonics, backward", spherical_harmonics._Evaluate, "backward"),
    ("decode, backward", Job, "backward"),
    ("check of gradients", gradients, "all_finite"),
    ("density statistics", DensityControl, "collect"),
    ("density statistics", GradientStatistics, "add"),
    ("sum of gradients", AnchorOptimizer, "learn_from"),
    ("Adam", AnchorOptimizer, "step"),
    ("Adam", Adam, "step"),
)
"""Functions that are timed: name, owner, function."""
GPU_PARTS: tuple[Timed, ...] = (
    ("frustum culling", AnchorModel, "visible"),
    ("fetch anchors", DenseTable, "fetch"),
    ("decode", AnchorModel, "decode_active"),
    ("deformation", deformed_model, "deform"),
    ("spherical harmonics", gaussian_model, "evaluate"),
    ("rasterize", drawing, "rasterize"),
    ("loss", losses, "photometric_loss"),
    ("loss", gaussian_trainer, "photometric_loss"),
    ("backward", torch.Tensor, "backward"),
    ("check of gradients", gradients, "all_finite"),
    ("density statistics", DensityStatistics, "update"),
    ("density statistics", GradientStatistics, "add"),
    ("Adam", AnchorOptimizer, "step"),
    ("Adam", Adam, "step"),
)
"""Functions that are timed on a GPU. A part within another counts for itself only."""


class Stopwatch:
    """Seconds of each part, collected within one step.

    Args:
        settle: Called before the time is taken.
    """

    def __init__(self, settle: Callable[[], object]) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._settle = settle
        self._inner = 0.0
        """Seconds of parts within the present one."""

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._settle()
            start, before, self._inner = time.perf_counter(), self._inner, 0.0
            try:
                return function(*args, **kwargs)
            finally:
                self._settle()
                whole = time.perf_counter() - start
                self.seconds[name] += whole - self._inner
                self._inner = before + whole

        return timed


@contextmanager
def timed_parts(watch: Stopwatch, parts: Sequence[Timed]) -> Iterator[None]:
    """Replace the functions of some parts by timed ones for a while."""
    originals = [(owner, name, owner.__dict__[name]) for _, owner, name in parts]
    for (label, owner, name), (_, _, original) in zip(parts, originals, strict=True):
        static = isinstance(original, staticmethod)
        function = watch.wrap(label, original.__func__ if static else original)
        setattr(owner, name, staticmethod(function) if static else function)
    try:
        yield
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)


def train(part: Part, preset: str, steps: int, anchors: int, seed: int) -> AnchorTrainer:
    """Train as the harness does for some steps of the preset's schedule."""
    config = ChronoGSConfig(**{**SPEC.presets[preset], "max_anchors": anchors})
    method = ChronoGS(config)
    method.setup(part.train, seed=seed, device="cpu")
    for index in range(steps):
        method.step(index, index / config.iterations)
    assert method.trainer is not None
    return method.trainer


def resume(part: Part, preset: str, model: Path, seed: int) -> AnchorTrainer:
    """A trainer of the model of a checkpoint, with an optimiser that starts anew."""
    config = ChronoGSConfig(**SPEC.presets[preset])
    method = ChronoGS(config)
    method.load(model, device="cpu")
    return AnchorTrainer(
        config,
        method.model,
        part.train,
        voxel_size=0.01,  # of no consequence: nothing grows here
        seed=seed,
        rates=method.rates(part.train.camera_extent),
        feature_rows=method.feature_rows(part.train),
    )


def ordinary_steps(trainer: AnchorTrainer) -> Iterator[Callable[[], object]]:
    """Steps with statistics for growth and without growth, in the middle of the training."""
    progress = 0.9 * trainer.config.density_until
    for index in count(1):
        if (index + 1) % trainer.config.density_interval:
            yield lambda index=index: trainer.step(index, progress * index / (index + 1))


def measure(
    steps: Iterable[Callable[[], object]],
    parts: Sequence[Timed] = PARTS,
    settle: Callable[[], object] = lambda: None,
) -> dict[str, list[float]]:
    """Milliseconds of each part in each step; ``settle`` is called before time is taken."""
    watch, found = Stopwatch(settle), defaultdict[str, list[float]](list)
    with timed_parts(watch, parts):
        for step in steps:
            watch.seconds.clear()
            settle()
            begin = time.perf_counter()
            step()
            settle()
            whole = time.perf_counter() - begin
            rest = whole - sum(watch.seconds.values())
            for name, seconds in {**watch.seconds, "rest": rest, "step": whole}.items():
                found[name].append(1e3 * seconds)
    return found


def report(columns: dict[str, dict[str, list[float]]], parts: Sequence[Timed] = PARTS) -> None:
    """Print a line per part, and for each column the median and the minimum."""
    print(f"{'ms per step: median, minimum':<30}" + "".join(f"{name:>20}" for name in columns))
    for part in [*dict.fromkeys(name for name, _, _ in parts), "rest", "step"]:
        if not any(part in found for found in columns.values()):
            continue
        cells = []
        for found in columns.values():
            times = sorted(found.get(part, []))
            numbers = f"{times[len(times) // 2]:10.2f}{times[0]:10.2f}" if times else ""
            cells.append(f"{numbers:>20}")
        print(f"{part:<30}" + "".join(cells))


def profiled(steps: Sequence[Callable[[], object]]) -> Summary:
    """Profile some steps on a GPU with torch's profiler."""
    from torch.profiler import ProfilerActivity, profile

    with TemporaryDirectory() as folder:
        trace = Path(folder, "trace.json")
        with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as found:
            for step in steps:
                step()
            torch.cuda.synchronize()
        found.export_chrome_trace(str(trace))
        return summary(json.loads(trace.read_text())["traceEvents"], len(steps))


def time_generated(
    name: str, preset: str, points: int, size: tuple[int, int], *, steps: int, device: str
) -> None:
    """Time a method on generated points and print where the time goes."""
    on_gpu = device == "cuda"
    parts, settle = (GPU_PARTS, torch.cuda.synchronize) if on_gpu else (PARTS, lambda: None)
    method = make(training_set(points, *size), name, preset, device=device)

    def some(how_many: int) -> list[Callable[[], object]]:
        return [lambda i=i: method.step(i, PROGRESS) for i in range(100, 100 + how_many)]

    machine = gpu_name() if on_gpu else f"{processor_name()}, {available_threads()} threads"
    print(f"{machine}, {library_versions()}, commit {code_version()}")
    print(f"{name} {preset}, {method.size().primitives} primitives, {size[0]}x{size[1]}")
    measure(some(10), ())  # build kernels, touch memory
    free = measure(some(steps), ())
    by_part = measure(some(steps), parts, settle)
    report({"as it is": {"step": free["step"]}, "by parts": by_part}, parts)
    if not on_gpu:
        return
    seen, whole = profiled(some(20)), sorted(free["step"])[steps // 2]
    print(f"GPU busy {seen.busy_ms:.2f} ms per step: {100 * seen.busy_ms / whole:.0f} % of it")
    print(
        f"to the host {seen.bytes_to_host:.0f} bytes in {seen.copies_to_host:.1f} copies per step"
    )
    print(
        f"from the host {seen.bytes_from_host:.0f} bytes; it waits {seen.waits:.1f} times per step"
    )
    print(f"peak memory of the GPU {torch.cuda.max_memory_allocated() / 1e6:.0f} MB")


def time_scaling(points: Sequence[int], size: tuple[int, int], preset: str, steps: int) -> None:
    """Time steps of several methods and sizes with different numbers of threads."""
    most = available_threads()
    threads = sorted({min(2**i, most) for i in range(most.bit_length() + 1)})
    print(f"{processor_name()}, {most} threads, {library_versions()}, commit {code_version()}")
    names = tuple(dict.fromkeys(name for name, _, _ in PARTS))
    for number in points:
        for method in METHODS:
            found = measure_scaling(
                method, number, size, preset=preset, threads=threads, steps=steps, measure=measure
            )
            title = f"{method} {preset}, {number:,} points, {size[0]}x{size[1]}"
            print_scaling(title, found, names)


def gpu_name() -> str:
    """GPU, driver, and the CUDA that torch was built for."""
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    found = (
        subprocess.run(query, capture_output=True, text=True) if shutil.which(query[0]) else None
    )
    driver = found.stdout.strip() if found else "unknown"
    return f"{torch.cuda.get_device_name()}, driver {driver}, CUDA {torch.version.cuda}"


def main() -> None:
    """Train, load or generate; then time the parts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--model", type=Path, help="checkpoint folder to start from")
    parser.add_argument("--preset", default="balanced", choices=sorted(SPEC.presets))
    parser.add_argument("--train", type=int, default=1_500, help="steps before, without --model")
    parser.add_argument("--anchors", type=int, default=31_000, help="limit, without --model")
    parser.add_argument("--steps", type=int, default=200, help="timed steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--generated", type=int, metavar="POINTS", help="instead of a scene")
    parser.add_argument("--scaling", type=int, nargs="+", metavar="POINTS", help="instead of it")
    parser.add_argument("--method", default="chronogs", choices=method_names())
    parser.add_argument("--size", type=int, nargs=2, default=(800, 600), metavar=("W", "H"))
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    args = parser.parse_args()
    if sum(given is not None for given in (args.scene, args.generated, args.scaling)) != 1:
        parser.error("name a scene, --generated or --scaling")
    keep_freed_memory()
    if args.scaling:
        time_scaling(args.scaling, tuple(args.size), args.preset, args.steps)
        return
    if args.generated:
        check_device(args.device)
        sizes = args.generated, tuple(args.size)
        time_generated(args.method, args.preset, *sizes, steps=args.steps, device=args.device)
        return
    scene = read_scene(args.scene)
    (part,) = make_parts(scene, ImageStore(scene), "joint")
    if args.model:
        trainer = resume(part, args.preset, args.model, args.seed)
    else:
        trainer = train(part, args.preset, args.train, args.anchors, args.seed)
    view = part.train.views[0]
    print(f"{processor_name()}, torch {torch.__version__}, commit {code_version()}")
    print(f"{scene.name}, {view.width}x{view.height}, {len(trainer.model)} anchors")
    columns = {}
    for threads in sorted({1, available_threads()}):
        set_threads(threads)
        measure(islice(ordinary_steps(trainer), 10))  # compile, touch memory
        columns[f"{threads} thread(s)"] = measure(islice(ordinary_steps(trainer), args.steps))
    report(columns)


if __name__ == "__main__":
    main()
