"""``chronoscene page``: a page to walk through finished runs while turning the years."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import DEVICE, FOLDER, PATH, PLUGIN, SCENE, FiniteRange
from chronoscene.cli.output import check_place, emit, report_written, say
from chronoscene.cli.progress import progress_bar
from chronoscene.harness.use.page import PageSummary, check_runs, chosen_periods, write_page
from chronoscene.harness.use.trained_run import open_run
from chronoscene.io.wording import counted


@click.command("page")
@click.argument("folders", metavar="RUN...", nargs=-1, required=True, type=PATH)
@click.option("--out", type=FOLDER, required=True, help="New folder for the page.")
@click.option(
    "--period", help="Period (number or label), or range FROM:TO, to show.  [default: all]"
)
@click.option(
    "--max-megabytes",
    type=FiniteRange(min=0, min_open=True),
    default=25,
    help="Size of the folder. Photos of training views are left out first, then spherical "
    "harmonics, then the faintest Gaussians.",
)
@SCENE
@PLUGIN
@DEVICE
def command(
    folders: tuple[Path, ...],
    out: Path,
    period: str | None,
    max_megabytes: float,
    scene: Path | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Make a page to walk through finished runs of a scene.

    RUN is the folder of a run, such as runs/plaza/chronogs-joint-balanced/seed0; with several runs
    of a scene, the page compares methods. Open index.html in the new folder: it needs no server
    and no network.
    """
    runs = [open_run(folder, device=device, plugin=plugin) for folder in folders]
    check_runs(runs)
    scenes = [Path(runs[0].source.scene_root), *([scene] if scene else [])]
    check_place("--out", out, outside=scenes)
    periods = chosen_periods(runs[0], period)
    say("read the scene")
    trained_on = runs[0].scene(scene)
    with progress_bar() as report:
        summary = write_page(
            runs, out, trained_on, periods, max_bytes=1e6 * max_megabytes, report=report
        )
    emit(_text(summary))
    report_written(summary.path)


def _text(summary: PageSummary) -> str:
    lines = []
    for packed in summary.packed:
        total = sum(packed.periods)
        lines.append(
            f"{total:,} Gaussians of {counted(len(packed.periods), 'period')}: {packed.stored:,} "
            f"stored, with {packed.centres:,} centres"
        )
    rest = summary.total - summary.gaussians - summary.photos
    parts = {"Gaussians": summary.gaussians, "photos": summary.photos, "viewer": rest}
    sizes = ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in parts.items())
    lines.append(f"{summary.total / 1e6:.1f} MB: {sizes}")
    if str(summary.reduction):
        lines.append(f"To keep --max-megabytes, left out: {summary.reduction}")
    if summary.missing_photos:
        lines.append(
            f"To keep --max-megabytes, left out: {counted(summary.missing_photos, 'photo')}"
        )
    return "\n".join(lines) + "\n"
