"""``index.html``: what was photographed, what was made of it, and how to repeat it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from PIL import Image

from chronoscene import __version__
from chronoscene.harness.files.records import RunRecord, read_run
from chronoscene.io.pages import data_uri, render_page
from chronoscene.io.wording import format_time, in_words
from chronoscene.workflow.record import StepRecord
from chronoscene.workflow.steps import STEPS, Project, Step

METRICS = {"psnr": ("PSNR, dB", 2), "ssim": ("SSIM", 3)}
"""Metrics on the page: title and decimals."""


def render_summary(project: Project, steps: Mapping[str, StepRecord]) -> str:
    """Render the page.

    Args:
        project: Photos, options and folder.
        steps: Records of the steps whose results hold.
    """
    done = {name: step for name, step in steps.items() if step.state == "done"}
    run = read_run(project.run) if "bench" in done else None
    return render_page(
        "workflow/page",
        title=project.out.resolve().name,
        version=__version__,
        certificate=project.certificate if "register" in done else None,
        run=run,
        metrics=[title for title, _ in METRICS.values()],
        scores=[] if run is None else list(_scores(run)),
        duration=format_time(run.seconds) if run is not None and run.seconds else None,
        pictures=list(_pictures(project, done)),
        differences=list(_differences(project, done)),
        steps={step.name: _row(project, step, steps.get(step.name)) for step in STEPS},
        again=project.command(
            "all", project.captures, project.out, table=project.table, **project.options
        ),
    )


def _scores(run: RunRecord) -> Iterator[tuple[str, list[str]]]:
    """Yield label and scores of each period, and the means over periods."""
    rows = [(label, run.periods.get(number, {})) for number, label in run.period_labels.items()]
    for label, values in [*rows, ("mean", run.aggregates["macro"])]:
        texts = {name: f"{values[name]:.{METRICS[name][1]}f}" for name in METRICS.keys() & values}
        yield label, [texts.get(name, "-") for name in METRICS]


def _pictures(project: Project, done: Mapping[str, StepRecord]) -> Iterator[tuple[str, str]]:
    """Yield the label of each date, and a picture of the model at it."""
    if "page" in done:
        labels = [period["label"] for period in project.certificate["periods"]]
        for label, path in zip(labels, done["page"].results[1:], strict=True):
            with Image.open(project.out / path) as image:
                yield label, data_uri(image, form="webp")


def _differences(project: Project, done: Mapping[str, StepRecord]) -> Iterator[str]:
    """Yield the pictures of the differences of elevations."""
    for path in done["survey"].results if "survey" in done else ():
        if path.endswith(".png"):
            with Image.open(project.out / path) as image:
                yield data_uri(image, form="webp")


def _row(project: Project, step: Step, record: StepRecord | None) -> dict[str, Any]:
    """Describe a step for the page."""
    if record is None:
        return {"what": step.what, "state": "not done", "files": []}
    sizes = [(path, (project.out / path).stat().st_size) for path in record.results]
    return {
        "what": step.what,
        "state": record.state,
        "time": format_time(record.seconds),
        "reason": record.reason,
        "files": [(path, in_words(size)) for path, size in sizes],
        "command": step.command(project) if record.state == "done" else None,
    }
