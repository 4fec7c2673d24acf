"""Methods between two dates: a figure, a table and CSV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

from chronoscene.arrays import Pixels
from chronoscene.figures import canvas
from chronoscene.harness.files.predictions import safe_part
from chronoscene.harness.files.records import FIGURES
from chronoscene.harness.report.figures.comparison import CELL_WIDTH
from chronoscene.harness.report.summary import kind_of, name_of
from chronoscene.harness.report.tables import period_name
from chronoscene.harness.score.between import FRACTIONS, MethodBetween, SceneBetween
from chronoscene.io.tables import Table, csv_text

CSV_COLUMNS = (
    *("scene", "from", "to", "method", "nearer_date", "between_dates", "ratio"),
    *("pixels", "mask"),
)

TRUTH = "ground truth"  # Title of the first row


def draw_between(runs: Path, found: SceneBetween) -> Path:
    """Draw one camera between two dates, a row for each method; returns the file."""
    first, last = found.dates
    rows: list[tuple[str, Sequence[Pixels | None]]] = [
        (TRUTH, (found.truths[0], *[None] * len(FRACTIONS), found.truths[1])),
        *((_row_title(method), method.images) for method in found.methods),
    ]
    shape = next(image.shape for _, images in rows for image in images if image is not None)
    columns = 2 + len(FRACTIONS)
    height = CELL_WIDTH * shape[0] / shape[1]
    size = (CELL_WIDTH * columns + 0.4, (height + 0.05) * len(rows) + 0.8)
    figure = canvas.new_figure(*size, layout="compressed", dpi=150)
    axes: Any = figure.subplots(len(rows), columns, squeeze=False)
    for line, (title, images) in zip(axes, rows, strict=True):
        line[0].set_ylabel(title, fontsize=8)
        for axis, image in zip(line, images, strict=True):
            axis.set_xticks([])
            axis.set_yticks([])
            if image is not None:
                axis.imshow(image)
            else:
                axis.set(xlim=(0, 1), ylim=(0, 1), facecolor="0.92", aspect=shape[0] / shape[1])
        if images[1] is None and title != TRUTH:
            line[columns // 2].text(0.5, 0.5, "no periods in between", ha="center", fontsize=9)
    for axis, image in zip(axes[0], rows[0][1], strict=True):
        axis.set_visible(image is not None)
    heads = [f"{first + f * (last - first):g}" for f in FRACTIONS]
    names = [shorten(period_name(date, found.labels), 26) for date in found.dates]
    for column, head in enumerate((names[0], *heads, names[1])):
        line = axes[0 if rows[0][1][column] is not None else 1]
        line[column].set_title(canvas.plain(head), fontsize=10)
    title = f"{found.scene}: {found.view} from period {first} to {last}"
    figure.suptitle(canvas.plain(title), fontsize=12)
    path = runs / FIGURES / f"{safe_part(found.scene)}_between_{first}_{last}.png"
    canvas.save(figure, path, bbox_inches="tight", pad_inches=0.1)
    return path


def _row_title(method: MethodBetween) -> str:
    title = canvas.plain_lines(f"{method.record.title}\n{kind_of(method.record)}")
    if method.score is not None and not math.isnan(method.score.ratio):
        title += f"\nratio {method.score.ratio:.2f}"
    return title


def between_table(found: SceneBetween) -> Table:
    """Make a table of the scores on a scene."""
    heads = ("method", "to the nearer date", "between the dates", "ratio")
    rows = []
    for method in found.methods:
        score = method.score
        values = () if score is None else (score.distance, score.change, score.ratio)
        texts = ["-" if math.isnan(value) else f"{value:.3f}" for value in values]
        rows.append([name_of(method.record), *(texts or "---")])
    names = [period_name(date, found.labels) for date in found.dates]
    mask = "ground truth" if found.from_truth else "renders"
    title = (
        f"{found.scene}: RMS distance of colours between {names[0]} and {names[1]}, "
        f"{found.pixels} pixels that change by the {mask}"
    )
    return Table(heads, rows, title=title)


def between_csv(found: Sequence[SceneBetween]) -> str:
    """Write the scores on all scenes as CSV; empty where there is none."""
    rows = []
    for scene in found:
        for method in scene.methods:
            score = method.score
            values = (None,) * 3 if score is None else (score.distance, score.change, score.ratio)
            name, mask = name_of(method.record), "truth" if scene.from_truth else "renders"
            rows.append([scene.scene, *scene.dates, name, *values, scene.pixels, mask])
    return csv_text(CSV_COLUMNS, rows)
