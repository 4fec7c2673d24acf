"""Processor time and results of two versions of ``chronoscene register`` on the same photos.

    python -m benchmarks.registration.versions OTHER [PHOTOS ...] [--only NAME] [--work FOLDER]

OTHER is a checkout of another version, which runs with the packages of this environment. Both
register the same photos with one thread, the other version first: the rendered cities of `images`,
and folders of real photos as in `photos`. Prints the seconds of processor time, their ratio, and of
both versions the number of photos, the errors of poses outside of the first period, and the
verdict. Errors are those against the truth of a rendered city; for photos, the difference of the
second version from the first.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.registration import outcomes as shared
from benchmarks.registration.generated import pose_errors
from benchmarks.registration.images import CASES, make_photos
from benchmarks.registration.photos import read_periods, write_table
from chronoscene.arrays import Array
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import code_version, processor_name

HERE = Path(__file__).parents[2]
COMMAND = "from chronoscene.cli import main; main()"


@dataclass(frozen=True, slots=True)
class Registration:
    """Outcome of one command."""

    seconds: float
    """CPU time of the command and of all its processes."""
    verdict: str
    """That of the alignment; `shared.REFUSED` without a scene."""
    poses: dict[str, Array]
    """cam_from_world by the names of files. [4, 4]"""
    first: frozenset[str]
    """Names of the files of the first period."""


def register(checkout: Path, captures: Path, table: Path | None, out: Path) -> Registration:
    """Run the command of a checkout with features, matches and models of its own."""
    words = ["register", str(captures), str(out), "--threads", "1", "--overwrite", "--report"]
    words += [] if table is None else ["--table", str(table)]
    before = shared.cpu_seconds()
    done = subprocess.run(
        [sys.executable, "-P", "-c", COMMAND, *words],
        # Some versions start processes that import what is in the current folder first.
        cwd=out.parent,
        env=os.environ | {"PYTHONPATH": str(checkout)},
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = shared.cpu_seconds() - before
    if done.returncode > 1 or not (out / "sparse").is_dir():
        print(f"  {out.name}: {done.stderr.strip().splitlines()[-1:]}", flush=True)
        return Registration(seconds, shared.REFUSED, {}, frozenset())
    document = json.loads((out / "registration.json").read_text(encoding="utf-8"))
    frames = read_scene(out).frames
    return Registration(
        seconds,
        document.get("alignment", document)["verdict"],
        {Path(f.name).name: f.cam_from_world for f in frames},
        frozenset(Path(f.name).name for f in frames if f.period == 0),
    )


def errors(found: Registration, truth: dict[str, Array]) -> str:
    """Median errors of the poses outside of the first period, in the frame of that."""
    names = sorted(found.poses.keys() & truth.keys())
    first = np.array([name in found.first for name in names], bool)
    if first.sum() < 3 or first.all():
        return "-"
    poses, true = (np.stack([p[name] for name in names]) for p in (found.poses, truth))
    rotation, centre = pose_errors(poses, true, first)
    extent = shared.true_extent(true)
    turned, moved = np.median(rotation[~first]), 100 * np.median(centre[~first]) / extent
    return f"{turned:.3f}°, {moved:.3f} %"


def compare(
    checkouts: dict[str, Path],
    work: Path,
    captures: Path,
    table: Path | None = None,
    truth: dict[str, Array] | None = None,
) -> None:
    """Register by both versions, and print a row."""
    old, new = (register(path, captures, table, work / v) for v, path in checkouts.items())
    against = truth or old.poses
    before = errors(old, truth) if truth else "-"
    ratio = new.seconds / old.seconds
    print(
        f"| {work.name.replace('_', ' ')} | {old.seconds:.1f} s | {new.seconds:.1f} s | "
        f"{ratio:.2f} | "
        f"{len(old.poses)}, {before}, {old.verdict} | "
        f"{len(new.poses)}, {errors(new, against)}, {new.verdict} |",
        flush=True,
    )


def main() -> None:
    """Run the command line."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path)
    parser.add_argument("photos", type=Path, nargs="*")
    parser.add_argument("--only", default="", help="rendered cities with this in their names")
    parser.add_argument("--work", type=Path)
    given = parser.parse_args()
    print(f"{processor_name()}, one thread, {code_version()}; photos, errors, verdict\n")
    print("| photos | CPU before | CPU after | ratio | before | after |")
    print("| --- | ---: | ---: | ---: | --- | --- |", flush=True)
    with shared.work_folder(given.work) as kept:
        work = kept.resolve()
        checkouts = {"before": given.other.resolve(), "after": HERE}
        for source in given.photos:
            folder = work / source.name
            folder.mkdir(parents=True, exist_ok=True)
            table = write_table(read_periods(source), folder / "periods.csv")
            compare(checkouts, folder, source.resolve() / "images", table)
        for case in (c for c in CASES if given.only in c.name):
            folder = work / case.folder
            truth = make_photos(case, folder)
            compare(checkouts, folder, folder / "photos", truth=truth)


if __name__ == "__main__":
    main()
