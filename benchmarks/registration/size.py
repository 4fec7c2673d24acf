"""Time and memory of each stage of a registration against the number of photos.

    python -m benchmarks.registration.size FOLDER [--views 10 24 72]

Renders a city at four dates, so many photos a date on average, and registers them with one thread
by the whole command, with 3 m of GPS noise and 10% gross errors. Each number of photos is one run,
whose figures stay in FOLDER: the next call does only what is missing. Prints, by stage, seconds of
processor time and the peak memory of the process that does the work, then how they grow, and the
errors of poses against the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks.markdown import exponents, table
from benchmarks.registration import outcomes as shared
from benchmarks.registration.images import ImageCase, make_photos, true_poses
from chronoscene.harness.files.provenance import code_version, peak_memory_bytes, processor_name
from chronoscene.harness.train.warm_up import forget_peak_memory
from chronoscene.io.processes import Outcome, Report, run_worker
from chronoscene.methods.spec import import_object
from chronoscene.registration.output import Inspection
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.pipeline import run
from chronoscene.registration.result import Registered

MODULE = "benchmarks.registration.size"
HERE = {"PYTHONPATH": str(Path(__file__).parents[2])}
"""Environment of worker processes, which import nothing from the current folder."""

PACKAGE = "chronoscene.registration"

COMMAND = {
    "pipeline.gather": "photos and GPS",
    "reconstruct.estimation.read_model": "reading the model",
    "reconstruct.estimation.without_twins": "reading the model",
    "reconstruct.estimation.read_held_out": "reading the model",
    "pipeline._stage_scene": "undistortion",
    "output.certify": "certificate",
    "output.render_report": "page",
}
TASKS = {
    "features.matching.choose_pairs": "pairs",
    "features.matching.store_matches": "matching",
    "features.matching._verify": "verification",
    "features.matching.hold_out": "held-out tracks",
    "reconstruct.routes.map_images": "mapping",
    "reconstruct.routes.with_full_lens": "lens",
    "reconstruct.routes._settled": "misplaced images",
    "reconstruct.routes.adjust": "bundle adjustment",
    "reconstruct.routes.to_gps_frame": "alignment with GPS",
    "reconstruct.mapping.write_model": "writing the model",
}
"""Stages by the functions that do them, named as their callers know them: those of the command's
own process, and those of the tasks. What one of them calls is a stage of its own."""


class Clock:
    """Processor seconds of this process and its peak memory, by stage."""

    def __init__(self, stage: str) -> None:
        self.stage, self.since = stage, time.process_time()
        self.seconds: dict[str, float] = defaultdict(float)
        self.bytes: dict[str, int] = defaultdict(int)
        forget_peak_memory()

    def switch(self, stage: str) -> str:
        """Begin another stage; return the one before."""
        now, before = time.process_time(), self.stage
        self.seconds[before] += now - self.since
        self.bytes[before] = max(self.bytes[before], peak_memory_bytes() or 0)
        self.stage, self.since = stage, now
        forget_peak_memory()
        return before

    def record(self) -> dict[str, list[float]]:
        """Seconds and bytes of each stage so far."""
        self.switch(self.stage)
        return {stage: [self.seconds[stage], self.bytes[stage]] for stage in self.seconds}


@contextmanager
def timed(clock: Clock, stages: Mapping[str, str]) -> Iterator[None]:
    """Let functions of the package tell the clock when they run."""
    with ExitStack() as patches:
        for name, stage in stages.items():
            module, _, function = f"{PACKAGE}.{name}".rpartition(".")
            inner = import_object(f"{module}:{function}")
            patches.enter_context(patch(f"{module}.{function}", _timed(clock, stage, inner)))
        yield


def _timed(clock: Clock, stage: str, inner: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(inner)
    def outer(*arguments: Any, **settings: Any) -> Any:
        before = clock.switch(stage)
        try:
            return inner(*arguments, **settings)
        finally:
            clock.switch(before)

    return outer


def _case(views: int) -> ImageCase:
    return ImageCase(f"{views} a date", 51, periods=4, views=views, blocks=3, width=640, height=480)


def profiled(job: Mapping[str, Any], report: Report) -> Any:
    """Run a task of the work folder under a clock, and write its record. Worker process only."""
    name = job["function"].rpartition(":")[2]
    function = import_object(job["function"])
    clock = Clock("features" if name == "extract" else f"rest of {name}")
    with timed(clock, TASKS):
        result = function(job["job"], report)
    Path(job["record"]).write_text(json.dumps(clock.record()), encoding="utf-8")
    return result


def measure(job: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Register the photos of so many views a date, and return the figures. Worker process only."""
    work, case = Path(job["work"]), _case(job["views"])
    truth = make_photos(case, work)
    found: list[Inspection] = []
    records: list[Path] = []

    def worker(
        function: str, job: Any, *, environment: Mapping[str, str], **settings: Any
    ) -> Outcome:
        records.append(work / f"record-{len(records)}.json")
        job = {"function": function, "job": job, "record": str(records[-1])}
        return run_worker(
            f"{MODULE}:profiled", job, environment={**environment, **HERE}, **settings
        )

    options = replace(shared.options_for(work / "work", None), threads=1)
    start, cpu, load = time.perf_counter(), shared.cpu_seconds(), os.getloadavg()[0]
    clock = Clock("rest")
    with timed(clock, COMMAND), patch(f"{PACKAGE}.work_folder.run_worker", worker):
        captures = read_captures(work / "photos")
        model = run(captures, work / "registered", options, inspected=found.append)
    seconds = shared.cpu_seconds() - cpu
    stages = [json.loads(path.read_text(encoding="utf-8")) for path in records]
    poses = true_poses(model, truth)
    outcome = shared.judged(case.name, "", model, poses, found[-1].verdict, seconds)
    shared.print_outcome(outcome, found[-1])
    matches = json.loads((work / "work/stage-matches.json").read_text(encoding="utf-8"))
    return {
        "machine": f"{processor_name()}, {os.cpu_count()} processors, one thread, load {load:.1f} "
        f"to {os.getloadavg()[0]:.1f}, commit {code_version()}",
        "photos": len(truth),
        "elapsed": time.perf_counter() - start,
        "seconds": seconds,
        "stages": _joined([*stages, clock.record()]),
        "counts": _counts(model, matches["result"]),
        "periods": outcome.periods,
        "verdict": outcome.verdict,
        "remarks": [*matches["remarks"], found[-1].verdict.text],
    }


def _joined(records: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, tuple[float, float]]:
    """Seconds and peak bytes of each stage over all processes, in the order of their work."""
    names = dict.fromkeys(name for record in records for name in record)
    found = {name: [r[name] for r in records if name in r] for name in names}
    return {k: (sum(s for s, _ in v), max(b for _, b in v)) for k, v in found.items()}


def _counts(model: Registered, matches: Mapping[str, Any]) -> dict[str, int]:
    """Sizes of what the stages work on."""
    return {
        "registered": len(model.names),
        "pairs": matches["pairs"],
        "verified pairs": matches["verified"],
        "matches": matches["inliers"],
        "points": len(model.points),
        "observations": len(model.track_image),
    }


def growth_table(runs: Sequence[Mapping[str, Any]]) -> str:
    """Seconds and memory by stage and number of photos, with exponents, as Markdown."""
    sizes = [figures["photos"] for figures in runs]
    growth = [f"{a} to {b}" for a, b in pairwise(sizes)]
    heads = ["", *(f"{n} photos" for n in sizes), *growth]
    rows = []

    def row(name: str, values: Sequence[float], texts: Sequence[str], least: float) -> None:
        """Add a row, with exponents where the values are large enough to have any."""
        rows.append([name, *texts, *exponents(values, sizes, least)])

    for name in runs[0]["counts"]:
        numbers = [figures["counts"][name] for figures in runs]
        row(name, numbers, [f"{n:,}" for n in numbers], 0)
    nothing = [0.0, 0]
    for name in dict.fromkeys(name for figures in runs for name in figures["stages"]):
        found = [figures["stages"].get(name, nothing) for figures in runs]
        texts = [f"{s:.1f} s, {b / 1e9:.2f} GB" for s, b in found]
        row(name, [s for s, _ in found], texts, 0.5)
    total = [figures["seconds"] for figures in runs]
    row("all", total, [f"{s:.0f} s" for s in total], 0)
    errors = [[max(p[k] for p in figures["periods"]) for k in (0, 2)] for figures in runs]
    worst = [
        f"{r:.3f}°, {c:.3f} %, {figures['verdict']}"
        for (r, c), figures in zip(errors, runs, strict=True)
    ]
    rows.append(["worst date, verdict", *worst, *("" for _ in growth)])
    return table(heads, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="keeps photos, models and figures")
    parser.add_argument("--views", type=int, nargs="+", default=(10, 24, 72), help="of each date")
    options = parser.parse_args()
    runs = []
    for views in options.views:
        work = options.folder / f"{views}-a-date"
        file = work / "figures.json"
        if not file.is_file():
            work.mkdir(parents=True, exist_ok=True)
            make_photos(_case(views), work)  # here, so that its memory is not in the figures
            job = {"views": views, "work": str(work.resolve())}
            outcome = run_worker(f"{MODULE}:measure", job, environment=HERE)
            if outcome.message is None or "result" not in outcome.message:
                raise SystemExit(f"{views} views a date: {outcome.message or outcome.cause}")
            text = json.dumps(outcome.message["result"], indent=1)
            file.write_text(text + "\n", encoding="utf-8")
        runs.append(json.loads(file.read_text(encoding="utf-8")))
        print(runs[-1]["machine"], *runs[-1]["remarks"], sep="\n  ", flush=True)
    print("\n" + growth_table(runs))


if __name__ == "__main__":
    main()
