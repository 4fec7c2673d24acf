"""A static site of measured and published results, which needs no server."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from chronoscene.figures.canvas import period_colors
from chronoscene.harness.files.command_line import command_line
from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.report.comparable import Setting, comparable, setting_of
from chronoscene.harness.report.published import PublishedTable
from chronoscene.harness.report.summary import (
    PAPER_METRICS,
    SIZE,
    in_unit,
    kind_of,
    metric_names,
    published_entries,
    short_commits,
    summarise,
)
from chronoscene.harness.report.tables import period_title
from chronoscene.harness.report.tradeoff import as_configurations
from chronoscene.io.pages import render_page
from chronoscene.io.staging import staged_folder
from chronoscene.methods import MethodSpec, installed_methods, load_spec
from chronoscene.metrics.registry import metric_info
from leaderboard.entries import MeasuredEntry
from leaderboard.pareto import Point, plot
from leaderboard.pictures import find_runs, gallery
from leaderboard.scenes import role_of

if TYPE_CHECKING:
    from pandas import DataFrame

OTHER_SCENES = "Other scenes"
PARTS = {"real": "Real scenes of the paper", "synthetic": "Synthetic scenes of the paper"}
COSTS = {"seconds": "training [s]", SIZE: "size [MB]", "peak_memory_bytes": "memory [MB]"}

PRINTED_COLUMNS = (
    *((name, "macro", metric_info(name).title) for name in PAPER_METRICS),
    (SIZE, "", COSTS[SIZE]),
)
"""Quantity, column and title of the published numbers."""


def write_site(
    entries: Collection[MeasuredEntry],
    published: PublishedTable,
    out: Path,
    runs: Iterable[Path] = (),
) -> int:
    """Write the site.

    Args:
        entries: Measured results.
        published: Printed results, to stand beside them.
        out: A new or empty folder.
        runs: Folders of runs, for the pictures of the entries that were made of them.

    Returns:
        How many entries have pictures.

    Raises:
        SceneError: If ``out`` has content.
        CheckpointError: If an image of a run is not the one that its manifest lists.
    """
    pictured = find_runs(runs, entries)
    with staged_folder(out) as staged:
        _Site(entries, published, staged).write(pictured)
    return len(pictured)


class _Site:
    """All pages; methods and scenes have a name for their files each."""

    def __init__(
        self, entries: Collection[MeasuredEntry], published: PublishedTable, folder: Path
    ) -> None:
        self.published, self.folder = published, folder
        self.records = [record for entry in entries for record in entry.records]
        self.titles = {r.record.method: r.record.title for entry in entries for r in entry.runs}
        printed = published_entries(published, dict.fromkeys(row.scene for row in published.rows))
        self.printed = printed.assign(method=printed.method.map(published.methods))
        self.parts = {row.scene: row.group for row in published.rows}
        names = {scene.casefold(): scene for scene in self.parts}
        self.scene_of = {r.scene: names.get(r.scene.casefold(), r.scene) for r in self.records}
        scenes = dict.fromkeys([*self.scene_of.values(), *self.parts])
        self.scenes = _file_names(scenes)
        measured = sorted({record.method for record in self.records})
        self.colors = dict(zip(measured, period_colors(len(measured)), strict=True))
        methods = dict.fromkeys([*(r.method for r in self.records), *published.methods.values()])
        self.methods = _file_names(methods)

    def write(self, pictured: dict[Path, RunRecord]) -> None:
        """Write everything."""
        for kind in ("scene", "method"):
            (self.folder / kind).mkdir()
        self._page("index", "index.html", parts=[*self._parts()])
        self._page("published", "published.html")
        for scene, file in self.scenes.items():
            found = {run: r for run, r in pictured.items() if self.scene_of[r.scene] == scene}
            psnr = {run: r.aggregates["macro"].get("psnr", -math.inf) for run, r in found.items()}
            found = dict(sorted(found.items(), key=lambda item: -psnr[item[0]]))
            tests = [setting_of(r).test for r in found.values()]
            found = {run: r for run, r in found.items() if setting_of(r).test == tests[0]}
            runs = {run: f"{r.title} ({kind_of(r)})" for run, r in found.items()}
            pictures = None
            if runs:
                place = self.folder / "images" / file.removesuffix(".html")
                pictures = gallery(runs, place, f"../images/{place.name}")
            self._scene_page(scene, file, pictures)
        for method, file in self.methods.items():
            self._method_page(method, file)

    def _page(self, template: str, file: str, **values: Any) -> None:
        page = render_page(
            f"leaderboard/{template}", site=self, root="../" if "/" in file else "", **values
        )
        (self.folder / file).write_text(page + "\n", encoding="utf-8", newline="\n")

    def title_of(self, method: str) -> str:
        """Return the name of a method in tables."""
        printed = {name: title for title, name in self.published.methods.items()}
        return self.titles.get(method) or printed.get(method, method)

    def _parts(self) -> Iterator[dict[str, Any]]:
        """Yield tables of the first page: PSNR of methods by scenes, one per part of a dataset."""
        groups = {self.parts.get(scene, "") for scene in self.scenes}
        for group in sorted(groups):  # other scenes, which were measured, come first
            scenes = [scene for scene in self.scenes if self.parts.get(scene, "") == group]
            measured: dict[tuple[Any, ...], dict[str, Any]] = {}
            for setting, _, part in self._groups(scenes):
                for row in part[(part.quantity == "psnr") & (part.column == "macro")].itertuples():
                    scene = self.scene_of[setting.scene]
                    key: tuple[Any, ...] = (row.method, row.label, setting.effort)
                    while scene in measured.get(key, {}):  # other photos or test views
                        key = (*key, "")
                    measured.setdefault(key, {})[scene] = _cell(row)
            printed: dict[str, dict[str, Any]] = {}
            psnr = self.printed[self.printed.quantity == "psnr"]
            for row in psnr[psnr.scene.isin(scenes)].itertuples():
                printed.setdefault(row.method, {})[row.scene] = _cell(row)
            yield {
                "title": PARTS.get(group, group) or OTHER_SCENES,
                "scenes": scenes,
                "measured": _by_effort(measured),
                "published": printed,
            }

    def _groups(
        self, scenes: Iterable[str]
    ) -> Iterator[tuple[Setting, list[RunRecord], DataFrame]]:
        """Yield the runs on some scenes in each setting, and their summary."""
        chosen = [r for r in self.records if self.scene_of[r.scene] in {*scenes}]
        for setting, runs in comparable(chosen).items():
            yield setting, runs, summarise(runs)

    def _scene_page(self, scene: str, file: str, pictures: dict[str, Any] | None) -> None:
        printed = self.printed[self.printed.scene == scene]
        groups = [_group(*group, printed, self.colors) for group in self._groups([scene])]
        if not groups:
            groups = [_table(PRINTED_COLUMNS, printed[:0], printed)]
        self._page(
            "scene",
            f"scene/{file}",
            scene=scene,
            groups=groups,
            pictures=pictures,
            data=pictures and Markup(json.dumps(pictures).replace("<", "\\u003c")),
        )

    def _method_page(self, method: str, file: str) -> None:
        printed = self.printed[self.printed.method == method]
        of_paper = dict(printed.query("quantity == 'psnr'")[["scene", "mean"]].to_numpy())
        measured: list[dict[str, Any]] = []
        for record in {setting_of(r): r for r in self.records if r.method == method}.values():
            measured += self._measured(record, of_paper)
        names = {name for name, value in self.published.methods.items() if value == method}
        tables = [
            {"title": table.title, "columns": table.columns, "rows": rows}
            for table in self.published.tables
            if (rows := [row for row in table.rows if row[0] in names])
        ]
        self._page(
            "method",
            f"method/{file}",
            method=method,
            spec=spec_of(method),
            measured=measured,
            columns=[title for _, _, title in PRINTED_COLUMNS],
            printed=_rows(printed, PRINTED_COLUMNS, by="scene"),
            repeated=len({self.scene_of[m["scene"]] for m in measured} & of_paper.keys()),
            tables=tables,
        )

    def _measured(self, like: RunRecord, of_paper: dict[str, float]) -> Iterator[dict[str, Any]]:
        """Yield a row for each variant of a method in a setting.

        Args:
            like: One of the runs.
            of_paper: PSNR that was printed, by scene.
        """
        setting = setting_of(like)
        runs = [r for r in self.records if setting_of(r) == setting and r.method == like.method]
        part = summarise(runs)
        for row in part.query("quantity == 'psnr' and column == 'macro'").itertuples():
            printed = of_paper.get(self.scene_of[like.scene])
            (run,) = as_configurations([r for r in runs if r.config_hash == row.config_hash][:1])
            yield {
                "scene": like.scene,
                "label": row.label,
                "effort": setting.effort,
                "cell": {**_cell(row), "best": False, "tied": False},
                "difference": "" if printed is None else f"{row.mean - printed:+z.2f}",
                "seeds": row.seeds,
                "command": command_line("SCENE", dict(run), run.seed),
            }


def _by_effort(
    measured: Mapping[tuple[Any, ...], dict[str, Any]],
) -> dict[str, list[dict[str, Any]]]:
    """Arrange the rows of the first page: efforts by their order, methods by their quality.

    Args:
        measured: Cells by scene, for each method, label and effort.
    """
    efforts: dict[str, list[dict[str, Any]]] = {}
    for (method, label, effort, *_), cells in sorted(
        measured.items(), key=lambda item: _order(next(iter(item[1].values())))
    ):
        row = {"method": method, "label": label, "cells": cells}
        efforts.setdefault(effort, []).append(row)
    return dict(sorted(efforts.items(), key=lambda item: (len(item[0]), item[0])))


def spec_of(method: str) -> MethodSpec | None:
    """Load the spec of an installed method; nothing that an entry names is imported."""
    return load_spec(method) if method in installed_methods() else None


Column = tuple[str, str, str]
"""Quantity and column of `summarise`, and the title."""


def _group(
    setting: Setting,
    runs: Sequence[RunRecord],
    part: DataFrame,
    printed: DataFrame,
    colors: Mapping[str, str],
) -> dict[str, Any]:
    """Make the table and the plots of runs that may stand side by side.

    ``colors``: by the name of a method.
    """
    labels = runs[0].period_labels
    periods = sorted({i for run in runs for i in run.periods}, key=int)
    names = metric_names(runs)
    quality, *others = [name for name in PAPER_METRICS if name in names] or names
    timed = part.quantity == "seconds"
    devices = part.device[timed].unique()
    part = part.assign(column=part.column.mask(timed, part.device))
    times = [
        ("seconds", device, COSTS["seconds"] + (f", {device}" if len(devices) > 1 else ""))
        for device in devices
    ]
    columns = [
        (quality, "macro", metric_info(quality).title),
        *((quality, f"period {i}", period_title(i, labels)) for i in periods),
        *((name, "macro", metric_info(name).title) for name in others),
        *times,
        *((name, "", title) for name, title in COSTS.items() if name != "seconds"),
    ]
    table = _table(columns, part, printed)
    legend = {i: (row["label"], colors[row["method"]]) for i, row in enumerate(table["rows"], 1)}
    values = part.set_index(["label", "quantity", "column"])["mean"]
    plots = []
    for name, column, cost in (*times, (SIZE, "", "size of the model [MB]")):
        points = []
        for i, (label, _) in legend.items():
            spent, gained = (label, name, column), (label, quality, "macro")
            if {spent, gained} <= {*values.index}:
                points.append(Point(i, float(in_unit(name, values[spent])), values[gained]))
        plots.append(plot(points, legend, cost=cost, metric=quality))
    return {
        **table,
        "setting": setting,
        "plots": [p for p in plots if p is not None],
        "legend": legend,
        "role": role_of(setting.scene_hash),
        "devices": list(dict.fromkeys(run.device for run in runs)),
        "commits": list(dict.fromkeys(short_commits(run.commit) for run in runs)),
    }


def _table(columns: Sequence[Column], measured: DataFrame, printed: DataFrame) -> dict[str, Any]:
    """Make a table for the page of a scene."""
    return {
        "columns": [title for _, _, title in columns],
        "lower": [q in COSTS or not metric_info(q).higher_is_better for q, _, _ in columns],
        "rows": sorted(_rows(measured, columns), key=lambda row: _order(row["cells"][0])),
        "printed": _rows(printed, columns),
        "tied": bool(measured.tied.any()),
    }


def _rows(part: DataFrame, columns: Sequence[Column], *, by: str = "label") -> list[dict[str, Any]]:
    """Make the rows of a table, one per label or per scene."""
    rows = []
    for name, own in part.groupby(by, sort=False):
        found = {(row.quantity, row.column): row for row in own.itertuples()}
        cells = [_cell(found[q, c]) if (q, c) in found else None for q, c, _ in columns]
        first = own.iloc[0]
        rows.append({by: name, "method": first.method, "seeds": first.seeds, "cells": cells})
    return rows


def _cell(row: Any) -> dict[str, Any]:
    """Make a cell of a table from a row of `summarise`."""
    interval = ""
    if math.isfinite(row.low) and row.column == "macro":
        interval = f"{in_unit(row.quantity, row.low)} to {in_unit(row.quantity, row.high)}"
    return {
        "text": row.text,
        "value": float(row.mean),
        "interval": interval,
        "tied": bool(row.tied),
        "best": row.rank == 1,
    }


def _order(cell: dict[str, Any] | None) -> float:
    """Sort the largest first, and missing values last."""
    return -cell["value"] if cell else math.inf


def _file_names(names: Iterable[str]) -> dict[str, str]:
    """Make a file name for each name: plain, and no two alike."""
    found: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^a-z0-9]+", "-", name.casefold()).strip("-")[:60] or "x"
        number, file = 1, f"{plain}.html"
        while file in found.values():
            number += 1
            file = f"{plain}-{number}.html"
        found[name] = file
    return found
