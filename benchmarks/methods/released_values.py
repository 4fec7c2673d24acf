"""Effect of each value of a method's released code: differences of a study, paired by seed.

    python -m benchmarks.methods.released_values 4dgs-released SCENE [--seeds 3] [--out runs]

Runs what is not finished of the study (preset ``fast``, one thread), as ``chronoscene study`` does.
For each row it prints the macro PSNR and SSIM of the test views, the PSNR less that of the first
row with the same seed, and the number of primitives: mean and sample standard deviation over seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.markdown import table
from chronoscene.harness.files.records import RunRecord, read_run
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.study.plan import find_study, read_study, run_study

HEADS = ("row", "PSNR", "difference", "SSIM", "primitives", "seeds")


def table_rows(runs: Mapping[str, Sequence[RunRecord]]) -> list[list[str]]:
    """Cells of one line per label; the first label is what the others are compared with."""
    first = {run.seed: run for run in next(iter(runs.values()))}
    rows = []
    for label, records in runs.items():
        both = [(psnr(run) - psnr(first[run.seed])) for run in records if run.seed in first]
        ssims = [run.aggregates["macro"]["ssim"] for run in records]
        counts = [run.primitives or 0 for run in records]
        cells = [spread([psnr(run) for run in records]), spread(both), spread(ssims, 3)]
        rows.append([label, *cells, spread(counts, 0, sd=False), str(len(records))])
    return rows


def psnr(run: RunRecord) -> float:
    """Mean over periods, in dB."""
    return run.aggregates["macro"]["psnr"]


def spread(values: Sequence[float], digits: int = 2, *, sd: bool = True) -> str:
    """Format a mean, with the standard deviation if there are two values."""
    if not values:
        return "-"
    text = f"{np.mean(values):,.{digits}f}"
    return f"{text} ± {np.std(values, ddof=1):.{digits}f}" if sd and len(values) > 1 else text


def main() -> None:
    """Run a study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("study", help="name of a study, or FILE.toml")
    parser.add_argument("scene", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("runs"))
    given = parser.parse_args()
    options = {"preset": "fast", "threads": 1, "seeds": tuple(range(given.seeds))}
    settings = bench_settings([given.scene], (), given.out, **options)
    _, finished = run_study(read_study(find_study(given.study)), settings, print)
    runs = {label: [read_run(folder) for folder in folders] for label, folders in finished.items()}
    print(table(HEADS, table_rows(runs)))


if __name__ == "__main__":
    main()
