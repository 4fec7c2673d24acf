"""Time that a training waits for its photos, and the memory that they take.

    python -m benchmarks.training.photo_loading [--photos 800] [--width 2400] [--memory 1.0]
        [--passes 3]
    python -m benchmarks.training.photo_loading --step 20

Makes JPEG photos of noise, every tenth with a mask, and trains 3DGS on them with few Gaussians. The
photos do not fit into the memory that they may take, so the first pass decodes all of them and the
others read them from disk; they are dropped from the memory of the operating system after each
pass. Before, the same training runs on one photo that is in memory, which shows what its steps take
without loading. ``--step`` puts steps of so many milliseconds that need no processor in the place
of those of 3DGS, as if a GPU did them.

Prints for each pass the seconds on the training clock and those waited, the processor time of this
process and the load of the machine; then the share of the time after the first pass that the
training waited, and the largest memory beside what the training takes by itself. ``--data`` keeps
the photos for the next time.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from chronoscene.formats import chronoscene as scene_format
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import code_version, peak_memory_bytes, processor_name
from chronoscene.harness.files.records import PHOTOS
from chronoscene.harness.plan.memory import open_store
from chronoscene.harness.plan.parts import Part, make_parts
from chronoscene.harness.plan.plan import plan_runs
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.train.loop import train
from chronoscene.harness.train.warm_up import forget_peak_memory
from chronoscene.kernels.runtime import available_threads, keep_freed_memory, set_threads
from chronoscene.methods import Method, MethodSize, StepReport, TrainingSet, import_object
from chronoscene.methods.interface import nothing_ahead
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.training.views import ViewSampler

TESTS = 4  # Photos that are not trained on
POINTS = 3_000
REFERENCE_STEPS = 30


def make_scene(root: Path, photos: int, width: int) -> None:
    """Write a scene whose cameras look at a ball of points from a ring around it."""
    height = width * 3 // 4
    camera = Camera(1, "PINHOLE", width, height, (width, width, width / 2, height / 2))
    frames = []
    for i in range(photos + TESTS):
        angle = 2 * np.pi * i / (photos + TESTS)
        pose = np.eye(4)
        pose[0, [0, 2]] = pose[2, [2, 0]] = np.cos(angle), -np.sin(angle)
        pose[2, 0], pose[2, 3] = np.sin(angle), 3.0
        split = "train" if i < photos else "test"
        frames.append(Frame(f"{i:04}.jpg", i + 1, camera, pose, 0, split))
    rng = np.random.default_rng(0)
    tracks = rng.integers(0, photos, POINTS).astype(np.int32)
    points = Points(
        ids=np.arange(1, POINTS + 1),
        xyz=rng.uniform(-1, 1, (POINTS, 3)),
        rgb=rng.integers(0, 256, (POINTS, 3), dtype=np.uint8),
        error=np.full(POINTS, 0.5),
        track_start=np.arange(POINTS + 1),
        track_frame=tracks,
        track_xy=np.full((POINTS, 2), 1.0),
    )
    periods = (Period(0, "all"),)
    scene = Scene("noise", root, root, tuple(frames), points, periods, "made up", "memory")
    scene_format.write(scene, root, image_source="none")
    grain = rng.integers(0, 40, (height, width, 3), dtype=np.uint8)
    with ThreadPoolExecutor(available_threads()) as pool:
        list(pool.map(lambda i: write_photo(root, i, grain), range(len(frames))))


def write_photo(root: Path, number: int, grain: np.ndarray) -> None:
    """Clouds of colour with grain; a mask of a disc with every tenth."""
    height, width = grain.shape[:2]
    rng = np.random.default_rng(number)
    clouds = Image.fromarray(rng.integers(0, 216, (9, 12, 3), dtype=np.uint8))
    pixels = np.asarray(clouds.resize((width, height), Image.Resampling.BILINEAR)) + grain
    path = root / "images" / f"{number:04}.jpg"
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(pixels).save(path, quality=90)
    if number % 10 == 0:
        y, x = np.ogrid[:height, :width]
        disc = (y - height / 2) ** 2 + (x - width / 2) ** 2 < (height / 3) ** 2
        (root / "masks").mkdir(exist_ok=True)
        Image.fromarray(~disc).save(root / "masks" / f"{number:04}.jpg.png")


class Sleeper:
    """A method that reads its photos and then sleeps instead of training."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        self.train = train
        self.sampler = ViewSampler(len(train.views), seed, train.expect)

    def step(self, index: int, progress: float) -> StepReport:
        number = self.sampler.next()
        self.train.load_image(number).sum()
        self.train.load_mask(number)
        time.sleep(self.seconds)
        return StepReport(1.0, 0)

    def size(self) -> MethodSize:
        return MethodSize(0, 0)


def run(part: Part, method: Method, steps: int, observer: Callable[..., None]) -> None:
    """Train through the loop of the harness, without probes."""
    train(method, part, StopRule(steps, None), {}, seed=0, device="cpu", observer=observer)


def at_hand(part: Part) -> Part:
    """Return the part with one photo for all views, which has a mask."""
    photo, mask = part.train.load_image(0), part.train.load_mask(0)
    train_set = replace(
        part.train, load_image=lambda i: photo, load_mask=lambda i: mask, expect=nothing_ahead
    )
    return replace(part, train=train_set)


def drop_from_page_cache(folder: Path) -> None:
    """Make the operating system read the files of a folder from disk, where it can."""
    os.sync()
    for path in folder.glob("*.npz"):
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def measure(scene_root: Path, runs: Path, memory: float, passes: int, step: float | None) -> None:
    """Train without and with loading, and print what it takes."""
    fixed = {"densify_until": "0", "sh_degree": "0"}
    settings = bench_settings(
        scenes=(scene_root,),
        methods=("3dgs",),
        runs=runs,
        preset="fast",
        overrides=fixed,
        photo_memory=round(memory * 1e9),
    )
    (planned,) = plan_runs(settings, print).runs.values()

    def make() -> Method:
        if step is not None:
            return Sleeper(step / 1e3)
        return import_object(planned.spec.method)(planned.config)

    scene = read_scene(scene_root)
    (part,) = make_parts(scene, open_store(scene, planned.job.settings), "joint")
    count = len(part.train.views)

    times: list[float] = []
    run(at_hand(part), make(), REFERENCE_STEPS, lambda _, seconds, *rest: times.append(seconds))
    reference = 1e3 * float(np.median(np.diff(times)))
    forget_peak_memory()
    run(at_hand(part), make(), 5, lambda *step: None)
    beside = peak_memory_bytes() or 0
    print(f"photo at hand: {reference:.0f} ms per step (median)")

    (part,) = make_parts(scene, open_store(scene, planned.job.settings), "joint")
    rows: list[tuple[float, ...]] = [(0.0, 0.0, time.process_time(), time.perf_counter())]

    def observe(step: int, seconds: float, report: StepReport, psnr: float | None) -> None:
        if step % count == 0:
            now = part.store.waited, time.process_time(), time.perf_counter()
            rows.append((seconds, *now))
            trained, waited, cpu, wall = np.subtract(rows[-1], rows[-2])
            load = os.getloadavg()[0]
            print(
                f"pass {len(rows) - 1}: {trained:.1f} s on the clock ({1e3 * trained / count:.0f} "
                f"ms per step), waited {waited:.2f} s; {cpu:.1f} s of processors, {cpu / wall:.2f} "
                f"at a time, load {load:.1f}"
            )
            drop_from_page_cache(runs / PHOTOS)

    forget_peak_memory()
    run(part, make(), passes * count, observe)
    peak = (peak_memory_bytes() or 0) - beside
    trained, waited = np.subtract(rows[-1], rows[1])[:2]
    share = waited / (trained + waited)
    print(f"waited after the first pass: {share:.2%} of the time (target: less than 3 %)")
    print(f"memory beside the training: {peak / 1e9:.2f} GB (bound: {memory:.2f} GB)")


def main() -> None:
    """Make the photos where there are none yet, and measure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--photos", type=int, default=800)
    parser.add_argument("--width", type=int, default=2400, help="of the files, in pixels")
    parser.add_argument("--memory", type=float, default=1.0, help="for photos, in GB")
    parser.add_argument("--passes", type=int, default=3, help="over all photos, at least 2")
    parser.add_argument("--step", type=float, help="milliseconds of a step, instead of 3DGS")
    parser.add_argument("--data", type=Path, help="folder for the photos, to be kept")
    args = parser.parse_args()
    keep_freed_memory()
    print(f"{processor_name()}, {set_threads()} threads, commit {code_version()}")
    with tempfile.TemporaryDirectory() as temporary:
        scene = (args.data or Path(temporary)) / f"noise-{args.photos}-{args.width}"
        if not scene.exists():
            started = time.perf_counter()
            make_scene(scene, args.photos, args.width)
            print(f"made {args.photos} photos in {time.perf_counter() - started:.0f} s")
        measure(scene, Path(temporary) / "runs", args.memory, args.passes, args.step)


if __name__ == "__main__":
    main()
