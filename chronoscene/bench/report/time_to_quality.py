"""Quality by training time: PSNR of the probe views after given times, and the reverse."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from statistics import mean, stdev

import numpy as np
from numpy.typing import NDArray

from chronoscene.bench.files.records import CURVE_FILE, CurvePoint, RunRecord, read_lines
from chronoscene.bench.files.strategies import STRATEGIES
from chronoscene.bench.report.summary import labelled, with_spread
from chronoscene.bench.report.tables import ALL_SCENES
from chronoscene.io.tables import Table

LADDER = (1, 2, 5, 10, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 18000, 36000, 86400)
"""Seconds after which the PSNR is asked for, as far as a training lasts so long."""
MAX_LEVELS = 7
"""PSNR levels whose times are asked for, at most."""

Curve = NDArray[np.float64]
"""Seconds and PSNR of the probes of a run. [2, K]"""


@dataclass(frozen=True, slots=True)
class CurveValue:
    """A number that curves give for a configuration, a mean over its seeds."""

    scene: str
    """Or `ALL_SCENES`."""
    device: str
    label: str
    quantity: str
    """``psnr``: after ``at`` seconds of training. ``seconds``: until ``at`` dB are reached.
    ``psnr_end`` and ``seconds_end``: of the last probe. ``gain``: from half of the time of the last
    probe to that."""
    at: float | None
    mean: float
    sd: float | None
    """Sample standard deviation over the seeds; None for one."""
    n: int


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
    are added up and their PSNR is averaged. The stages of ``sequential`` probe other views each.
    """
    by_model = [
        np.array([(point.seconds, point.psnr) for point in part]).T
        for _, part in groupby(points, key=lambda point: point.model)
    ]
    if not by_model or STRATEGIES[strategy].in_order or len({c.shape for c in by_model}) > 1:
        return None
    stacked = np.stack(by_model)
    curve: Curve = np.stack([stacked[:, 0].sum(axis=0), stacked[:, 1].mean(axis=0)])
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


def curve_values(records: Sequence[RunRecord], curves: Sequence[Curve | None]) -> list[CurveValue]:
    """Read numbers off curves by device, scene and configuration; what a seed lacks is left out.

    Args:
        records: Runs of any scenes.
        curves: One for each of them.
    """
    known = [(run, curve) for run, curve in zip(records, curves, strict=True) if curve is not None]
    if not known:
        return []
    levels = psnr_levels([curve for _, curve in known])
    found: list[CurveValue] = []
    for device in dict.fromkeys(run.device for run, _ in known):
        here = [(run, curve) for run, curve in known if run.device == device]
        labels = labelled([run for run, _ in here]).label
        groups: dict[tuple[str, str], list[Curve]] = {}
        for (run, curve), label in zip(here, labels, strict=True):
            groups.setdefault((run.scene, label), []).append(curve)
        single = [
            value
            for (scene, label), seeds in groups.items()
            for value in _of_seeds(scene, device, label, seeds, levels)
        ]
        scenes = {value.scene for value in single}
        found += single
        if len(scenes) > 1:
            found += _over_scenes(single, len(scenes))
    return found


def psnr_levels(curves: Sequence[Curve]) -> list[float]:
    """List whole dB that some probe reached, at most `MAX_LEVELS` at equal distances."""
    values = np.concatenate([curve[1] for curve in curves])
    low, high = math.ceil(values.min()), math.floor(values.max())
    step = max(1, math.ceil((high - low + 1) / MAX_LEVELS))
    return [float(level) for level in range(high, low - 1, -step)][::-1]


def _of_seeds(
    scene: str, device: str, label: str, curves: Sequence[Curve], levels: Iterable[float]
) -> Iterator[CurveValue]:
    wanted: list[tuple[str, float | None, list[float]]] = [
        ("psnr", float(time), [psnr_after(curve, time) for curve in curves]) for time in LADDER
    ]
    ends = [(float(curve[0, -1]), float(curve[1, -1])) for curve in curves]
    gains = [
        psnr - psnr_after(curve, time / 2) for curve, (time, psnr) in zip(curves, ends, strict=True)
    ]
    wanted += [
        ("psnr_end", None, [psnr for _, psnr in ends]),
        ("seconds_end", None, [time for time, _ in ends]),
        ("gain", None, gains),
    ]
    wanted += [("seconds", level, [seconds_until(c, level) for c in curves]) for level in levels]
    for quantity, at, values in wanted:
        if all(map(math.isfinite, values)):
            sd = stdev(values) if len(values) > 1 else None
            yield CurveValue(scene, device, label, quantity, at, mean(values), sd, len(values))


def _over_scenes(single: Sequence[CurveValue], scenes: int) -> Iterator[CurveValue]:
    """Average over scenes the numbers that are known for all of them."""
    parts: dict[tuple[str, str, float | None], list[CurveValue]] = {}
    for value in single:
        key = value.label, value.quantity, value.at
        parts.setdefault(key, []).append(value)
    for (label, quantity, at), part in parts.items():
        if len(part) == scenes:
            sds = [value.sd for value in part if value.sd is not None]
            sd = math.hypot(*sds) / scenes if len(sds) == scenes else None
            value, n = mean(value.mean for value in part), min(r.n for r in part)
            yield CurveValue(ALL_SCENES, part[0].device, label, quantity, at, value, sd, n)


def time_tables(found: Sequence[CurveValue]) -> list[Table]:
    """Make tables for each device and scene: PSNR after times, and times until PSNR levels."""
    made = []
    for device, scene in dict.fromkeys((value.device, value.scene) for value in found):
        part = [r for r in found if (r.device, r.scene) == (device, scene)]
        place = f"on {device}"
        title = f"{scene}: PSNR [dB] of the probe views after so much training {place}"
        ends = {
            "psnr_end": "at the end",
            "seconds_end": "training [s]",
            "gain": "gain of the second half",
        }
        made.append(_table(title, part, "psnr", ends))
        title = f"{scene}: training time [s] until the probe views have a PSNR of, {place}"
        made.append(_table(title, part, "seconds", {}))
    return made


def _table(title: str, part: Sequence[CurveValue], quantity: str, more: dict[str, str]) -> Table:
    """Put configurations in rows, places of a quantity and further quantities in columns."""
    columns = {(quantity, r.at) for r in part if r.quantity == quantity}
    ordered: list[tuple[str, float | None]] = sorted(columns, key=lambda column: column[1] or 0)
    spell = in_time if quantity == "psnr" else "{:g} dB".format
    heads = [("method", ""), *((spell(at or 0), "") for _, at in ordered)]
    heads += [(text, "") for text in more.values()]
    ordered += [(name, None) for name in more]
    texts = {(r.label, (r.quantity, r.at)): _text(r) for r in part}
    labels = dict.fromkeys(r.label for r in part)
    rows = [[label, *(texts.get((label, column), "") for column in ordered)] for label in labels]
    return Table(heads, rows, title=title)


def _text(value: CurveValue) -> str:
    unit = "seconds" if value.quantity.startswith("seconds") else "psnr"
    return with_spread(unit, value.mean, value.sd)


def in_time(seconds: float) -> str:
    """Format seconds as ``30 s``, ``2 min`` or ``1 h``."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:g} {unit}"
    return f"{seconds:g} s"
