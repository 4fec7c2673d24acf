"""``chronoscene all``: from photos of several dates to scene, model and products."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from chronoscene.cli.options import PATH, PRESET, TABLE
from chronoscene.cli.output import check_place, report_written, say
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.runs.bench import BUDGET, MEMORY, WIDTH
from chronoscene.workflow.run import run_steps, start
from chronoscene.workflow.steps import Project


@click.command("all")
@click.argument("captures", type=PATH)
@click.argument("out", type=PATH)
@TABLE
@PRESET
@BUDGET
@WIDTH
@MEMORY
def command(
    captures: Path, out: Path, table: Path | None, photo_memory: float, **options: Any
) -> None:
    """Make a scene, a model, a page and products from photos.

    CAPTURES is what register takes: for example, a folder with a subfolder of photos for each
    period. The photos are registered, the scene is checked, ChronoGS is trained on it, and the
    model is made into a page to walk through, exported, and surveyed. OUT/index.html links
    everything. The same command continues a run that was stopped; if photos or options have
    changed, it repeats the steps that depend on them.

    Nothing is trained if the alignment of the periods fails. Exit status: 0 if all steps are done
    or were skipped for a reason, 2 if one fails.
    """
    check_place("OUT", out)
    record, changes = start(captures, table, out, options)
    if changes:
        say(changes)
    project = Project(captures, table, out, options, record, say, progress_bar, photo_memory)
    page = run_steps(project)
    report_written(page)
