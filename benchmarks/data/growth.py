"""Time, memory and disk of the commands against the number of photos, or of anchors.

    python -m benchmarks.data.growth FOLDER [--photos 100 300 700] [--steps 300] [--methods M ...]
    python -m benchmarks.data.growth FOLDER --anchors 100000 300000 1000000 --photos 100 --steps 20

Generates a city at five dates, with photos of 1600x1200 pixels (one ray a pixel, no ground truth)
and at most 500,000 points; smaller scenes have every n-th photo of it, and the points that two of
these see. Trains each method for so many steps of preset `balanced`; the first one's run is
rendered, compressed, exported and shown in a page. Each command runs once, in a process of its own.
Its figures stay in FOLDER: the next call does only what is missing. Prints seconds of computing
time, the largest resident memory of all processes together and what lies on the disk, then how
they grow.

With ``--anchors``, one scene with 1.5 million points is trained with so many anchors, none of which
is added or removed. The exponents are of the numbers that the models have, as anchors start in
cells, which are made larger until there are few enough.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.data.dataset_scale import measure_command
from benchmarks.markdown import exponents, table
from chronoscene.edit import Edits, edit
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.harness.use.trained_run import open_run
from chronoscene.scene import Frame
from chronoscene.synth import generate, preset

PERIODS = 5
SIZE = (1600, 1200)
POINTS = 500_000
POINTS_FOR_ANCHORS = 1_500_000
PRESET = "balanced"
FRAMES = 24
"""Pictures of the animation."""
MEASURES = (("CPU s", "cpu", 0), ("GB of memory", "together", 2), ("MB on disk", "disk", 1))
"""Name, key and digits."""

Figures = dict[str, dict[str, float]]
"""Elapsed and CPU seconds, gigabytes, and megabytes on the disk, by command."""


@dataclass(frozen=True, slots=True)
class Case:
    """A scene, and how methods train on it."""

    name: str
    """Folder of its runs, and name of its figures."""
    scene: Path
    options: tuple[str, ...] = ()
    """Options of ``bench``, beside those of all cases."""


def make_scene(folder: Path, photos: int, points: int) -> None:
    """Generate the largest scene."""
    settings = preset(
        "city",
        periods=PERIODS,
        width=SIZE[0],
        height=SIZE[1],
        views=photos // PERIODS,
        points=points,
        supersample=1,
        seed=11,
    )
    generate(folder, settings, truth=False)


def thin_out(whole: Path, folder: Path, photos: int) -> None:
    """Write a scene of so many photos of another, evenly among those of each split."""
    scene = read_scene(whole)
    share = photos / len(scene.frames)

    def some(frames: Sequence[Frame]) -> list[str]:
        chosen = pairwise(math.floor(i * share) for i in range(len(frames) + 1))
        return [f.name for f, (a, b) in zip(frames, chosen, strict=True) if b > a]

    keep = (*some(scene.select(split="train")), *some(scene.select(split="test")))
    edit(scene, folder, Edits(keep=keep), image_source="link")


def commands(
    folder: Path, case: Case, methods: Sequence[str], steps: int
) -> Iterator[tuple[str, list[str], str]]:
    """Name, arguments and output of each command; the output is a pattern below the folder.

    Each is made when those before have run, whose output it may need. The first two write nothing:
    theirs is the scene.
    """
    scene, out = case.scene, f"out/{case.name}"
    runs = f"runs/{case.name}/{scene.name}"
    yield "validate", ["validate", str(scene)], scene.name
    yield "stats", ["stats", str(scene)], scene.name
    for method in methods:
        options = ["--method", method, "--preset", PRESET, "--iterations", str(steps)]
        place = ["--out", f"{folder}/runs/{case.name}"]
        words = ["bench", str(scene), *options, *case.options, *place]
        yield f"bench, {method}", words, f"{runs}/{method}-*{PRESET}*/seed0/checkpoint"
    run = str(first_run(folder, case, methods[0]))
    film = ["--cameras", "orbit", "--period", "0", "--frames", str(FRAMES)]
    yield "render", ["render", run, *film, "--out", f"{folder / out}/film.mp4"], f"{out}/film.mp4"
    yield "compress", ["compress", run], f"{runs}/{methods[0]}-*compressed*/seed0/checkpoint"
    model = ["--period", "0", "--out", f"{folder / out}/model.ply"]
    yield "export", ["export", run, *model], f"{out}/model.ply"
    yield "page", ["page", run, "--out", f"{folder / out}/page"], f"{out}/page"


def first_run(folder: Path, case: Case, method: str) -> Path:
    """Find the run of a method that is not compressed."""
    found = (folder / "runs" / case.name / case.scene.name).glob(f"{method}-*{PRESET}*/seed0")
    return min(path for path in found if "compressed" not in str(path))


def measure(folder: Path, case: Case, methods: Sequence[str], steps: int) -> Figures:
    """Run what is missing and return the figures of all commands."""
    file = folder / f"{case.name}.json"
    figures: Figures = json.loads(file.read_text("utf-8")) if file.exists() else {}
    (folder / "out" / case.name).mkdir(parents=True, exist_ok=True)
    for name, arguments, output in commands(folder, case, methods, steps):
        if name in figures:
            continue
        found = asdict(measure_command(f"{name}, {case.name}", arguments))
        figures[name] = {**found, "disk": size_of(next(folder.glob(output))) / 1e6}
        file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        print(case.name, name, figures[name], flush=True)
    return figures


def size_of(path: Path) -> int:
    """Bytes of a file, or of all in a folder."""
    return sum(p.stat().st_size for p in (path, *path.rglob("*")) if p.is_file())


def tables(figures: Mapping[int, Figures], of: str) -> str:
    """Each measure by command and number of photos or anchors, with exponents, as Markdown."""
    sizes = list(figures)
    growth = [f"{a:,} to {b:,}" for a, b in pairwise(sizes)]
    found = []
    for title, key, digits in MEASURES:
        heads = ["", f"{title}: {sizes[0]:,} {of}", *(f"{n:,}" for n in sizes[1:]), *growth]
        rows = []
        for name in next(iter(figures.values())):
            values = [figures[n][name][key] if name in figures[n] else None for n in sizes]
            texts = ["-" if value is None else f"{value:,.{digits}f}" for value in values]
            rows.append([name, *texts, *exponents(values, sizes)])
        found.append(table(heads, rows) + "\n")
    return "\n".join(found)


def about(scene: Path) -> str:
    """Describe a scene in a line."""
    found = read_scene(scene)
    tests, points = len(found.select(split="test")), len(found.points)
    return f"{scene.name}: {len(found.frames)} photos, {tests} of them test views, {points} points"


def photo_cases(folder: Path, sizes: Sequence[int]) -> list[Case]:
    """Make the scenes with so many photos that are not there yet."""
    cases = [Case(f"photos-{n}", folder / f"photos-{n}") for n in sizes]
    whole = cases[-1].scene
    if not whole.exists():
        make_scene(whole, sizes[-1], POINTS)
    for case, n in zip(cases[:-1], sizes[:-1], strict=True):
        if not case.scene.exists():
            thin_out(whole, case.scene, n)
    return cases


def anchor_cases(folder: Path, sizes: Sequence[int], photos: int) -> list[Case]:
    """Make the scene that has points enough for the largest model."""
    scene = folder / f"dense-{photos}"
    if not scene.exists():
        make_scene(scene, photos, POINTS_FOR_ANCHORS)
    options = ("--set", "density_until=0", "--set")
    return [Case(f"anchors-{n}", scene, (*options, f"max_initial_anchors={n}")) for n in sizes]


def number_of(folder: Path, case: Case, method: str, of: str) -> int:
    """Count the photos or the anchors of a case."""
    if of == "photos":
        return len(read_scene(case.scene).frames)
    return open_run(first_run(folder, case, method)).record.primitives


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="keeps scenes, runs and figures")
    parser.add_argument("--photos", type=int, nargs="+", default=[100, 300, 700])
    parser.add_argument("--anchors", type=int, nargs="+", help="grow these, in one scene")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--methods", nargs="+", default=["chronogs", "scaffold-gs", "3dgs"])
    options: Any = parser.parse_args()
    folder, methods, steps = options.folder, options.methods, options.steps
    if options.anchors:
        cases = anchor_cases(folder, sorted(options.anchors), max(options.photos))
        methods, of = methods[:1], "anchors"
    else:
        cases, of = photo_cases(folder, sorted(options.photos)), "photos"
    found = {}
    for case in cases:
        figures = measure(folder, case, methods, steps)
        found[number_of(folder, case, methods[0], of)] = figures
    shutil.rmtree(folder / "out", ignore_errors=True)
    print(f"{processor_name()}, commit {code_version()}, {steps} steps")
    print(*dict.fromkeys(about(case.scene) for case in cases), "", tables(found, of), sep="\n")


if __name__ == "__main__":
    main()
