"""Periods of real photos against one reconstruction of all of them; used by `accuracy.py`.

A folder has ``images/`` and may have ``periods.csv`` (columns ``file`` and ``period``). Photos of
one date are dealt in turn into two pseudo-periods. There is no truth: what is compared with is the
model that all photos give as one period, with one camera.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.registration import outcomes as shared
from benchmarks.registration.generated import pose_errors
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import read_scene
from chronoscene.registration.output import Inspection
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.pipeline import run
from chronoscene.registration.result import Registered
from chronoscene.scene.splits import IMAGE_SUFFIXES

PSEUDO = ("first", "second")
"""Labels of the pseudo-periods."""

LEAST_COMMON = 3
"""Images of the first period in both models: fewer define no frame."""


def run_photos(options: argparse.Namespace) -> list[shared.Outcome]:
    """Register every folder by every route, with the options of `accuracy.py`."""
    outcomes = []
    routes = shared.ROUTES if options.route == "all" else (options.route,)
    with shared.work_folder(options.work) as work:
        for source in options.folders:
            folder = work / source.name
            periods = read_periods(source)
            start = time.perf_counter()
            try:
                single = _run(source, folder, "single", dict.fromkeys(periods, "all"), None, [])
            except ChronoSceneError as error:
                print(f"{source.name}: refused: {error}", flush=True)
                continue
            print(
                f"{source.name}, all photos as one period: {len(single.names)} of {len(periods)} "
                f"photos, {time.perf_counter() - start:.0f} s",
                flush=True,
            )
            reference = {
                Path(name).name: pose
                for name, pose in zip(single.names, single.cam_from_world, strict=True)
            }
            outcomes += [_compare(source, folder, periods, reference, r) for r in routes]
    return outcomes


def read_periods(source: Path) -> dict[str, str]:
    """Label of the period of each photo, by file name."""
    table = source / "periods.csv"
    if table.is_file():
        with table.open(newline="", encoding="utf-8") as lines:
            periods = {row["file"]: row["period"] for row in csv.DictReader(lines)}
    else:
        found = (source / "images").iterdir()
        periods = dict.fromkeys((p.name for p in found if p.suffix.lower() in IMAGE_SUFFIXES), "")
    if len(set(periods.values())) == 1:
        periods = {name: PSEUDO[i % 2] for i, name in enumerate(sorted(periods))}
    return periods


def write_table(periods: dict[str, str], table: Path) -> Path:
    """Write the table of periods that ``register --table`` takes; return its path."""
    rows = "".join(f"{file},{label}\n" for file, label in sorted(periods.items()))
    table.write_text(f"image,period\n{rows}", encoding="utf-8")
    return table


def _compare(
    source: Path,
    folder: Path,
    periods: dict[str, str],
    reference: dict[str, NDArray[np.float64]],
    route: str,
) -> shared.Outcome:
    found: list[Inspection] = []
    start, cpu, count = time.perf_counter(), shared.cpu_seconds(), len(set(periods.values()))
    try:
        if route == "frozen":
            model = _frozen(source, folder, periods, found)
        else:
            chosen = None if route == "auto" else route
            model = _run(source, folder, route, periods, chosen, found)
    except ChronoSceneError as error:
        print(f"{source.name}, {route}: refused: {error}", flush=True)
        return shared.refused(source.name, route, count, shared.cpu_seconds() - cpu)
    seconds, cpu = time.perf_counter() - start, shared.cpu_seconds() - cpu
    common = np.array([Path(name).name in reference for name in model.names])
    if (common & (model.periods == 0)).sum() < LEAST_COMMON:
        print(f"{source.name}, {route}: too few photos in common with the single model")
        return shared.refused(source.name, route, count, cpu)
    poses = np.stack([reference.get(Path(name).name, np.eye(4)) for name in model.names])
    verdict = found[-1].verdict
    outcome = shared.judged(source.name, route, model, poses, verdict, cpu, where=common)
    print(
        f"{source.name}, {route}: route {model.route}, {len(model.names)} of {len(periods)} "
        f"photos, {seconds:.0f} s",
        flush=True,
    )
    _print_first(model, poses, common & (model.periods == 0))
    shared.print_outcome(outcome, found[-1])
    return outcome


def _print_first(model: Registered, poses: NDArray[np.float64], first: NDArray[np.bool_]) -> None:
    """Print the error of the first period by itself, a lower bound for the other periods."""
    rotation, centre = pose_errors(model.cam_from_world, poses, first)
    extent = shared.true_extent(poses[first])
    print(
        f"  first period by itself: rotation {np.median(rotation[first]):.4f} degrees, centre "
        f"{100 * np.median(centre[first]) / extent:.4f} % of its extent"
    )


def _run(
    source: Path,
    folder: Path,
    name: str,
    periods: dict[str, str],
    route: str | None,
    found: list[Inspection],
) -> Registered:
    """One run of the command on some of the photos, with features and matches of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    table = write_table(periods, folder / f"{name}.csv")
    captures = read_captures(source / "images", table=table)
    options = shared.options_for(folder / f"work-{name}", route)
    return run(captures, folder / name, options, inspected=found.append)


def _frozen(
    source: Path, folder: Path, periods: dict[str, str], found: list[Inspection]
) -> Registered:
    """The first period is registered alone; the other is added to it."""
    first, last = sorted(set(periods.values()))[0], sorted(set(periods.values()))[-1]
    old = {name: label for name, label in periods.items() if label == first}
    _run(source, folder, "old", old, None, [])
    new = folder / "new" / last
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    for name, label in periods.items():
        if label == last:
            shutil.copyfile(source / "images" / name, new / name)
    options = shared.options_for(folder / "work-frozen", None)
    scene = read_scene(folder / "old")
    return run(read_captures(new), folder / "frozen", options, into=scene, inspected=found.append)
