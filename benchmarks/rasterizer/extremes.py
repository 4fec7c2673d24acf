"""Errors of the CPU rasterizer at its numerical extremes.

    python -m benchmarks.rasterizer.extremes [--write]

Prints three tables in Markdown: what happens at each extreme, the errors against the float64
reference, and what survey coordinates lose by rounding. With --write they replace those of
chronoscene/rasterizer/README.md. The extremes are those of tests/rasterizer/rasterizer_cases.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.markdown import replace_part, table
from chronoscene.harness.files.provenance import processor_name

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "rasterizer"))

comparison: Any = import_module("rasterizer_cases.comparison")
extremes: Any = import_module("rasterizer_cases.extremes")

README = ROOT / "chronoscene" / "rasterizer" / "README.md"
GRADIENTS = ("means", "quats", "scales", "opacities", "colors")


def number(x: float) -> str:
    """One digit and its power of ten; errors need no more."""
    return "0" if x == 0 else f"{x:.0e}".replace("e-0", "e-").replace("e+0", "e")


def errors_of(compared: Any) -> dict[str, float]:
    """Relative errors by name, and the largest of the gradients."""
    errors = {n: compared.error(n) for n in compared.expected if n != "radii"}
    errors["gradients"] = max(errors["grad " + name] for name in GRADIENTS)
    return errors


def outcomes() -> str:
    """Describe the outcome at each extreme."""
    rows = ((e.name, e.why) for e in extremes.EXTREMES)
    return table(("extreme", "what happens"), rows, numbers=False)


def measured() -> str:
    """Errors of each extreme that is drawn, and what the rounding of inputs does by itself."""
    columns = ("image", "alphas", "depths", *("grad " + name for name in GRADIENTS))
    rows = []
    for extreme in extremes.EXTREMES:
        if not extreme.compared:
            continue
        compared = comparison.compare(extreme.build(), truth=extreme.truth and extreme.truth())
        errors = errors_of(compared)
        moved = errors_of(comparison.rounding(compared, fixed=extreme.fixed))
        left_out = 100 * (1 - compared.steady.mean())
        cells = [*(errors[c] for c in columns), moved["image"], moved["gradients"]]
        rows.append([extreme.name, *map(number, cells), f"{left_out:.1f}"])
    head = ("extreme", "image", "alpha", "depth", *("∂ " + name for name in GRADIENTS))
    return table((*head, "inputs: image", "inputs: ∂", "left out, %"), rows, numbers=False)


def survey() -> str:
    """Errors against the exact world, not against what rounding has left of it."""
    rows = []
    for name, origin in (("UTM", extremes.UTM), ("ECEF", extremes.ECEF)):
        world = extremes.world(origin)
        local = extremes.in_training_frame(world)
        for given, scene, truth in (
            ("float32 in the world", extremes.rounded(world), world),
            ("float32 in the training frame", extremes.rounded(local), local),
            ("float64 in the world", world, world),
        ):
            errors = errors_of(comparison.compare(scene, truth=truth))
            rows.append([name, given, number(errors["image"]), number(errors["gradients"])])
    return table(("coordinates", "given as", "image", "gradients"), rows, numbers=False)


def report() -> str:
    """The three tables with their headings."""
    outcome = [e.outcome for e in extremes.EXTREMES]
    right, culled = outcome.count(extremes.AGREES), outcome.count(extremes.CULLED)
    refused = len(outcome) - right - culled
    return f"""Of {len(outcome)} extremes {right} are drawn right, {culled} are culled and \
{refused} are refused.

### What happens

{outcomes()}

### Measured errors

Differences from the reference over the largest magnitude, of what is drawn. "inputs" is what \
the reference itself does when
every input is moved by up to one unit of its last float32 place: the error that float32 inputs \
have before anything is computed.
"left out" are pixels where rounding decides a threshold. \
`python -m benchmarks.rasterizer.extremes --write`, {processor_name()}.

{measured()}

### Survey coordinates

Differences from the exact float64 world. Rounding to float32 is what destroys the first row of \
each, before anything is rendered.

{survey()}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help=f"write them to {README.name}")
    text = report()
    if parser.parse_args().write:
        replace_part(README, "extremes", text)
    else:
        print(text)


if __name__ == "__main__":
    main()
