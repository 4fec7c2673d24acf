"""Registrations of known truth: errors of poses by period, and whether the verdict can be trusted.

    python -m benchmarks.registration.accuracy observations [--cases 300] [--seed 0] [--only FAMILY]
        [--save FILE] [--before FILE]
    python -m benchmarks.registration.accuracy images [--seed 0] [--only NAME] [--work FOLDER]
        [--route joint]
    python -m benchmarks.registration.accuracy photos FOLDER... [--work FOLDER] [--route joint]

``observations`` generates matches and poses without images (`generated.py`), in
families of what can go wrong. ``images`` renders small cities at several dates and runs the
command ``chronoscene register`` on the photos, with GPS noise of 3 m and 10% gross errors in them,
by each of its routes. ``photos`` takes real photos, deals them into periods, and compares with the
one reconstruction of all of them.

A registration is right if the median rotation of every period is within 0.1 degrees and its median
centre within 0.2% of the scene's extent, in the frame of the first period's cameras. The extent is
that of the cameras, or the median depth of points if that is larger, and the depth of points may
not change by more either. The confusion table sets that against the verdict; ``--before`` compares
it with outcomes of another version. The exit status is 1 if a wrong registration was passed. Photos
have no truth, so there is no such table for them.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.markdown import table
from benchmarks.registration.generated import CaseSettings, generate_case
from benchmarks.registration.images import run_images
from benchmarks.registration.outcomes import REFUSED, Outcome, judged, load, save
from benchmarks.registration.photos import run_photos
from chronoscene.harness.files.provenance import processor_name
from chronoscene.registration.quality.certificate import certify
from chronoscene.registration.quality.thresholds import LEVELS
from chronoscene.registration.quality.verdict import judge


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _common(rng: np.random.Generator) -> dict[str, object]:
    """Draw the settings that vary in all families: size, noise, change, GPS or none."""
    return {
        "seed": int(rng.integers(2**31)),
        "views": int(rng.integers(8, 20)),
        "points": int(rng.integers(1500, 4000)),
        "noise": float(rng.uniform(0.3, 0.8)),
        "changed": float(rng.uniform(0.1, 2.0)),
        "gps_noise": 3.0 if rng.random() < 0.6 else None,
        "periods": 4 if rng.random() < 0.25 else 2,
    }


FAMILIES: dict[str, Callable[[np.random.Generator], dict[str, object]]] = {
    "good": lambda rng: {"ties": int(rng.integers(300, 1500))},
    "few ties": lambda rng: {"ties": int(_log_uniform(rng, 8, 200))},
    "ties in one spot": lambda rng: {
        "ties": int(rng.integers(60, 500)), "cluster": rng.uniform(6, 35)
    },
    "outliers": lambda rng: {
        "ties": int(rng.integers(200, 800)), "outliers": rng.uniform(0.2, 0.7)
    },
    "repeated structure": lambda rng: {
        "ties": int(rng.integers(100, 800)), "repeated": rng.uniform(0.15, 1.0),
        "step": _log_uniform(rng, 0.6, 15), "cluster": None if rng.random() < 0.5 else 25.0,
    },
    "a little wrong": lambda rng: {
        "ties": int(rng.integers(200, 1000)), "rotation": _log_uniform(rng, 0.02, 0.5),
        "shift": _log_uniform(rng, 0.02, 1.5),
    },
    "very wrong": lambda rng: {
        "ties": int(rng.integers(100, 600)), "rotation": _log_uniform(rng, 0.5, 30),
        "shift": _log_uniform(rng, 1, 60), "scale": rng.normal(0, 0.1),
    },
    "by GPS": lambda rng: {
        "by_gps": True, "ties": int(_log_uniform(rng, 5, 300)), "gps_noise": 3.0
    },
    "chain": lambda rng: {"periods": 4, "chain": True, "ties": int(rng.integers(50, 500))},
    "doming": lambda rng: {
        "ties": int(rng.integers(200, 1000)), "doming": _log_uniform(rng, 0.05, 5)
    },
    "drift in scale": lambda rng: {
        "ties": int(rng.integers(200, 1000)), "scale": _log_uniform(rng, 5e-4, 0.05)
    },
    "forward-facing": lambda rng: {
        "ties": int(_log_uniform(rng, 60, 1000)), "arc": _log_uniform(rng, 10, 40)
    },
    "forward-facing, an error": lambda rng: {
        "ties": int(rng.integers(100, 1000)), "arc": _log_uniform(rng, 10, 40),
        "rotation": _log_uniform(rng, 0.02, 0.5), "shift": _log_uniform(rng, 0.01, 1),
        "scale": _log_uniform(rng, 5e-4, 0.02),
    },
    "forward-facing, repeated structure": lambda rng: {
        "ties": int(rng.integers(100, 800)), "arc": _log_uniform(rng, 10, 40),
        "repeated": rng.uniform(0.15, 1.0), "step": _log_uniform(rng, 1, 10),
    },
}  # fmt: skip
"""Families of errors, as changes of `CaseSettings`."""


def observation_cases(count: int, seed: int, only: str) -> Iterator[tuple[str, CaseSettings]]:
    """Cases of all families in turn."""
    names = [n for n in FAMILIES if only in n]
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        family = names[i % len(names)]
        values = _common(rng) | FAMILIES[family](rng)
        yield family, CaseSettings(**values)  # type: ignore[arg-type]


def run_observations(count: int, seed: int, only: str) -> list[Outcome]:
    outcomes = []
    for family, settings in observation_cases(count, seed, only):
        made = generate_case(settings)
        start = time.process_time()
        verdict = judge(certify(made.model))
        seconds = time.process_time() - start
        outcomes.append(judged(family, "", made.model, made.truth, verdict, seconds))
        if outcomes[-1].verdict == "pass" and not outcomes[-1].right:
            print(f"PASSED A WRONG ONE: {settings}\n  {outcomes[-1].periods}", flush=True)
    return outcomes


def confusion(outcomes: list[Outcome]) -> str:
    """Verdict against truth, over all cases and by family."""
    levels = (*LEVELS, REFUSED)
    lines = [f"{'':<48}" + "".join(f"{level:>10}" for level in levels) + "   most frequent reason"]
    for family in ["all", *dict.fromkeys(o.family for o in outcomes)]:
        for truth in (True, False):
            mine = [o for o in outcomes if o.right == truth and family in ("all", o.family)]
            if not mine:
                continue
            counts = "".join(f"{sum(o.verdict == v for o in mine):>10}" for v in levels)
            reasons = [o.reason for o in mine if o.reason]
            often = max(sorted(set(reasons)), key=reasons.count) if reasons else ""
            lines.append(f"{family + (', right' if truth else ', wrong'):<48}{counts}   {often}")
    return "\n".join(lines)


def compare(before: list[Outcome], after: list[Outcome]) -> str:
    """Verdicts of two versions on the same cases, as a table of Markdown."""
    heads = [f"{level}, {when}" for level in LEVELS for when in ("before", "after")]
    rows = []
    for family in ["all", *dict.fromkeys(o.family for o in after)]:
        for right in (True, False):
            pairs = [
                (one.verdict, other.verdict)
                for one, other in zip(before, after, strict=True)
                if other.right == right and family in ("all", other.family)
            ]
            counts = (
                str(sum(pair[i] == level for pair in pairs)) for level in LEVELS for i in (0, 1)
            )
            if pairs:
                rows.append([f"{family}, {'right' if right else 'wrong'}", *counts])
    return table(["", *heads], rows)


def errors_table(outcomes: list[Outcome]) -> str:
    """Median over the cases of each family and route, worst period of each case."""
    lines = [f"{'':<40}{'':<10}{'rotation [deg]':>20}{'centre [% extent]':>20}{'CPU [s]':>9}"]
    lines.append(f"{'':<50}" + f"{'median':>10}{'largest':>10}" * 2)
    for family, route in dict.fromkeys((o.family, o.route) for o in outcomes):
        mine = [o for o in outcomes if (o.family, o.route) == (family, route)]
        worst = np.array([np.max(o.periods, axis=0) for o in mine])
        r, rmax, c, cmax = np.median(worst, axis=0)
        seconds = np.median([o.seconds for o in mine])
        verdict = f"  {mine[0].verdict}" if len(mine) == 1 else ""
        lines.append(
            f"{family:<40}{route:<10}{r:10.4f}{rmax:10.4f}{c:10.4f}{cmax:10.4f}{seconds:9.2f}"
            + verdict
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tier", choices=("observations", "images", "photos"))
    parser.add_argument("folders", nargs="*", type=Path, help="photos: folders with images/")
    parser.add_argument("--cases", type=int)
    parser.add_argument("--seed", type=int, default=0, help="images: added to that of each case")
    parser.add_argument("--only", default="", help="families or cases whose name has this in it")
    parser.add_argument("--route", default="all", help="one of the routes, or all")
    parser.add_argument("--work", type=Path, help="folder that keeps scenes and models")
    parser.add_argument("--save", type=Path, help="file that keeps the outcomes")
    parser.add_argument("--before", type=Path, help="--save of another version, to compare with")
    options = parser.parse_args()
    print(f"{processor_name()}, {os.cpu_count()} processors, seed {options.seed}")
    if options.tier == "observations":
        outcomes = run_observations(options.cases or 330, options.seed, options.only)
    elif options.tier == "photos":
        outcomes = run_photos(options)
    else:
        outcomes = run_images(options)
    if options.save is not None:
        save(outcomes, options.save)
    if options.before is not None:
        print("\n" + compare(load(options.before), outcomes))
    print("\n" + errors_table(outcomes))
    if options.tier == "photos":  # what they are compared with is no truth
        return
    print(f"\n{len(outcomes)} cases, {sum(o.right for o in outcomes)} of them right\n")
    print(confusion(outcomes))
    sys.exit(any(o.verdict == "pass" and not o.right for o in outcomes))


if __name__ == "__main__":
    main()
