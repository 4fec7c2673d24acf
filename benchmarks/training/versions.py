"""Training steps of two checkouts of this repository, timed in turn.

    python -m benchmarks.training.versions OLD NEW --points 20000 100000 --size 1200 900
    python -m benchmarks.training.versions OLD NEW --scene SCENE --train 1500

OLD and NEW are folders; each trains in a process of its own on the same generated points or, with
``--scene``, on a real scene: there each first trains for some steps, and the models are equal as
long as the versions have the same bits. Prints the median of processor time and of wall time of a
step and their ratio, by method and number of threads. Where other work runs on the machine,
processor time on one thread is what counts.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.checkout_process import CheckoutProcess
from benchmarks.training.scaling import METHODS

ROUND = 5
"""Steps of one version before the turn of the other."""

# It may use nothing that only one of the versions has.
_WORKER = """
import json, sys, time
from pathlib import Path
import chronoscene
from benchmarks.training.generated import PROGRESS, make, training_set
from chronoscene.kernels.runtime import keep_freed_memory, set_threads

keep_freed_memory()
asked = json.loads(sys.stdin.readline())
set_threads(asked["threads"])
if asked["scene"]:
    from benchmarks.training import step
    from chronoscene.formats import read_scene
    from chronoscene.harness.plan.parts import make_parts
    from chronoscene.images.store import ImageStore

    scene = read_scene(Path(asked["scene"]))
    (part,) = make_parts(scene, ImageStore(scene), "joint")
    steps = step.ordinary_steps(step.train(part, "balanced", asked["train"], 31_000, 0))
    advance = lambda: next(steps)()
else:
    method = make(training_set(asked["points"], *asked["size"]), asked["method"], "balanced")
    numbers = iter(range(100, 1 << 40))
    advance = lambda: method.step(next(numbers), PROGRESS)
print(json.dumps("ready"), flush=True)
for line in sys.stdin:
    found = []
    for _ in range(int(line)):
        begin = time.process_time(), time.perf_counter()
        advance()
        found.append((time.process_time() - begin[0], time.perf_counter() - begin[1]))
    print(json.dumps(found), flush=True)
"""


def compare(folders: tuple[Path, Path], asked: dict[str, Any], steps: int) -> None:
    """Time both versions and print a line of the table."""
    versions = []
    for folder in folders:
        versions.append(CheckoutProcess(str(folder), ["-c", _WORKER], [folder]))
        versions[-1].ask(json.dumps(asked))
    times: list[list[tuple[float, float]]] = [[], []]
    for turn in range(-(-steps // ROUND) + 1):
        for version, found in zip(versions, times, strict=True):
            some = version.ask(str(ROUND))
            found += some if turn else []  # the first compiles and touches memory
    for version in versions:
        version.close()
    cells = [f"{asked['method']:<10}{asked['points'] or Path(asked['scene']).name:>10}"]
    cells.append(f"{asked['threads']:>8}")
    for processor_or_wall in (0, 1):
        old_ms, new_ms = (1e3 * median(pair[processor_or_wall] for pair in t) for t in times)
        cells.append(f"{old_ms:10.2f}{new_ms:10.2f}{old_ms / new_ms:8.2f}")
    print("".join(cells), flush=True)


def main() -> None:
    """Time all methods and sizes that are asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--points", type=int, nargs="+", default=[20_000, 100_000])
    parser.add_argument("--size", type=int, nargs=2, default=(800, 600), metavar=("W", "H"))
    parser.add_argument("--method", nargs="+", default=METHODS)
    parser.add_argument("--threads", type=int, nargs="+", default=[1])
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--scene", type=Path, help="instead of generated points; ChronoGS alone")
    parser.add_argument("--train", type=int, default=1_500, help="steps before, with --scene")
    args = parser.parse_args()
    clocks = "".join(f"{name:>10}{'new':>10}{'ratio':>8}" for name in ("CPU ms old", "ms old"))
    print(f"{'method':<10}{'points':>10}{'threads':>8}{clocks}")
    scene = str(args.scene.resolve()) if args.scene else None
    methods, points = (["chronogs"], [0]) if scene else (args.method, args.points)
    for number in points:
        for method in methods:
            for threads in args.threads:
                asked = {"method": method, "points": number, "size": args.size, "scene": scene}
                asked |= {"threads": threads, "train": args.train}
                compare((args.old, args.new), asked, args.steps)


if __name__ == "__main__":
    main()
