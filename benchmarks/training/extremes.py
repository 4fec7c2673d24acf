"""Outcomes of trainings on extreme scenes.

    python -m benchmarks.training.extremes [--write] [--extreme WORD ...] [--method NAME ...]

Trains every installed method on every extreme of tests/methods/support/extreme_trainings.py, and
prints a table in Markdown. With --write it replaces the one in
docs/experiments/training-extremes.md.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

# Before torch: it says how idle threads wait.
import chronoscene  # noqa: F401

# isort: split
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.kernels.runtime import keep_freed_memory, set_threads
from chronoscene.methods import load_spec, method_names

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "methods" / "support"))

extremes: Any = import_module("extreme_trainings")

PAGE = ROOT / "docs" / "experiments" / "training-extremes.md"
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
HEAD = ("extreme", "method", "steps", "outcome", "PSNR before, dB", "after, dB", "primitives")


def row(extreme: Any, name: str) -> tuple[str, ...]:
    """Cells of one training."""
    outcome = extremes.run(extreme, load_spec(name))
    reports = outcome.reports
    worse = ", but worse than at its start" if outcome.after < outcome.before else ""
    found = f"trained{worse}" if outcome.error is None else outcome.error
    if not outcome.clear:
        found = f"**traceback**: {found}"
    for skipped in ("empty", "not finite"):
        if count := sum(report.skipped == skipped for report in reports):
            found += f"; {count} steps {skipped}"
    primitives = f"{reports[-1].primitives:,}" if reports else ""
    print(f"{extreme.name}, {name}: {outcome.seconds:.1f} s", file=sys.stderr, flush=True)
    psnr = (f"{x:.1f}" for x in (outcome.before, outcome.after))
    return (extreme.name, name, str(len(reports)), found, *psnr, primitives)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help=f"write it to {PAGE.name}")
    parser.add_argument("--extreme", nargs="+", help="only extremes with one of these in the name")
    parser.add_argument("--method", nargs="+", default=method_names(), help="only these")
    args = parser.parse_args()
    keep_freed_memory()
    threads = set_threads()
    chosen = [
        extreme
        for extreme in extremes.EXTREMES
        if args.extreme is None or any(word in extreme.name for word in args.extreme)
    ]
    rows = [row(extreme, name) for extreme in chosen for name in args.method]
    lines = [HEAD, ["---"] * 4 + ["---:"] * 3, *rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    machine = f"{processor_name()}, {threads} threads, commit {code_version()}, seed 0."
    text = f"{machine}\n\n{table}\n"
    if not args.write:
        print(text)
        return
    before, rest = PAGE.read_text("utf-8").split(BEGIN)
    after = rest.split(END)[1]
    PAGE.write_text(f"{before}{BEGIN}\n{text}{END}{after}", "utf-8")


if __name__ == "__main__":
    main()
