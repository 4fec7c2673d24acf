"""``chronoscene survey``: maps, point clouds and differences of elevations of the periods."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from chronoscene.cli.options import (
    DEVICE,
    EXISTING_FILE,
    FOLDER,
    PLUGIN,
    SCENE,
    FiniteRange,
    refuse_options,
)
from chronoscene.cli.output import check_place, emit, report_written, say, terminal_width
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.runs.changes import BETWEEN, parse_pairs
from chronoscene.cli.scenes.reading import read_and_note, show_note
from chronoscene.harness.files.records import RUN_FILE
from chronoscene.harness.use.changes import usual_pairs
from chronoscene.harness.use.trained_run import open_run
from chronoscene.io.staging import check_outside, staged_folder
from chronoscene.io.tables import Table, boxed_text
from chronoscene.survey.products import SurveyOptions, check_packages, write_survey


@click.command("survey")
@click.argument("source", metavar="RUN|SCENE", type=FOLDER)
@click.option("--out", type=FOLDER, required=True, help="New folder for the products.")
@BETWEEN
@click.option(
    "--resolution",
    type=FiniteRange(min=0, min_open=True),
    help="Edge of a cell in metres.  [default: a pixel of the training photos on the ground]",
)
@click.option("--area", type=EXISTING_FILE, help="GeoJSON file with polygons for volumes.")
@click.option(
    "--crs",
    help="Projected reference system of the products, such as EPSG:32632.  [default: that of the "
    "scene; of the local frame of register, UTM on WGS 84]",
)
@SCENE
@PLUGIN
@DEVICE
def command(
    source: Path,
    out: Path,
    between: tuple[tuple[str, str], ...],
    resolution: float | None,
    area: Path | None,
    crs: str | None,
    scene: Path | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Make maps, point clouds, elevation differences and volumes.

    RUN is the folder of a finished run, such as runs/plaza/chronogs-joint-balanced/seed0. For each
    period, OUT gets an orthophoto and a surface model (GeoTIFF) and a point cloud (LAZ); for each
    pair of periods the difference of elevations with its level of detection, volumes of cut and
    fill, and distances by M3C2 (LAZ). For a SCENE without a model, OUT gets point clouds and
    distances of its sparse points. docs/guides/survey.md explains the numbers.
    """
    check_packages()
    check_place("--out", out)
    is_run = scene is not None or (source / RUN_FILE).is_file()
    if not is_run:
        refuse_options(("device", "plugin"), "for a scene without a model")
    run = open_run(source, device=device, plugin=plugin) if is_run else None
    say("read the scene")
    found = read_and_note(source, None, None) if run is None else run.scene(scene)
    check_outside(out, [found.root], option="--out")
    labels = [period.label for period in found.periods]
    pairs = parse_pairs(labels, between) or usual_pairs(found.num_periods)
    options = SurveyOptions(tuple(pairs), resolution, area, crs)
    with staged_folder(out) as staged, progress_bar() as report:
        summary = write_survey(run, found, staged, options, report)
    _print(summary)
    report_written(out)


def _print(summary: Mapping[str, Any]) -> None:
    labels = [period["label"] for period in summary["periods"]]
    rows = []
    for pair in summary["pairs"]:
        name = " → ".join(labels[period] for period in pair["periods"])
        for v in pair.get("volumes", ()):
            volumes = (
                "-"
                if v[f"{kind}_m3"] is None
                else f"{v[f'{kind}_m3']:,.0f} ± {v[f'{kind}_interval_m3']:,.0f}"
                for kind in ("fill", "cut", "net")
            )
            rows.append((name, v["polygon"], f"{v['area_m2']:,.0f}", *volumes))
        if pair["m3c2"] is None:
            say(f"no M3C2 of {name}: {pair['m3c2_absent']}", fg="yellow")
        if (pair["m3c2"] or "volumes" in pair) and not pair["registration"]["sigma"]:
            say(f"{name}: error of the alignment {pair['registration']['source']}", fg="yellow")
    if rows:
        names = ("periods", "polygon", "known, m²", "fill, m³", "cut, m³", "net, m³")
        title = "Volumes with their 95 % intervals"
        table = Table(names, rows, labels=2, title=title)
        emit(boxed_text(table, width=terminal_width()))
    for period in summary["periods"]:
        emit(f"period {period['label']}: {period['points']:,} points{_heights(period)}\n")
    coordinates = summary["coordinates"]
    emit(f"coordinates: {coordinates['note'] or coordinates['crs']}\n")
    for remark in coordinates["remarks"]:
        show_note(remark)
    if "note" in summary:
        say(f"note: {summary['note']}", fg="yellow")


def _heights(period: Mapping[str, Any]) -> str:
    found = period.get("sparse_points")
    if found is None:
        return ""
    numbers = f"median {found['median']:+.2f} m, NMAD {found['nmad']:.2f} m"
    return f"; heights minus {found['count']:,} sparse points: {numbers}"
