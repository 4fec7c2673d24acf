"""Quality by training time: PSNR of the probe views after given times, and the reverse."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING

import numpy as np

from chronoscene.arrays import Array
from chronoscene.harness.files.records import CURVE_FILE, CurvePoint, RunRecord, read_lines
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.report.comparable import several_scenes
from chronoscene.harness.report.summary import labelled, spread, with_spread
from chronoscene.harness.report.tables import ALL_SCENES
from chronoscene.io.tables import Table

if TYPE_CHECKING:
    from pandas import DataFrame

LADDER = (1, 2, 5, 10, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 18000, 36000, 86400)
"""Seconds after which the PSNR is asked for, as far as a training lasts so long."""
MAX_LEVELS = 7
"""PSNR levels whose times are asked for, at most."""

Curve = Array
"""Seconds and PSNR of the probes of a run. [2, K]"""


VALUE_COLUMNS = ("scene", "device", "label", "quantity", "at", "mean", "sd", "n")
"""Columns of `curve_values`, one row per configuration and number that its curves give.

``scene`` may be `ALL_SCENES`. ``quantity`` is ``psnr`` (after ``at`` seconds of training),
``seconds`` (until ``at`` dB are reached), ``psnr_end`` and ``seconds_end`` (of the last probe), or
``gain`` (from half of the time of the last probe to that). ``mean`` is over ``n`` seeds; ``sd``,
their sample standard deviation, is None for one.
"""


def read_curve(folder: Path) -> list[CurvePoint]:
    """Read ``curve.csv`` of a run; nothing where there is none, as for another program.

    Raises:
        CheckpointError: If it is damaged.
    """
    path = folder / CURVE_FILE
    if not path.is_file():
        return []
    return read_lines(path, CurvePoint, expected="the curve of a run")


def whole_curve(points: Sequence[CurvePoint], strategy: str) -> Curve | None:
    """Combine the probes of a run in one curve; None if they are not of one set of views.

    The models of ``separate`` count as if they were trained by turns: at each probe their seconds
    are added up and their PSNR is averaged, if their period has a test view. The stages of
    ``sequential`` probe other views each.
    """
    by_model = [
        np.array([(point.seconds, point.psnr) for point in part]).T
        for _, part in groupby(points, key=lambda point: point.model)
    ]
    if not by_model or STRATEGIES[strategy].in_order or len({c.shape for c in by_model}) > 1:
        return None
    stacked = np.stack(by_model)
    if not len(probed := stacked[~np.isnan(stacked[:, 1]).all(axis=1), 1]):
        return None
    curve: Curve = np.stack([stacked[:, 0].sum(axis=0), probed.mean(axis=0)])
    return curve if np.isfinite(curve).all() else None


def psnr_after(curve: Curve, seconds: float) -> float:
    """Return the PSNR at a time, linear between probes; NaN before the first and after the last."""
    return float(np.interp(seconds, curve[0], curve[1], left=math.nan, right=math.nan))


def seconds_until(curve: Curve, psnr: float) -> float:
    """Return when a PSNR is reached first, linear between probes; NaN if it never is.

    What the first probe has already was reached by then at the latest: its time is returned.
    """
    reached = np.flatnonzero(curve[1] >= psnr)
    if not len(reached):
        return math.nan
    first = reached[0]
    times, values = curve[:, max(0, first - 1) : first + 1]
    return float(np.interp(psnr, values, times))


def curve_values(records: Sequence[RunRecord], curves: Sequence[Curve | None]) -> DataFrame:
    """Read numbers off curves by device, scene and configuration; what a seed lacks is left out.

    Args:
        records: Runs of any scenes.
        curves: One for each of them.

    Returns:
        `VALUE_COLUMNS`.
    """
    import pandas as pd

    known = [(run, curve) for run, curve in zip(records, curves, strict=True) if curve is not None]
    parts = [pd.DataFrame(columns=VALUE_COLUMNS)]
    levels = psnr_levels([curve for _, curve in known]) if known else []
    for device in dict.fromkeys(run.device for run, _ in known):
        here = [(run, curve) for run, curve in known if run.device == device]
        numbers = [
            (run.scene, device, label, *number)
            for (run, curve), label in zip(here, labelled([r for r, _ in here]).label, strict=True)
            for number in _numbers(curve, levels)
        ]
        *keys, _, _, _ = VALUE_COLUMNS
        seeds = pd.DataFrame(numbers, columns=[*keys, "value"])
        seeds = seeds.groupby(keys, sort=False, dropna=False).value
        values = seeds.agg(mean=mean, sd=spread, n="size").reset_index()
        parts.append(values[np.isfinite(values["mean"])])
        if several_scenes(parts[-1].scene):
            parts.append(_over_scenes(parts[-1]).assign(scene=ALL_SCENES, device=device))
    found = pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)
    found = found[[*VALUE_COLUMNS]].astype({"at": object, "sd": object})
    return found.where(found.notna(), None)


def _numbers(curve: Curve, levels: Iterable[float]) -> Iterator[tuple[str, float | None, float]]:
    """Yield ``quantity``, ``at`` and value of all that a curve gives; NaN if it does not."""
    for time in LADDER:
        yield "psnr", float(time), psnr_after(curve, time)
    seconds, psnr = curve[:, -1].tolist()
    yield "psnr_end", None, psnr
    yield "seconds_end", None, seconds
    yield "gain", None, psnr - psnr_after(curve, seconds / 2)
    for level in levels:
        yield "seconds", level, seconds_until(curve, level)


def _over_scenes(values: DataFrame) -> DataFrame:
    """Average over scenes the numbers that are known for all of them."""
    scenes = values.scene.nunique()
    found = values.groupby(["label", "quantity", "at"], sort=False, dropna=False).agg(
        mean=("mean", mean),
        sd=("sd", lambda sds: math.hypot(*sds) / scenes),
        n=("n", "min"),
        scenes=("scene", "size"),
    )
    return found[found.scenes == scenes].reset_index()


def psnr_levels(curves: Sequence[Curve]) -> list[float]:
    """List whole dB that some probe reached, at most `MAX_LEVELS` at equal distances."""
    values = np.concatenate([curve[1] for curve in curves])
    low, high = math.ceil(values.min()), math.floor(values.max())
    step = max(1, math.ceil((high - low + 1) / MAX_LEVELS))
    return [float(level) for level in range(high, low - 1, -step)][::-1]


def time_tables(values: DataFrame) -> list[Table]:
    """Make tables for each device and scene: PSNR after times, and times until PSNR levels."""
    ends = {
        "psnr_end": "at the end",
        "seconds_end": "training [s]",
        "gain": "gain of the second half",
    }
    made = []
    for (device, scene), part in values.groupby(["device", "scene"], sort=False):
        title = f"{scene}: PSNR [dB] of the probe views after so much training on {device}"
        made.append(_table(title, part, "psnr", ends))
        title = f"{scene}: training time [s] until the probe views have a PSNR of, on {device}"
        made.append(_table(title, part, "seconds", {}))
    return made


def _table(title: str, part: DataFrame, quantity: str, more: dict[str, str]) -> Table:
    """Put configurations in rows, places of a quantity and further quantities in columns."""
    places = sorted({*part[part.quantity == quantity]["at"]})
    spell = in_time if quantity == "psnr" else "{:g} dB".format
    heads = ["method", *map(spell, places), *more.values()]
    columns = [*((quantity, at) for at in places), *((name, None) for name in more)]
    texts = {}
    for row in part.itertuples():
        unit = "seconds" if row.quantity.startswith("seconds") else "psnr"
        texts[row.label, (row.quantity, row.at)] = with_spread(unit, row.mean, row.sd)
    labels = part.label.unique()
    rows = [[label, *(texts.get((label, column), "") for column in columns)] for label in labels]
    return Table(heads, rows, title=title)


def in_time(seconds: float) -> str:
    """Format seconds as ``30 s``, ``2 min`` or ``1 h``."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:g} {unit}"
    return f"{seconds:g} s"
