"""``chronoscene tradeoff``: quality against cost over finished runs."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from chronoscene.cli.options import FOLDER, RUNS, FiniteFloat, refuse_options
from chronoscene.cli.output import (
    FORMAT,
    OUT_FILE,
    emit,
    report_written,
    terminal_width,
    writing_to,
)
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import FIGURES, RunRecord
from chronoscene.harness.plan.stop import parse_duration
from chronoscene.harness.report.summary import COSTS, read_runs, summarise
from chronoscene.harness.report.tables import COST_TITLES, footnotes, tables_text
from chronoscene.harness.report.time_to_quality import (
    curve_values,
    read_curve,
    time_tables,
    whole_curve,
)
from chronoscene.harness.report.tradeoff import (
    FRONT_COLUMNS,
    Limits,
    as_configurations,
    choose,
    front_points,
    front_tables,
)
from chronoscene.metrics.registry import metric_info

if TYPE_CHECKING:
    from pandas import DataFrame

FIGURE = "tradeoff.png"


@click.command("tradeoff")
@RUNS
@FORMAT
@OUT_FILE
@click.option(
    "--figures",
    type=FOLDER,
    help=f"Folder for {FIGURE}.  [default: {FIGURES}/ in the first of RUNS]",
)
@click.option(
    "--budget", help="Print the configuration to use for this training time, such as 90s or 5m."
)
@click.option("--max-bytes", help="The same for models of this size, such as 500kB, 10MB or 1GB.")
@click.option(
    "--target-psnr",
    type=FiniteFloat(),
    help="The same for this PSNR in dB, in the least training time.",
)
def command(
    folders: tuple[Path, ...],
    style: str,
    out: Path | None,
    figures: Path | None,
    budget: str | None,
    max_bytes: str | None,
    target_psnr: float | None,
) -> None:
    """Show what quality costs in finished runs.

    Draw and print Pareto fronts of PSNR, SSIM and LPIPS against training time, rendering rate, size
    and memory; then print the PSNR of the probe views after given training times, and the times at
    which they reach a given PSNR. CSV has all points. With --budget, --max-bytes or --target-psnr,
    only the configuration to use is printed. docs/guides/tables-and-figures.md explains both.
    """
    records, failures = read_runs(folders)
    records = as_configurations(records)
    target = None if target_psnr is None else f"{target_psnr:g}"
    typed = {"--budget": budget, "--max-bytes": max_bytes, "--target-psnr": target}
    given = [f"{name} {value}" for name, value in typed.items() if value is not None]
    if given:
        refuse_options(("style", "figures"), "with --budget, --max-bytes or --target-psnr")
        limits = Limits(
            seconds=None if budget is None else parse_duration(budget),
            size=None if max_bytes is None else parse_size(max_bytes),
            psnr=target_psnr,
        )
        emit("".join(f"{line}\n" for line in choose(records, limits, " ".join(given))), out)
        return
    curves = [whole_curve(read_curve(run.folder), run.strategy) for run in records]
    points, times = front_points(records), curve_values(records, curves)
    entries = summarise(records).assign(tied=False, difference_low=math.nan)  # neither is shown
    notes = footnotes(entries, records, failures, macro_only=True)
    emit(_text(points, times, notes, style, out), out)
    if len(points):
        figure = (figures or folders[0] / FIGURES) / FIGURE
        with writing_to("--figures", figure):
            draw(points, figure, records)
        report_written(figure)


def parse_size(text: str) -> float:
    """Bytes of ``500kB``, ``10MB`` or ``1.5GB``.

    Raises:
        ConfigError: If the text is none of these or not positive.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?(k|M|G)B", text)
    size = float(found[1]) * {"k": 1e3, "M": 1e6, "G": 1e9}[found[2]] if found else 0.0
    if not size:
        raise ConfigError(
            "--max-bytes",
            expected="a positive size such as 500kB, 10MB or 1GB",
            found=repr(text),
            todo="write a number with the unit kB, MB or GB",
        )
    return size


def _text(
    points: DataFrame, times: DataFrame, notes: list[str], style: str, out: Path | None
) -> str:
    """Return everything but the figure, in one of the formats."""
    if style == "csv":
        return str(points.to_csv(columns=FRONT_COLUMNS, index=False, lineterminator="\n"))
    if style == "json":
        from pydantic import ConfigDict, TypeAdapter

        fronts, times = points.to_dict("records"), times.to_dict("records")
        document: dict[str, Any] = {"fronts": fronts, "times": times, "notes": notes}
        adapter = TypeAdapter(dict[str, Any], config=ConfigDict(ser_json_inf_nan="strings"))
        return adapter.dump_json(document, indent=1).decode() + "\n"
    made = [*front_tables(points), *time_tables(times)]
    return tables_text(made, notes, style, width=terminal_width(out))


def draw(points: DataFrame, path: Path, records: Sequence[RunRecord]) -> None:
    """Draw all panels of some points; a row for each scene and metric.

    Args:
        points: As from `front_points`.
        path: File to write.
        records: The runs, for the note.
    """
    from chronoscene.figures.fronts import Panel, draw_fronts

    names = points.label.unique().tolist()
    points = points.assign(number=[names.index(label) + 1 for label in points.label])
    groups = points.groupby("method", sort=False).number.unique().map(list).to_dict()
    rows = [
        [
            Panel(
                title=" on ".join(filter(None, (scene, device))),
                x_label="rendering [images/s]" if cost == "render_seconds" else COST_TITLES[cost],
                y_label=metric_info(metric).title,
                marks=[_mark(point) for point in panel.itertuples()],
                lower_is_better=not metric_info(metric).higher_is_better,
            )
            for (cost, device), panel in row.groupby(["cost", "device"], sort=False)
        ]
        for (scene, metric), row in points.groupby(["scene", "metric"], sort=False)
    ]
    devices = "; ".join(dict.fromkeys(run.device for run in records))
    commits = ", ".join(dict.fromkeys(run.commit for run in records))
    note = (
        "Test views, means over periods. Filled: on the Pareto front, which the line follows. "
        "Bars: standard deviation over seeds. Discs that would hide others are beside them."
        f"\nDevice: {devices}. Code: {commits}."
    )
    draw_fronts(rows, path, names=names, groups=groups, note=note)


def _mark(point: Any) -> Any:
    """Place a row of `front_points`, with its ``number``, in a panel."""
    from chronoscene.figures.fronts import Mark

    factor = next(known.factor for known in COSTS if known.name == point.cost)
    x, spread = point.value * factor, (point.value_sd or 0.0) * factor
    if point.cost == "render_seconds":
        x = 1 / point.value
        spread = x * (point.value_sd or 0.0) / point.value  # to first order
    return Mark(
        number=point.number,
        x=x,
        y=point.quality,
        x_spread=spread,
        y_spread=point.quality_sd or 0.0,
        on_front=point.on_front,
    )
