"""Where the milliseconds of a training step of ChronoGS go.

    python benchmarks/training_step.py SCENE [--train 1500] [--anchors 31000] [--steps 200]
    python benchmarks/training_step.py SCENE --model RUN/checkpoint

Trains on a scene until the model is of a realistic size, then times every part of ordinary steps:
neither the rounds that grow and prune, nor the reading of photos from disk. ``--model`` starts
from a checkpoint instead. Prints milliseconds per step by part, median and minimum over the steps,
with one thread and with all. On a machine with other work look at the minimum.

The parts are timed inside real steps; what torch's autograd and Python need between them is the
line "rest".
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count, islice
from pathlib import Path
from typing import Any

# Before torch: it says how idle threads wait.
import chronoscene  # noqa: F401

# isort: split
import torch

from chronogs import SPEC
from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.anchors.decode.function import Decode
from chronoscene.anchors.density import DensityStatistics
from chronoscene.anchors.model import AnchorModel
from chronoscene.anchors.trainer import AnchorTrainer
from chronoscene.bench.provenance import code_version, processor_name
from chronoscene.bench.strategies import Part, make_parts
from chronoscene.formats import read_scene
from chronoscene.images.store import ImageStore
from chronoscene.kernels.runtime import available_threads, keep_freed_memory, set_threads
from chronoscene.rasterizer.cpu import Render
from chronoscene.training import losses, splatting
from chronoscene.training.adam import DenseTable
from chronoscene.training.row_adam import RowAdam

PARTS: tuple[tuple[str, Any, str], ...] = (
    ("frustum culling", AnchorModel, "visible"),
    ("decode", Decode, "forward"),
    ("rasterize", Render, "forward"),
    ("loss", losses._PhotometricLoss, "forward"),
    ("volume term", losses._MeanVolume, "forward"),
    ("volume term, backward", losses._MeanVolume, "backward"),
    ("loss, backward", losses._PhotometricLoss, "backward"),
    ("rasterize, backward", Render, "backward"),
    ("decode, backward", Decode, "backward"),
    ("check of gradients", splatting, "all_finite"),
    ("density statistics", DensityStatistics, "update"),
    ("fetch anchors", RowAdam, "fetch"),
    ("Adam, seen anchors", RowAdam, "step"),
    ("Adam, all scales", DenseTable, "step"),
)
"""What is timed: name, owner, function."""


class Stopwatch:
    """Seconds of each part, collected within one step."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[name] += time.perf_counter() - start

        return timed


@contextmanager
def timed_parts(watch: Stopwatch) -> Iterator[None]:
    """Replace the functions of `PARTS` by timed ones for a while."""
    originals = [(owner, name, owner.__dict__[name]) for _, owner, name in PARTS]
    for (label, owner, name), (_, _, original) in zip(PARTS, originals, strict=True):
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


def measure(trainer: AnchorTrainer, steps: int) -> dict[str, list[float]]:
    """Milliseconds of each part in each step, all with statistics for growth and none with growth.

    The learning rates are those of the middle of the training.
    """
    watch, found = Stopwatch(), defaultdict[str, list[float]](list)
    ordinary = (i for i in count(1) if (i + 1) % trainer.config.density_interval)
    progress = 0.9 * trainer.config.density_until
    with timed_parts(watch):
        for index in islice(ordinary, steps):
            watch.seconds.clear()
            begin = time.perf_counter()
            trainer.step(index, progress * index / (index + 1))
            whole = time.perf_counter() - begin
            rest = whole - sum(watch.seconds.values())
            for name, seconds in {**watch.seconds, "rest": rest, "step": whole}.items():
                found[name].append(1e3 * seconds)
    return found


def report(columns: dict[str, dict[str, list[float]]]) -> None:
    """Print a line per part, and for each column the median and the minimum."""
    print(f"{'ms per step: median, minimum':<30}" + "".join(f"{name:>20}" for name in columns))
    for part in [name for name, _, _ in PARTS] + ["rest", "step"]:
        cells = []
        for found in columns.values():
            times = sorted(found.get(part, [0.0]))
            cells.append(f"{times[len(times) // 2]:10.2f}{times[0]:10.2f}")
        print(f"{part:<30}" + "".join(cells))


def main() -> None:
    """Train, or load; then time the parts with one thread and with all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--model", type=Path, help="checkpoint folder to start from")
    parser.add_argument("--preset", default="balanced", choices=sorted(SPEC.presets))
    parser.add_argument("--train", type=int, default=1_500, help="steps before, without --model")
    parser.add_argument("--anchors", type=int, default=31_000, help="limit, without --model")
    parser.add_argument("--steps", type=int, default=200, help="timed steps")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    keep_freed_memory()
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
        measure(trainer, 10)  # compile, touch memory
        columns[f"{threads} thread(s)"] = measure(trainer, args.steps)
    report(columns)


if __name__ == "__main__":
    main()
