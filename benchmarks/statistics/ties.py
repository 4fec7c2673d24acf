"""Reliability of ties and intervals in tables: how often truly equal methods are told apart.

Tables are drawn from the model: methods differ by view (normal, correlated along the path of the
test views of three periods) and by seed (normal). Their macro means are compared as `table` does
it. "Wrong": of methods that are truly equal, one or more are told from the best; or, where one of
two halves is better by 1 dB, a truly best one is told from the best. "Power": the share of methods
that are told from one that is truly better by so much. "Coverage": of the interval over views.

The spreads are those of PSNR in leaderboard/entries/measured: differences between two methods have
a standard deviation of 0.50 to 0.95 dB over views of a period (medians of four scenes), 0.6 here.
Seeds: 0.15 dB, typical of docs/experiments/methods-compared.md; entries have single seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.markdown import table
from chronoscene.harness.report.differences import margins, seed_spread
from chronoscene.harness.report.intervals import (
    REPLICATES,
    interval,
    pooled_freedom,
    resampling_weights,
)

Floats = NDArray[np.float64]
PERIODS = 3
VIEWS = (5, 8, 15, 30)
METHODS = (2, 4, 8)
BY_VIEWS = 0.6 / 2**0.5
"""Standard deviation of a method over views, in dB; of differences, 0.6."""
BY_SEEDS = 0.15


@dataclass(frozen=True)
class Case:
    """Sizes, spreads and correlation that a table is drawn from."""

    methods: int
    views: int
    seeds: int
    correlation: float
    seed_sds: Sequence[float] | float = BY_SEEDS
    """Spread by seeds of all methods, or of each."""


def draw(rng: np.random.Generator, case: Case, better: Floats) -> tuple[Floats, Floats]:
    """Draw values of views and errors by seeds.

    With a single seed, its error is left out: a table with one seed says that it is not covered.

    Args:
        rng: Random numbers.
        case: The table.
        better: True means of the methods. [M]

    Returns:
        views: [M, P, n]
        seeds: [M, S]
    """
    views = rng.standard_normal((case.methods, PERIODS, case.views))
    own = np.sqrt(1 - case.correlation**2)
    for i in range(1, case.views):
        views[..., i] = case.correlation * views[..., i - 1] + own * views[..., i]
    sds = np.broadcast_to(case.seed_sds, case.methods) * (case.seeds > 1)
    seeds = rng.standard_normal((case.methods, case.seeds)) * sds[:, None]
    return BY_VIEWS * views + better[:, None, None], seeds


def resample(views: Floats) -> Floats:
    """Compute resampled macro means. [M, P, n] to [M, REPLICATES]"""
    weights = [resampling_weights(views.shape[2], period) for period in range(PERIODS)]
    return np.mean([views[:, p] @ weights[p].T for p in range(PERIODS)], axis=0)


def told_apart(rng: np.random.Generator, case: Case, better: Floats) -> NDArray[np.bool_]:
    """Draw a table; True for each method that is told from the best. [M]"""
    views, seeds = draw(rng, case, better)
    means = views.mean(axis=(1, 2)) + seeds.mean(axis=1)
    order = np.argsort(-means)
    ns = [case.seeds] * case.methods
    sds = seeds.std(axis=1, ddof=1) if case.seeds > 1 else np.full(case.methods, np.nan)
    spread = seed_spread(sds[order], ns)
    freedom = pooled_freedom([case.views] * PERIODS)
    found = margins(means[order], resample(views)[order], freedom, spread, ns, chosen=True)
    apart = np.zeros(case.methods, bool)
    apart[order[1:]] = means[order[0]] - means[order[1:]] > found
    return apart


def wrong(cases: int, case: Case, *, half_worse: bool = False) -> float:
    """Return the share of tables in which a truly best method is told from the best, in percent."""
    rng = np.random.default_rng(0)
    best = np.arange(case.methods) < (case.methods // 2 if half_worse else case.methods)
    better = np.where(best, 1.0, 0.0)
    return 100 * float(np.mean([told_apart(rng, case, better)[best].any() for _ in range(cases)]))


def power(cases: int, case: Case, difference: float) -> float:
    """Return the share of methods that are told from one that is truly better, in percent."""
    rng = np.random.default_rng(0)
    better = np.append(difference, np.zeros(case.methods - 1))
    return 100 * float(np.mean([told_apart(rng, case, better)[1:].mean() for _ in range(cases)]))


def coverage(cases: int, views: int, correlation: float) -> float:
    """Return the share of intervals over views that hold the true mean, in percent."""
    rng = np.random.default_rng(0)
    paths, _ = draw(rng, Case(cases, views, 1, correlation), np.zeros(cases))
    freedom = np.full(cases, pooled_freedom([views] * PERIODS))
    low, high = interval(resample(paths).reshape(cases, REPLICATES), freedom)
    return 100 * float(np.mean((low <= 0) & (high >= 0)))


def show(title: str, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table in Markdown."""
    texts = ([f"{c:.0f} %" if isinstance(c, float) else str(c) for c in row] for row in rows)
    print(f"\n{title}\n\n{table(heads, texts)}", flush=True)


def main() -> None:
    """Print how often methods are told apart, wrongly and rightly."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=400, help="tables of each kind (400)")
    cases = parser.parse_args().cases
    show(
        "Equal methods, one or more wrongly told from the best",
        ["seeds", "correlation", "views", *(f"{m} methods" for m in METHODS)],
        (
            [s, f"{c:g}", n, *(wrong(cases, Case(m, n, s, c)) for m in METHODS)]
            for s in (1, 2, 3)
            for c in (0.0, 0.3, 0.6)
            for n in VIEWS
        ),
    )
    unequal = (0.05, 0.2) * 4
    show(
        "Eight methods, correlation 0.3: a truly best one wrongly told from the best",
        ["seeds", "views", "half worse by 1 dB", "seeds' sd 0.05 and 0.2 in turns"],
        (
            [s, n, wrong(cases, case, half_worse=True), wrong(cases, other)]
            for s in (2, 3)
            for n in VIEWS
            for case in [Case(8, n, s, 0.3)]
            for other in [Case(8, n, s, 0.3, unequal)]
        ),
    )
    gaps = (0.25, 0.5, 1.0)
    show(
        "Power, correlation 0.3: told from a method that is better by so many dB",
        ["seeds", "views", *(f"{m} methods, {gap:g} dB" for m in (2, 8) for gap in gaps)],
        (
            [s, n, *(power(cases, Case(m, n, s, 0.3), g) for m in (2, 8) for g in gaps)]
            for s in (1, 2, 3)
            for n in (5, 15, 30)
        ),
    )
    show(
        "Intervals over views that hold the true mean",
        ["views", *(f"correlation {c:g}" for c in (0.0, 0.3, 0.6))],
        ([n, *(coverage(5 * cases, n, c) for c in (0.0, 0.3, 0.6))] for n in (6, *VIEWS[1:])),
    )


if __name__ == "__main__":
    main()
