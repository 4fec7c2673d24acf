"""Seconds and peak memory of the dataset commands on skeletons of the paper's twelve scenes.

    python -m benchmarks.data.dataset_scale [--data FOLDER] [--repeats 3] [--only stats]

Every command runs as a user would start it, in a process of its own, so that start-up and imports
count. ``--data`` keeps the skeletons (about 1.1 GB) for the next time; else they go to a temporary
folder. Prints the median and the minimum over the repeats of the elapsed and of the CPU time, the
largest resident memory of a process and of all of them together, and whether the target is met.
On a machine with other work look at the minimum.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import psutil

from chronoscene.harness.files.provenance import processor_name
from chronoscene.io.staging import staged_folder
from chronoscene.statistics.counts import PAPER_COUNTS

SCENE = "Aerial3"
"""The scene with the most points: 800 images, 530,434 points."""


@dataclass(frozen=True, slots=True)
class Case:
    """A command to measure."""

    name: str
    arguments: tuple[str, ...]
    """Arguments of ``chronoscene``; DATA and OUT stand for folders."""
    seconds: float | None = None
    """Target for the elapsed time."""
    gigabytes: float | None = None
    """Target for the memory of all processes together."""


CASES = (
    Case("validate, one scene", ("validate", f"DATA/{SCENE}"), seconds=2.0),
    Case("validate, all", ("validate", "DATA"), seconds=20.0, gigabytes=2.0),
    Case("validate, all, decoded", ("validate", "DATA", "--decode")),
    Case("stats, one scene", ("stats", f"DATA/{SCENE}")),
    Case("stats, all", ("stats", "DATA"), seconds=15.0),
    Case("figures, one scene", ("stats", f"DATA/{SCENE}", "--figures", "OUT"), seconds=3.0),
    Case("page, one scene", ("stats", f"DATA/{SCENE}", "--pages", "OUT")),
    Case("figures, all", ("stats", "DATA", "--figures", "OUT")),
)


@dataclass(frozen=True, slots=True)
class Run:
    """Time and memory of one run."""

    elapsed: float
    cpu: float
    """CPU time of the process and its children, in seconds."""
    largest: float
    """Resident gigabytes of the largest process."""
    together: float
    """Resident gigabytes of all processes at one time; shared pages count in each."""


class MemoryWatch(threading.Thread):
    """Looks at the resident memory of a process and its children every few milliseconds."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self.process = psutil.Process(pid)
        self.largest = self.together = 0
        self.done = threading.Event()

    def run(self) -> None:
        while not self.done.wait(0.02):
            try:
                family = [self.process, *self.process.children(recursive=True)]
                sizes = [p.memory_info().rss for p in family]
            except psutil.Error:  # one of them has just ended
                continue
            self.largest = max(self.largest, *sizes)
            self.together = max(self.together, sum(sizes))


def measure(case: Case, data: Path) -> Run:
    """Run a case once."""
    with tempfile.TemporaryDirectory() as out:
        arguments = [a.replace("DATA", str(data)).replace("OUT", out) for a in case.arguments]
        return measure_command(case.name, arguments)


def measure_command(name: str, arguments: Sequence[str]) -> Run:
    """Run a command of ``chronoscene`` once, in a process of its own."""
    code = "from chronoscene.cli import main; main()"
    before, start = os.times(), time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    watch = MemoryWatch(process.pid)
    watch.start()
    _, errors = process.communicate()
    elapsed, after = time.perf_counter() - start, os.times()
    watch.done.set()
    if process.returncode != 0:
        raise SystemExit(f"{name}: status {process.returncode}\n{errors.decode()}")
    cpu = sum(after[2:4]) - sum(before[2:4])
    return Run(elapsed, cpu, watch.largest / 1e9, watch.together / 1e9)


@contextmanager
def skeletons(folder: Path | None) -> Iterator[Path]:
    """Folder of the skeletons, which are made where there are none yet."""
    from benchmarks.data.skeletons.dataset import write_skeleton

    with tempfile.TemporaryDirectory() as temporary:
        data = folder or Path(temporary) / "skeletons"
        if not data.exists():
            start = time.perf_counter()
            with staged_folder(data) as staged:
                for i, (name, counts) in enumerate(PAPER_COUNTS.items()):
                    write_skeleton(staged / name, counts, seed=7919 * i)
            print(f"skeletons made in {time.perf_counter() - start:.1f} s")
        yield data


def report(case: Case, runs: list[Run]) -> str:
    """A row of the table."""
    elapsed = [r.elapsed for r in runs]
    together = max(r.together for r in runs)
    verdict = []
    if case.seconds is not None:
        verdict.append(
            f"{'met' if median(elapsed) <= case.seconds else 'MISSED'}: {case.seconds} s"
        )
    if case.gigabytes is not None:
        verdict.append(f"{'met' if together <= case.gigabytes else 'MISSED'}: {case.gigabytes} GB")
    return (
        f"{case.name:<24}{median(elapsed):8.2f}{min(elapsed):8.2f}"
        f"{median(r.cpu for r in runs):8.2f}{min(r.cpu for r in runs):8.2f}"
        f"{max(r.largest for r in runs):9.2f}{together:9.2f}  {', '.join(verdict)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the skeletons; made if it is missing")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", default="", help="cases whose name begins so")
    options = parser.parse_args()
    print(f"{processor_name()}, {os.cpu_count()} processors, {options.repeats} runs each")
    with skeletons(options.data) as data:
        print(f"{'':<24}{'elapsed [s]':>16}{'CPU [s]':>16}{'peak memory [GB]':>18}")
        print(f"{'':<24}" + f"{'median':>8}{'min':>8}" * 2 + f"{'process':>9}{'all':>9}  target")
        for case in CASES:
            if case.name.startswith(options.only):
                runs = [measure(case, data) for _ in range(options.repeats)]
                print(report(case, runs), flush=True)


if __name__ == "__main__":
    main()
