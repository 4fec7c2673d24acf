"""Errors of the CPU rasterizer at its numerical extremes.

    python -m benchmarks.rasterizer.extremes [--write]

Prints three tables in Markdown: what happens at each extreme, the errors against the float64
reference, and what survey coordinates lose by rounding. With --write they replace those of
chronoscene/rasterizer/README.md. The extremes are those of tests/rasterizer/rasterizer_cases.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "rasterizer"))

comparison: Any = import_module("rasterizer_cases.comparison")
extremes: Any = import_module("rasterizer_cases.extremes")

README = ROOT / "chronoscene" / "rasterizer" / "README.md"
BEGIN, END = "<!-- extremes: begin -->", "<!-- extremes: end -->"
GRADIENTS = ("means", "quats", "scales", "opacities", "colors")


def processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else "an unknown processor"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown, numbers to the right."""
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


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
    return table(("extreme", "what happens"), ((e.name, e.why) for e in extremes.EXTREMES))


def measured() -> str:
    """Errors of each extreme that is drawn, and what the rounding of inputs does by itself."""
    columns = ("image", "alphas", "depths", *("grad " + name for name in GRADIENTS))
    rows = []
    for extreme in extremes.EXTREMES:
        if not extreme.compared:
            continue
        compared = comparison.compare(extreme.build(), truth=extreme.truth and extreme.truth())
        errors = errors_of(compared)
        moved = errors_of(comparison.rounding(compared.scene, fixed=extreme.fixed))
        left_out = 100 * (1 - compared.steady.mean())
        cells = [*(errors[c] for c in columns), moved["image"], moved["gradients"]]
        rows.append([extreme.name, *map(number, cells), f"{left_out:.1f}"])
    head = ("extreme", "image", "alpha", "depth", *("∂ " + name for name in GRADIENTS))
    return table((*head, "inputs: image", "inputs: ∂", "left out, %"), rows)


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
    return table(("coordinates", "given as", "image", "gradients"), rows)


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
`python -m benchmarks.rasterizer.extremes --write`, {processor()}.

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
    if not parser.parse_args().write:
        print(text)
        return
    before, rest = README.read_text("utf-8").split(BEGIN)
    after = rest.split(END)[1]
    README.write_text(f"{before}{BEGIN}\n{text}{END}{after}", "utf-8")


if __name__ == "__main__":
    main()
