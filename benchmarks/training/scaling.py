"""How the time of a training step divides into parallel and serial parts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import count
from statistics import median

from benchmarks.training.generated import PROGRESS, make, training_set
from chronoscene.kernels.runtime import set_threads

METHODS = ("chronogs", "3dgs", "4dgs")
ROUND = 5
"""Steps with one number of threads before the turn of the next, so that other work on the machine
meets all alike."""

Times = dict[str, list[float]]
Measure = Callable[[Sequence[Callable[[], object]]], Times]


def parallel_share(one: float, several: float, threads: int) -> float:
    """Share of the time on one thread that runs in parallel, by Amdahl's law.

    several = one (1 - share + share / threads)
    """
    return (1 - several / one) / (1 - 1 / threads)


def measure_scaling(
    name: str,
    points: int,
    size: tuple[int, int],
    *,
    preset: str,
    threads: Sequence[int],
    steps: int,
    measure: Measure,
) -> dict[int, Times]:
    """Milliseconds of each part in each step, by number of threads."""
    method = make(training_set(points, *size), name, preset)
    numbers, found = count(100, ROUND), {n: defaultdict[str, list[float]](list) for n in threads}
    for turn in range(-(-steps // ROUND) + 1):
        for n in threads:
            set_threads(n)
            first = next(numbers)
            some = [lambda i=first + k: method.step(i, PROGRESS) for k in range(ROUND)]
            for part, values in measure(some).items():
                if turn:  # the first compiles and touches memory
                    found[n][part] += values
    return {n: dict(times) for n, times in found.items()}


def print_scaling(title: str, found: dict[int, Times], parts: Sequence[str]) -> None:
    """Print medians of each part for all numbers of threads, and the parallel shares."""
    threads = list(found)
    heads = [f"{n} thread{'s' if n > 1 else ''}" for n in threads]
    heads += [f"parallel, {n}" for n in threads[1:]]
    print(f"\n{title}\n{'ms per step, median':<28}" + "".join(f"{head:>14}" for head in heads))
    for part in [*parts, "rest", "step"]:
        if not all(part in times for times in found.values()):
            continue
        middle = {n: median(found[n][part]) for n in threads}
        shares = [parallel_share(middle[1], middle[n], n) for n in threads[1:]]
        cells = [f"{middle[n]:14.2f}" for n in threads] + [f"{s:14.0%}" for s in shares]
        print(f"{part:<28}" + "".join(cells))
