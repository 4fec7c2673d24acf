"""A static site of measured and published results, which needs no server."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from chronoscene.figures.canvas import period_colors
from chronoscene.harness.report.comparable import Setting, apart, comparable, setting_of
from chronoscene.harness.report.published import PublishedTable
from chronoscene.harness.report.summary import name_of, published_entries, summarise
from chronoscene.images.store import MAX_WIDTH
from chronoscene.io.pages import render_page
from chronoscene.io.staging import staged_folder
from leaderboard.board import Standing
from leaderboard.pictures import find_runs, gallery
from leaderboard.registry import command_of, spec_of, title_of
from leaderboard.scenes import role_of
from leaderboard.tables import (
    CLAIMED,
    PRINTED_COLUMNS,
    VERIFIED,
    Part,
    make_cell,
    make_group,
    make_rows,
    make_table,
    row_order,
)

PARTS = {
    "ranking": "Ranking scenes, which no trial of a preset has used",
    "": "Other scenes",
    "real": "Real scenes of the paper",
    "synthetic": "Synthetic scenes of the paper",
}
"""Titles of the tables of the first page, in their order."""


def write_site(
    standings: Collection[Standing], published: PublishedTable, out: Path, runs: Iterable[Path] = ()
) -> int:
    """Write the site.

    Args:
        standings: Measured results. Those that are verified are ranked, the others stand apart.
        published: Printed results, to stand beside them.
        out: A new or empty folder.
        runs: Folders of runs, for the pictures of the entries that were made of them.

    Returns:
        How many entries have pictures.

    Raises:
        SceneError: If ``out`` has content.
        CheckpointError: If an image of a run is not the one that its manifest lists.
    """
    pictured = find_runs(runs, standings)
    with staged_folder(out) as staged:
        _Site(standings, published, staged).write(pictured)
    return len(pictured)


class _Site:
    """All pages; methods and scenes have a name for their files each."""

    def __init__(
        self, standings: Collection[Standing], published: PublishedTable, folder: Path
    ) -> None:
        self.published, self.folder = published, folder
        self.groups = {kind: _grouped(standings, kind) for kind in (VERIFIED, CLAIMED)}
        everything = [record for standing in standings for record in standing.records]
        printed = published_entries(published, dict.fromkeys(row.scene for row in published.rows))
        self.printed = printed.assign(method=printed.method.map(published.methods))
        self.parts = {r.scene: "ranking" for r in everything if role_of(r.scene_hash) == "ranking"}
        self.parts |= {row.scene: row.group for row in published.rows}
        self.scenes = _file_names(dict.fromkeys([*(r.scene for r in everything), *self.parts]))
        measured = sorted({record.method for record in everything})
        self.colors = dict(zip(measured, period_colors(len(measured)), strict=True))
        methods = dict.fromkeys([*(r.method for r in everything), *published.methods.values()])
        self.methods = _file_names(methods)

    def write(self, pictured: Mapping[Path, Standing]) -> None:
        """Write everything."""
        for kind in ("scene", "method"):
            (self.folder / kind).mkdir()
        self._page("index", "index.html", parts=[*self._parts()])
        self._page("published", "published.html")
        for scene, file in self.scenes.items():
            found = {run: s for run, s in pictured.items() if s.records[0].scene == scene}
            runs = _labels(found)
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
        """Return the name of a method on its page."""
        return title_of(method) or f"{method}, not registered"

    def printed_title(self, method: str) -> str:
        """Return the name that the paper gives a method."""
        return next(title for title, name in self.published.methods.items() if name == method)

    def _parts(self) -> Iterator[dict[str, Any]]:
        """Yield tables of the first page: PSNR of methods by scenes, one per part of a dataset."""
        for group, title in PARTS.items():
            scenes = [scene for scene in self.scenes if self.parts.get(scene, "") == group]
            if not scenes:
                continue
            kinds = {kind: self._by_effort(kind, scenes) for kind in self.groups}
            printed: dict[str, dict[str, Any]] = {}
            psnr = self.printed[self.printed.quantity == "psnr"]
            for row in psnr[psnr.scene.isin(scenes)].itertuples():
                printed.setdefault(row.method, {})[row.scene] = make_cell(row)
            yield {
                "title": title,
                "scenes": scenes,
                "measured": {kind: efforts for kind, efforts in kinds.items() if efforts},
                "published": printed,
            }

    def _by_effort(self, kind: str, scenes: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
        """Make rows of the first page: efforts by their order, the best methods of each first."""
        measured: dict[tuple[str, str, str], dict[str, Any]] = {}
        groups = {s: found for s, found in self.groups[kind].items() if s.scene in scenes}
        for setting, effort in _efforts(groups).items():
            part = groups[setting].values
            for row in part[(part.quantity == "psnr") & (part.column == "macro")].itertuples():
                cells = measured.setdefault((row.method, row.label, effort), {})
                cells[setting.scene] = make_cell(row, ranked=kind == VERIFIED)
        efforts: dict[str, list[dict[str, Any]]] = {}
        for (method, label, effort), cells in measured.items():
            row = {"method": method, "label": label, "cells": cells}
            efforts.setdefault(effort, []).append(row)
        for rows in efforts.values():
            rows.sort(  # by the first scene, of which those that lack it are last
                key=lambda row: [row_order(kind, row["label"], row["cells"].get(s)) for s in scenes]
            )
        return dict(sorted(efforts.items(), key=lambda item: (len(item[0]), item[0])))

    def _scene_page(self, scene: str, file: str, pictures: dict[str, Any] | None) -> None:
        printed = self.printed[self.printed.scene == scene]
        settings = {setting for found in self.groups.values() for setting in found}
        groups = [
            make_group(
                setting,
                {kind: found[setting] for kind, found in self.groups.items() if setting in found},
                printed,
                self.colors,
            )
            for setting in sorted(settings, key=_place)
            if setting.scene == scene
        ]
        if not groups:
            groups = [make_table(PRINTED_COLUMNS, {}, printed)]
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
        of_paper = dict(printed[printed.quantity == "psnr"][["scene", "mean"]].to_numpy())
        measured: list[dict[str, Any]] = []
        for kind, found in self.groups.items():
            for setting, part in found.items():
                measured += _measured(method, kind, setting, part, of_paper)
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
            printed=make_rows(printed, PRINTED_COLUMNS, by="scene"),
            repeated=len({m["scene"] for m in measured if m["difference"]}),
            tables=tables,
        )


def _grouped(standings: Iterable[Standing], kind: str) -> dict[Setting, Part]:
    """Summarise the runs of a kind in each setting."""
    chosen = [s for s in standings if bool(s.claimed) == (kind == CLAIMED)]
    groups = comparable(record for standing in chosen for record in standing.records)
    return {
        setting: Part(groups[setting], summarise(groups[setting]))
        for setting in sorted(groups, key=_place)
    }


def _efforts(groups: Mapping[Setting, Part]) -> dict[Setting, str]:
    """Name the effort of each setting, and its test where a scene has several of one effort."""
    named: dict[tuple[str, str], list[Setting]] = {}
    for setting in groups:
        width = setting.max_width
        effort = setting.effort + (f", {width} pixels wide" if width != MAX_WIDTH else "")
        named.setdefault((setting.scene, effort), []).append(setting)
    found = {}
    for (_, effort), several in named.items():
        tests = [run.scene for run in apart([groups[setting].runs[0] for setting in several])]
        for setting, test in zip(several, tests, strict=True):
            found[setting] = f"{effort}, {test}" if len(several) > 1 else effort
    return found


def _place(setting: Setting) -> tuple[str | int, ...]:
    """Return the place of a setting on a page: 500 training steps come before 1,000."""
    return (*setting.test, len(setting.effort), setting.effort)


def _measured(
    method: str, kind: str, setting: Setting, part: Part, of_paper: Mapping[str, float]
) -> Iterator[dict[str, Any]]:
    """Yield a row of the page of a method for each variant of it in a setting.

    ``of_paper``: PSNR that was printed, by scene.
    """
    printed = of_paper.get(setting.scene) if kind == VERIFIED else None
    values = part.values[part.values.method == method]
    for row in values[(values.quantity == "psnr") & (values.column == "macro")].itertuples():
        run = next(r for r in part.runs if (r.method, r.config_hash) == (method, row.config_hash))
        yield {
            "scene": setting.scene,
            "label": row.label,
            "effort": setting.effort,
            "kind": kind,
            "cell": make_cell(row, ranked=False),
            "difference": "" if printed is None else f"{row.mean - printed:+z.2f}",
            "seeds": row.seeds,
            "command": command_of(run),
        }


def _labels(pictured: Mapping[Path, Standing]) -> dict[Path, str]:
    """Name the runs of a scene that share a test, those verified and the best first."""

    def place(run: Path) -> tuple[bool, float]:
        found = pictured[run]
        return bool(found.claimed), -found.records[0].aggregates["macro"].get("psnr", -math.inf)

    labels: dict[Path, str] = {}
    tests = []
    for run in sorted(pictured, key=place):
        record, mark = pictured[run].records[0], ", claimed" if pictured[run].claimed else ""
        tests.append(setting_of(record).test)
        if tests[-1] == tests[0]:
            labels[run] = f"{name_of(record)}{mark}"
    return labels


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
