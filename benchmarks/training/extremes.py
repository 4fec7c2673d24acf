"""Outcomes of trainings on extreme scenes.

    python -m benchmarks.training.extremes RESULTS [--write] [--threads N] [--extreme WORD ...]
        [--method NAME ...] [--preset NAME ...]

Trains every installed method, with every preset, on every extreme of
tests/methods/support/extreme_trainings.py, and prints a table in Markdown. RESULTS gets a line of
JSON for each training; the same command goes on after the last one. With --write the table
replaces the one in docs/experiments/training-extremes.md.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.markdown import replace_part, table
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.kernels.runtime import keep_freed_memory, set_threads
from chronoscene.methods import load_spec, method_names

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "methods" / "support"))

extremes: Any = import_module("extreme_trainings")

PAGE = ROOT / "docs" / "experiments" / "training-extremes.md"
FIRST = ("fast", "paper")  # Presets that all extremes have before any other is tried
RANKS = ("trained", "worse", "error", "traceback")
"""Outcomes, best first; worse: than the model was at its start, by more than `TOLERANCE`."""
TOLERANCE = 0.05  # dB

Result = dict[str, Any]


def train(extreme: Any, name: str, preset: str) -> Result:
    """Train once."""
    outcome = extremes.run(extreme, load_spec(name), preset)
    if outcome.error is not None:
        rank = "error" if outcome.clear else "traceback"
    else:
        rank = "worse" if outcome.after < outcome.before - TOLERANCE else "trained"
    return {
        "extreme": extreme.name,
        "method": name,
        "preset": preset,
        "outcome": rank,
        "error": outcome.error,
        "steps": len(outcome.reports),
        "empty": sum(report.skipped == "empty" for report in outcome.reports),
        "not finite": sum(report.skipped == "not finite" for report in outcome.reports),
        "before": repr(outcome.before),
        "after": repr(outcome.after),
        "primitives": outcome.reports[-1].primitives if outcome.reports else None,
        "seconds": round(outcome.seconds, 1),
        "commit": code_version(),
    }


def cell(results: Sequence[Result], presets: int, errors: list[str]) -> str:
    """Text of the worst outcome of a method on an extreme; messages are appended to ``errors``."""
    if not results:
        return "not run"
    worst = max((r["outcome"] for r in results), key=RANKS.index)
    text = worst
    if worst != "trained" or len(results) < presets:
        text += f": {', '.join(r['preset'] for r in results if r['outcome'] == worst)}"
    for message in dict.fromkeys(said(r["error"]) for r in results if r["outcome"] == worst):
        if message:
            if message not in errors:
                errors.append(message)
            text += f" [{errors.index(message) + 1}]"
    return text if len(results) == presets else f"{text} ({len(results)} of {presets})"


def said(error: str | None) -> str:
    """Return what an error expected and found, without its iteration and the remedy."""
    return re.sub(r", iteration \d+", "", (error or "").partition("; ")[0])


def worst_outcomes(results: Sequence[Result], chosen: Sequence[Any], names: Sequence[str]) -> str:
    """Table of the worst outcomes in Markdown, and the errors below it."""
    errors: list[str] = []
    lines = []
    for extreme in chosen:
        cells = []
        for name in names:
            found = [r for r in results if (r["extreme"], r["method"]) == (extreme.name, name)]
            cells.append(cell(found, len(load_spec(name).presets), errors))
        lines.append((extreme.name, *cells))
    rows = table(("extreme", *names), lines, numbers=False)
    notes = "".join(f"{i}. {message}\n" for i, message in enumerate(errors, start=1))
    return f"{rows}\n" + (f"\n{notes}" if notes else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("results", type=Path, metavar="RESULTS", help="file to continue")
    parser.add_argument("--write", action="store_true", help=f"write the table to {PAGE.name}")
    parser.add_argument("--threads", type=int, help="of the kernels")
    parser.add_argument("--extreme", nargs="+", help="only extremes with one of these in the name")
    parser.add_argument("--method", nargs="+", default=method_names(), help="only these")
    parser.add_argument("--preset", nargs="*", help="only these; none: only the table")
    args = parser.parse_args()
    keep_freed_memory()
    threads = set_threads(args.threads)
    chosen = [
        extreme
        for extreme in extremes.EXTREMES
        if args.extreme is None or any(word in extreme.name for word in args.extreme)
    ]
    args.results.touch()
    results = [json.loads(line) for line in args.results.read_text("utf-8").splitlines()]
    done = {(r["extreme"], r["method"], r["preset"]) for r in results}
    plan = [(e, n, p) for e in chosen for n in args.method for p in load_spec(n).presets]
    plan = [(e, n, p) for e, n, p in plan if args.preset is None or p in args.preset]
    for extreme, name, preset in sorted(plan, key=lambda run: run[2] not in FIRST):
        if (extreme.name, name, preset) in done:
            continue
        results.append(train(extreme, name, preset))
        with args.results.open("a", encoding="utf-8") as file:
            file.write(json.dumps(results[-1]) + "\n")
        shown = (results[-1][key] for key in ("outcome", "seconds"))
        print(f"{extreme.name}, {name}, {preset}:", *shown, file=sys.stderr, flush=True)
    commits = ", ".join(dict.fromkeys(result["commit"][:7] for result in results))
    machine = f"{processor_name()}, threads: {threads}, commit {commits or code_version()}, seed 0."
    text = f"{machine}\n\n{worst_outcomes(results, chosen, args.method)}"
    if args.write:
        replace_part(PAGE, "table", text)
    else:
        print(text)


if __name__ == "__main__":
    main()
