"""Summary of runs in numbers: means and spread over seeds, intervals over views, differences."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from chronoscene.arrays import Array, Mask
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import (
    Failure,
    RunRecord,
    no_runs,
    read_failures,
    run_folders,
)
from chronoscene.harness.report.comparable import apart, each_once, scene_of, with_own_titles
from chronoscene.harness.report.differences import (
    SeedSpread,
    explained_by_seeds,
    margins,
    seed_spread,
)
from chronoscene.harness.report.intervals import (
    REPLICATES,
    degrees_of_freedom,
    interval,
    pooled_freedom,
    resampled_means,
)
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.scoring import read_scored
from chronoscene.metrics.registry import all_metrics, metric_info

if TYPE_CHECKING:
    from pandas import DataFrame, Series

    from chronoscene.harness.report.published import PublishedTable

TRANSFERS = ("forgetting", "backward_transfer", "forward_transfer")
MEASURED = "measured"
SIZE = "checkpoint_bytes"  # What papers print as memory
MARKED = 3  # Ranks that are marked in tables
PAPER_METRICS = ("psnr", "ssim", "lpips_vgg_3dgs")
"""Metrics that papers on these methods print side by side."""
UNKNOWN = np.full(REPLICATES, math.nan)
"""Resampled values of numbers that come from no views, or from views that are not known."""


class Scores(NamedTuple):
    """One metric on the test views of a run."""

    periods: Array
    """Means over the views of each period, or resampled means. [P] or [P, REPLICATES]"""
    views: Sequence[Array]
    """Values of the views of each period; empty where they were not read. P arrays [n]"""
    sign: int
    """1 where higher is better, else -1."""


class Aggregate(NamedTuple):
    """A column of the tables of metrics that sums up all test views."""

    name: str
    meaning: str
    """For the notes below tables."""
    compute: Callable[[Scores], Any]
    """Also called with resampled means; what does not depend on them has no interval. Values that
    `RunRecord.aggregates` has are taken from there."""
    for_many_periods: bool = False
    """True if tables show the column only where periods have no columns of their own."""


AGGREGATES = (
    Aggregate("macro", "mean over periods", lambda s: np.mean(s.periods, axis=0)),
    Aggregate(
        "micro",
        "mean over test views",
        lambda s: np.average(s.periods, axis=0, weights=[*map(len, s.views)]),
    ),
    Aggregate("worst", "the worst period", lambda s: s.sign * np.min(s.sign * s.periods, axis=0)),
    Aggregate(
        "median of periods",
        "of their means",
        lambda s: np.median(s.periods, axis=0),
        for_many_periods=True,
    ),
    Aggregate(
        "best",
        "the best period",
        lambda s: s.sign * np.max(s.sign * s.periods, axis=0),
        for_many_periods=True,
    ),
)
"""Columns in the order of the tables. Another one is another entry here, for example the median
over views: ``lambda s: np.median(np.concatenate(s.views))``."""


@dataclass(frozen=True, slots=True)
class Cost:
    """A column of the cost table."""

    name: str
    """Field of `RunRecord`."""
    title: str
    factor: float = 1.0
    decimals: int = 0


COSTS = (
    Cost("seconds", "training [s]", decimals=1),
    Cost("iterations", "iterations"),
    Cost("primitives", "primitives"),
    Cost("drawn", "drawn per view"),
    Cost("render_seconds", "rendering [ms]", factor=1e3, decimals=1),
    Cost(SIZE, "checkpoint [MB]", factor=1e-6, decimals=3),
    Cost("peak_memory_bytes", "peak memory [MB]", factor=1e-6),
    Cost("peak_device_memory_bytes", "peak GPU memory [MB]", factor=1e-6),
)

TIMES = ("seconds", "render_seconds")
"""Costs that are compared on one device only."""

SHARING = (
    Cost("invariant_share", "invariant [%]", factor=100, decimals=1),
    Cost("mean_blocks", "blocks each", decimals=2),
    Cost("mean_period_numbers", "numbers of a period"),
    Cost("shared_numbers", "of all periods"),
)
"""Columns of the table of what periods share, by fields of `PeriodSharing`."""

ENTRY_COLUMNS = (
    *("source", "scene", "method", "strategy", "preset", "variant", "config_hash"),
    *("quantity", "column", "mean", "sd", "n", "low", "high"),
    *("difference", "difference_low", "difference_high", "by_seeds", "tied"),
    *("seeds", "device", "commit"),
)
"""Columns of CSV and JSON.

``source`` is ``measured`` or a publication; ``quantity`` is a metric, or a cost in the unit of
`RunRecord`; ``column`` is ``period <id>``, the name of one of `AGGREGATES`, or empty for costs;
runs in stages have ``<stage>: period <id>`` and `TRANSFERS`, too. ``sd`` is the sample standard
deviation over ``n`` seeds, empty for one seed; ``low`` and ``high`` are the ends of the 95 %
interval over views. ``difference`` is that to the best mean of the same scene, quantity and
column, with its 95 % interval by views and seeds (`differences`), which for single seeds is by
views alone; seeds alone explain a difference of ``by_seeds``, empty if they are single. ``tied`` is
True if the interval contains 0. Three or four views of a period decide that, but are too few for
the ends of the interval to mean anything: these are empty.
"""


DIFFERENCE = ("difference", "difference_low", "difference_high", "by_seeds")
_COMPARED = ("mean", "sd", "n", "column", "views", "resampled")
"""Columns that comparisons read."""


def read_runs(folders: Iterable[Path]) -> tuple[list[RunRecord], list[Failure]]:
    """Read all finished runs below some folders, with their rows, and the failed ones.

    Copies of a run count once. Each test of a scene and each method have a name of their own
    (`comparable`).

    Raises:
        CheckpointError: If a folder holds neither, or a run is damaged.
        ConfigError: If a seed is there twice, with different values.
    """
    records: list[RunRecord] = []
    failures: list[Failure] = []
    for folder in folders:
        found = [read_scored(path) for path in run_folders(folder)]
        failed = read_failures(folder)
        if not found and not failed:
            raise no_runs(folder)
        records += found
        failures += failed
    return apart(with_own_titles(each_once(records))), failures


def in_region(records: Iterable[RunRecord], region: str) -> list[RunRecord]:
    """Return runs with the scores of a region in place of those of whole images.

    Their scenes are called ``<scene> (<region>)``, and the fingerprint of the change masks takes
    the place of that of the test views. Runs of scenes without change masks are left out.

    Raises:
        ConfigError: If none is left.
    """
    found = [
        run.model_copy(
            update={
                **run.regions[region],
                "scene": f"{run.scene} ({region})",
                "split_hash": run.change_masks,
                "rows": [replace(row, region=ALL) for row in run.rows if row.region == region],
                "stages": {},  # these are of whole images
                "transfer": {},
            }
        )
        for run in records
        if region in run.regions
    ]
    if not found:
        raise ConfigError(
            f"--region {region}",
            expected="runs that were scored with change masks",
            found="none",
            todo="run chronoscene score RUNS --truth FOLDER first",
        )
    return apart(found)


def summarise(records: Sequence[RunRecord], metrics: Sequence[str] = ()) -> DataFrame:
    """Compute means, spread over seeds and intervals over views of everything that was measured.

    Runs that differ only in seed, device and commit form a group. Runs of equal names with other
    configs stay apart, and so do devices or commits that ran the same seed: their ``label`` says in
    what they differ.

    Args:
        records: Runs of any scenes.
        metrics: Names of those wanted; none for all.

    Returns:
        `ENTRY_COLUMNS`, ``label``, and the columns that `with_texts` and `compared` add, one row
        per group, quantity and column. What a run of a group lacks is left out, and so are `TIMES`
        of several devices.
    """
    import pandas as pd

    if not records:
        return pd.DataFrame(columns=[*ENTRY_COLUMNS, "label", "rank", "devices"])
    runs = labelled(records).sort_values("seed", kind="stable")
    in_group = runs.groupby(["scene", "label"], sort=False)
    groups = in_group[["method", "strategy", "preset", "variant", "config_hash", "views"]].first()
    groups["runs"] = in_group.size()
    groups["seeds"] = in_group.seed.agg(lambda seeds: " ".join(map(str, seeds)))
    groups["commit"] = in_group.commit.agg(lambda commits: " ".join(commits.unique()))
    groups["device"] = in_group.device.agg(lambda devices: "; ".join(devices.unique()))
    groups["devices"] = in_group.device.nunique()

    numbers = [
        (run.scene, label, *number)
        for run, label in zip(records, runs.label.sort_index(), strict=True)
        for number in _numbers(run, metric_names([run], metrics))
    ]
    keys = ["scene", "label", "quantity", "column"]
    values = pd.DataFrame(numbers, columns=[*keys, "value", "resampled"]).groupby(keys, sort=False)
    entries = values.value.agg(mean=mean, sd=spread, n="size")
    entries["resampled"] = [np.mean(list(part), axis=0) for _, part in values.resampled]
    entries = entries.reset_index().join(groups, on=["scene", "label"])
    mixed = entries.quantity.isin(TIMES) & (entries.devices > 1)
    entries = entries[(entries.n == entries.runs) & ~mixed].assign(source=MEASURED)
    order = list(dict.fromkeys(run.scene for run in records))
    entries = entries.sort_values(
        "scene", key=lambda scenes: scenes.map(order.index), kind="stable", ignore_index=True
    )
    return compared(with_texts(entries))


def with_texts(entries: DataFrame) -> DataFrame:
    """Add ``number``, the mean as it is printed, and ``text``, which has the spread, too."""
    numbers, texts = [], []
    for quantity, value, sd, n in entries[["quantity", "mean", "sd", "n"]].itertuples(index=False):
        numbers.append(in_unit(quantity, value))
        texts.append(with_spread(quantity, value, None if n == 1 else sd))
    return entries.assign(number=numbers, text=texts)


def in_unit(quantity: str, value: float) -> str:
    """Format a value in the unit and with the decimals of the tables; zero has no sign."""
    if quantity in all_metrics():
        return f"{value:z.{all_metrics()[quantity].decimals}f}"
    (cost,) = (cost for cost in (*COSTS, *SHARING) if cost.name == quantity)
    return f"{value * cost.factor:.{cost.decimals}f}"


def with_spread(quantity: str, value: float, sd: float | None) -> str:
    """Format a mean as in tables, with its spread if there is one."""
    return in_unit(quantity, value) + ("" if sd is None else f" ± {in_unit(quantity, sd)}")


def compared(entries: DataFrame) -> DataFrame:
    """Add intervals to entries, and a comparison with the best to those of metrics.

    Adds ``low``, ``high``, ``tied`` and `DIFFERENCE`, as `ENTRY_COLUMNS` says, and ``rank``: 1 to
    `MARKED` where a table marks the entry, else 0. Values that are printed alike have the same
    rank, and the last of several is never marked.
    """
    freedom = [*map(_freedom, entries.column, entries.views)]
    low, high = interval(np.reshape([*entries.resampled], (-1, REPLICATES)), freedom)
    tied, rank = np.zeros(len(entries), bool), np.zeros(len(entries), int)
    differences = np.full((len(entries), len(DIFFERENCE)), math.nan)
    values = {name: entries[name].to_numpy() for name in _COMPARED}
    numbers = entries.number.to_numpy(float)
    measured = entries.quantity.isin(all_metrics()) & (entries.source == MEASURED)
    places = np.flatnonzero(measured & ~entries.column.isin(TRANSFERS))
    keys = entries.iloc[places].groupby(["scene", "quantity", "column"], sort=False)
    for (_, quantity, _), part in keys.indices.items():
        rows, sign = places[part], 1 if metric_info(str(quantity)).higher_is_better else -1
        shown = sign * numbers[rows]
        ranks = 1 + (shown > shown[:, None]).sum(axis=1)
        rank[rows] = np.where(ranks <= min(MARKED, len(rows) - 1), ranks, 0)
        rows = rows[np.argsort(-sign * values["mean"][rows], kind="stable")]
        if len(rows) > 1:
            family = {name: value[rows] for name, value in values.items()}
            tied[rows[1:]], differences[rows[1:]] = _comparison(family, chosen=True)
    columns = dict(zip(DIFFERENCE, differences.T, strict=True))
    return entries.assign(low=low, high=high, tied=tied, rank=rank, **columns)


def compare_with(
    entries: DataFrame, reference: Any, others: Sequence[Any], *, chosen: bool
) -> None:
    """Fill in the comparison of some entries with another one, all named by their index.

    ``chosen``: The reference is the best of all of them, not one that was named beforehand. Entries
    with other views are not paired with it: they have no interval, and seeds alone may tie them.
    """
    family = entries.loc[[reference, *others], [*_COMPARED]]
    tied, differences = _comparison({n: family[n].to_numpy() for n in _COMPARED}, chosen=chosen)
    entries.loc[others, "tied"] = tied
    entries.loc[others, [*DIFFERENCE]] = differences


def _comparison(family: Mapping[str, Any], *, chosen: bool) -> tuple[Mask, Array]:
    """Compare all but the first of some entries with that one; see `compare_with`.

    Returns:
        tied: True where the difference may be chance. [N - 1]
        differences: The columns `DIFFERENCE`. [N - 1, 4]
    """
    means, ns, views = (family[name] for name in ("mean", "n", "views"))
    difference = means[1:] - means[0]
    resampled = np.stack([*family["resampled"]])
    known = np.array([other == views[0] for other in views[1:]])
    known &= np.isfinite(resampled[1:, 0]) & np.isfinite(resampled[0, 0])
    spread = seed_spread(family["sd"], ns)
    by_seeds = explained_by_seeds(spread, ns)
    margin = np.full(len(difference), math.nan)
    freedom = _freedom(family["column"][0], views[0])
    if known.any():
        paired = np.append(True, known)
        margin[known] = margins(
            means[paired],
            resampled[paired],
            freedom,
            SeedSpread(spread.variances[paired], spread.freedom),
            ns[paired],
            chosen=chosen,
        )
    tied = np.abs(difference) <= np.where(known, margin, by_seeds)
    # Up to 2, a t-distribution has no finite variance, and tens of dB would say nothing.
    if round(freedom, 6) <= 2:
        margin[:] = math.nan
    columns = [difference, difference - margin, difference + margin, by_seeds]
    return tied, np.stack(columns, axis=1)


@lru_cache
def _freedom(column: str, views: frozenset[tuple[str, int, str]]) -> float:
    """Return the degrees of freedom of the variance of a column by views; NaN without views.

    ``views``: scene, period and name of each.
    """
    counts = Counter((scene, period) for scene, period, _ in views)
    if column == "macro":
        periods = Counter(scene for scene, _ in counts)  # that a scene is the mean of
        return pooled_freedom(counts.values(), [1 / periods[scene] for scene, _ in counts])
    if column == "micro":
        whole = Counter(scene for scene, _, _ in views)
        weights = [n / whole[scene] for (scene, _), n in counts.items()]
        return pooled_freedom(counts.values(), weights)
    # A period, or an aggregate that is mostly one period
    of_one = [n for (_, i), n in counts.items() if column == f"period {i}"] or [*counts.values()]
    return min(map(degrees_of_freedom, of_one), default=math.nan)


def over_scenes(entries: DataFrame, name: str) -> DataFrame:
    """Average macro means and costs over all scenes, as entries of a scene of that name.

    Labels that lack a scene are left out.
    """
    import pandas as pd

    chosen = entries[entries.column.isin(("macro", ""))]
    rows = [
        {
            **part.iloc[0],
            "scene": name,
            "mean": mean(part["mean"]),
            "sd": math.hypot(*part.sd) / len(part),
            "n": min(part.n),
            "resampled": np.mean(list(part.resampled), axis=0),
            "views": frozenset().union(*part.views),
        }
        for _, part in chosen.groupby(["label", "quantity"], sort=False)
        if len(part) == entries.scene.nunique()
    ]
    return compared(with_texts(pd.DataFrame(rows, columns=entries.columns)))


def published_entries(table: PublishedTable, scenes: Iterable[str]) -> DataFrame:
    """Make entries of the numbers printed for scenes of these names, whose case does not matter.

    The size is the printed mean over the group of the scene.
    """
    import pandas as pd

    rows = []
    for scene in scenes:
        printed = scene_of(scene).casefold()
        for row in (r for r in table.rows if r.scene.casefold() == printed):
            values = [(name, "macro", getattr(row, name)) for name in PAPER_METRICS]
            values.append((SIZE, "", table.memory_gb[row.group][row.method] * 1e9))
            rows += [(scene, row.method, *value) for value in values]
    entries = pd.DataFrame(rows, columns=["scene", "method", "quantity", "column", "mean"])
    entries = entries.assign(
        source=table.title,
        label=entries.method + " (published)",
        device=table.hardware,
        **dict.fromkeys(("n", "runs", "devices"), 1),
        sd=math.nan,
        resampled=[UNKNOWN] * len(rows),
        views=[frozenset()] * len(rows),
        **dict.fromkeys(("strategy", "preset", "variant", "config_hash", "seeds", "commit"), ""),
    )
    return compared(with_texts(entries))


def labelled(records: Sequence[RunRecord]) -> DataFrame:
    """Tabulate the settings of runs, one row per record; ``label`` is its name in tables."""
    import pandas as pd

    fields = ("scene", "method", "strategy", "preset", "variant", "config_hash", "seed", "device")
    runs = pd.DataFrame(
        [{name: getattr(run, name) for name in (*fields, "commit")} for run in records]
    )
    runs["views"] = [
        frozenset((run.scene, row.camera_period, row.view) for row in run.rows) for run in records
    ]
    runs["label"] = [name_of(run) for run in records]
    differences = pd.DataFrame(
        {
            "method": runs.method,
            "config": [f"config {run.config_hash[:6]}" for run in records],
            "device": runs.device,
            "commit": [f"code {short_commits(run.commit)}" for run in records],
        }
    )
    named = [runs.scene, runs.label]
    differ = differences.groupby(named).transform("nunique") > 1
    # Seeds of several devices or commits are averaged; the same seed of two compares these.
    same = [*named, runs.method, differences.config]
    for name in ("device", "commit"):
        several = differences[name].groupby([*same, runs.seed]).transform("nunique")
        differ[name] = several.groupby(same).transform("max") > 1
    for i, columns in enumerate(differ.to_numpy()):
        if columns.any():
            runs.loc[i, "label"] += f" [{', '.join(differences.loc[i, columns])}]"
    return runs


def short_commits(commits: str) -> str:
    """Shorten hashes of commits to ten digits; ``-dirty`` stays."""
    return re.sub(r"\b([0-9a-f]{10})[0-9a-f]{30}\b", r"\1", commits)


def kind_of(run: RunRecord | Failure) -> str:
    """Name strategy, preset and the options that differ from it."""
    return ", ".join(filter(None, (run.strategy, run.preset, run.variant.replace(",", ", "))))


def name_of(run: RunRecord) -> str:
    """Name the method of a run and its settings, as tables do."""
    return f"{run.title} ({kind_of(run)})"


Number = tuple[str, str, float, Array]
"""Quantity, column, value and resampled values. The last: [REPLICATES]"""


def _numbers(run: RunRecord, metrics: Sequence[str]) -> Iterator[Number]:
    """Yield all numbers of a run in the order of the tables."""
    views: dict[str, dict[int, dict[str, float]]] = {}  # Metric to period to view to value
    for row in run.rows:
        if row.region == ALL and row.rendered_period == row.camera_period:
            of_metric = views.setdefault(row.metric, {})
            of_metric.setdefault(row.camera_period, {})[row.view] = row.value
    for metric in metrics:
        yield from _scores(run, metric, views.get(metric, {}))
        for stage, periods in run.stages.items():
            for i, values in periods.items():
                if metric in values:
                    yield metric, f"{stage}: period {i}", values[metric], UNKNOWN
        for name, values in run.transfer.items():
            if metric in values:
                yield metric, name, values[metric], UNKNOWN
    for cost in COSTS:
        if (value := getattr(run, cost.name)) is not None:
            yield cost.name, "", float(value), UNKNOWN
    for cost in SHARING if run.sharing is not None else ():
        yield cost.name, "", float(getattr(run.sharing, cost.name)), UNKNOWN


def _scores(
    run: RunRecord, metric: str, views: Mapping[int, Mapping[str, float]]
) -> Iterator[Number]:
    """Yield means of periods and aggregates; ``views``: values by period and name of the view."""
    means = {int(i): values[metric] for i, values in run.periods.items() if metric in values}
    scene = scene_of(run.scene)  # whatever other tests of it there are
    drawn = {i: resampled_means(values, f"{scene}/{i}") for i, values in views.items()}
    for i in sorted(means):
        yield metric, f"period {i}", means[i], drawn.get(i, UNKNOWN)
    of_views = [np.array([*values.values()]) for values in views.values()]
    sign = 1 if metric_info(metric).higher_is_better else -1
    scores = Scores(np.array([means[i] for i in sorted(means)]), of_views, sign)
    resampled = Scores(np.array([*drawn.values()]), of_views, sign)
    for name, _, compute, _ in AGGREGATES:
        known = run.aggregates.get(name)
        spread = compute(resampled) if drawn else UNKNOWN
        value = float(compute(scores) if known is None else known[metric])
        yield metric, name, value, spread if np.shape(spread) else UNKNOWN


def spread(values: Series) -> float:
    """Compute the sample standard deviation (n - 1); NaN for one value, or with an infinite one."""
    return stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else math.nan


def metric_names(records: Iterable[RunRecord], wanted: Sequence[str] = ()) -> list[str]:
    """Return the metrics to show, in the order of their registry: those wanted, or all."""
    known = [metric_info(name).name for name in wanted]
    there = {name for run in records for name in run.aggregates.get("macro", {})}
    return [name for name in all_metrics() if name in there and (not known or name in known)]
