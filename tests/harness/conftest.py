"""A two-period scene whose tracks are known, toy methods, and one bench that many tests read."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from training_here import execute_here, train_here

from chronoscene.formats import chronoscene as scene_format
from chronoscene.harness.files.records import read_run
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run.process import run_in_process
from chronoscene.harness.run.runner import BenchOutcome, run_bench
from chronoscene.images.truth import GEOMETRY, truth_place
from chronoscene.scene import Camera, Frame, Period, Points, Scene

PLUGINS = Path(__file__).parent / "plugins"
WIDTH, HEIGHT = 24, 16
COLORS = ((200, 60, 40), (30, 90, 210))
"""Mean colour of the photos of each period."""

SEEN_BY = (
    *[("a/0.png", "a/1.png")] * 4,
    *[("b/0.png", "b/3.png")] * 4,
    ("a/1.png", "b/0.png"),
    ("a/0.png", "b/1.png"),
    ("a/2.png", "b/2.png"),
    ("a/2.png", "b/3.png"),
)
"""Frames that see each point: four only in period 0, four only in period 1, two in both, one only
on test images, one on a test image of period 0 and a training image of period 1."""


def make_frames(shift: float = 0.0) -> tuple[Frame, ...]:
    """Four views per period on a ring; ``a/2`` and ``b/2`` are test images, ``b/1`` too."""
    camera = Camera(1, "PINHOLE", WIDTH, HEIGHT, (20.0, 21.0, 11.5, 8.25))
    frames = []
    for i, name in enumerate(f"{folder}/{k}.png" for folder in "ab" for k in range(4)):
        angle = 0.7 * i
        cosine, sine = np.cos(angle), np.sin(angle)
        pose = np.eye(4)
        pose[:3, :3] = [[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]]
        pose[:3, 3] = [0.0, 0.0, 3.0 + 0.2 * i] - pose[:3, :3] @ np.full(3, shift)
        test = name in ("a/2.png", "b/1.png", "b/2.png")
        frames.append(Frame(name, i + 1, camera, pose, i // 4, "test" if test else "train"))
    return tuple(frames)


def make_points(frames: tuple[Frame, ...], shift: float = 0.0) -> Points:
    """Points near the origin with the tracks of `SEEN_BY`."""
    rng = np.random.default_rng(3)
    index = {frame.name: i for i, frame in enumerate(frames)}
    lengths = [len(names) for names in SEEN_BY]
    track = np.array([index[name] for names in SEEN_BY for name in names], np.int32)
    return Points(
        ids=np.arange(1, len(SEEN_BY) + 1),
        xyz=rng.uniform(-1, 1, (len(SEEN_BY), 3)) + shift,
        rgb=rng.integers(0, 256, (len(SEEN_BY), 3), dtype=np.uint8),
        error=np.full(len(SEEN_BY), 0.5),
        track_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        track_frame=track,
        track_xy=rng.uniform(0, HEIGHT, (len(track), 2)),
    )


def write_photos(root: Path, frames: tuple[Frame, ...]) -> None:
    """A constant colour per period with a little noise, different in each image."""
    for frame in frames:
        rng = np.random.default_rng(frame.image_id)
        noise = rng.integers(-9, 10, (HEIGHT, WIDTH, 3))
        pixels = (np.array(COLORS[frame.period]) + noise).astype(np.uint8)
        path = root / frame.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path)


@pytest.fixture
def make_scene(tmp_path: Path) -> Callable[..., Scene]:
    """Factory of the scene in memory, its photos on disk; ``shift`` moves the world."""

    def make(shift: float = 0.0, **changes: Any) -> Scene:
        frames = make_frames(shift)
        images = tmp_path / "photos"
        write_photos(images, frames)
        fields: dict[str, Any] = {
            "name": "ring",
            "root": tmp_path,
            "images_root": images,
            "frames": frames,
            "points": make_points(frames, shift),
            "periods": (Period(0, "spring"), Period(1, "autumn")),
            "split_rule": "made up",
            "format": "memory",
        }
        return Scene(**{**fields, **changes})

    return make


@pytest.fixture(scope="session")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene as a folder; not to be changed."""
    root = tmp_path_factory.mktemp("bench-scene")
    frames = make_frames()
    write_photos(root / "photos", frames)
    periods = (Period(0, "spring"), Period(1, "autumn"))
    scene = Scene(
        "ring", root, root / "photos", frames, make_points(frames), periods, "made up", "memory"
    )
    return scene_format.write(scene, root / "ring")


@pytest.fixture(scope="session")
def write_truth() -> Callable[[Scene, Path], Path]:
    """Writer of what the test cameras of the ring would see at the other period, in noise."""

    def write(scene: Scene, folder: Path) -> Path:
        rng = np.random.default_rng(0)
        for frame in scene.select(split="test"):
            other = 1 - frame.period
            image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            changes = np.zeros((HEIGHT, WIDTH), np.uint8)
            changes[:, :9] = GEOMETRY
            for kind, array in (("cross_rgb", image), ("change", changes)):
                path = folder / truth_place(kind, frame.name, other)
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(array).save(path)
            path = folder / truth_place("depth", frame.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, depth=np.full((HEIGHT, WIDTH), 3.0, np.float32))
        return folder

    return write


@pytest.fixture(scope="session", autouse=True)
def toys() -> Iterator[None]:
    """Make ``toy_methods`` importable, in worker processes too."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(PLUGINS), before]))
    sys.path.insert(0, str(PLUGINS))
    yield
    sys.path.remove(str(PLUGINS))
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


def full_names(methods: Sequence[str]) -> tuple[str, ...]:
    """Names of installed methods, and of toy methods, which are upper case: ``MEAN``."""
    return tuple(f"toy_methods:{name}" if name.isupper() else name for name in methods)


Bench = Callable[..., tuple[BenchOutcome, list[str]]]


@pytest.fixture
def bench(scene_folder: Path, tmp_path: Path) -> Bench:
    """Run a bench on the scene; returns its outcome and what it said."""

    def run(*methods: str, **changes: Any) -> tuple[BenchOutcome, list[str]]:
        said: list[str] = []
        fields: dict[str, Any] = {
            "scenes": (scene_folder,),
            "methods": full_names(methods),
            "runs": tmp_path / "runs",
            "threads": 1,
        }
        outcome = run_bench(bench_settings(**{**fields, **changes}), said.append)
        return outcome, said

    return run


@pytest.fixture
def bench_here(scene_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """The same of any method in this process, not warmed up."""
    train_here(monkeypatch)

    def run(*methods: str, **changes: Any) -> tuple[BenchOutcome, list[str]]:
        said: list[str] = []
        fields = {
            "scenes": (scene_folder,),
            "methods": full_names(methods),
            "runs": tmp_path / "runs",
        }
        settings = bench_settings(**{**fields, **changes})
        return run_bench(settings, said.append), said

    return run


@pytest.fixture(scope="session")
def finished_bench(
    scene_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, BenchOutcome, list[str]]:
    """Folder, outcome and messages of one bench over three strategies and every kind of failure."""
    runs = tmp_path_factory.mktemp("bench") / "runs"
    said: list[str] = []
    names = ("MEAN", "BLIND", "RAISES", "NOT_FINITE", "KILLED")
    first = bench_settings(scenes=(scene_folder,), methods=full_names(names), runs=runs, threads=1)
    outcome = run_bench(
        first,
        said.append,
        execute=lambda job: (run_in_process if job.method_name == "killed" else execute_here)(job),
    )
    others = bench_settings(
        scenes=(scene_folder,),
        methods=("toy_methods:MEAN",),
        runs=runs,
        threads=1,
        strategies=("pooled", "separate"),
    )
    run_bench(others, said.append, execute=execute_here)
    return runs, outcome, said


@pytest.fixture
def runs(finished_bench: tuple[Path, BenchOutcome, list[str]], tmp_path: Path) -> Path:
    """A copy of the finished bench, to be changed at will."""
    return Path(shutil.copytree(finished_bench[0], tmp_path / "copied-runs"))


@pytest.fixture(scope="session")
def trained(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs of a few steps by method: ``chronogs`` and ``3dgs-period`` joint, ``4dgs`` separate."""
    runs, finished = tmp_path_factory.mktemp("trained"), []
    common: dict[str, Any] = {"scenes": (scene_folder,), "runs": runs, "preset": "fast"}
    with pytest.MonkeyPatch.context() as patch:
        train_here(patch)
        for methods, strategy in ((("chronogs", "3dgs-period"), "joint"), (("4dgs",), "separate")):
            settings = bench_settings(
                **common, methods=methods, strategies=(strategy,), iterations=12
            )
            finished += run_bench(settings, lambda line: None).finished
    return {read_run(folder).method: folder for folder in finished}
