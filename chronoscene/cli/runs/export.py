"""``chronoscene export``: Gaussians of a finished run in a file for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import DEVICE, FILE, PLUGIN, RUN, SCENE, STAGE
from chronoscene.cli.output import check_file, emit, report_written
from chronoscene.cli.progress import announce
from chronoscene.formats.shared.gaussian_ply import write_gaussians
from chronoscene.harness.use.export import measure_loss
from chronoscene.harness.use.trained_run import open_run
from chronoscene.io.staging import check_outside
from chronoscene.io.wording import counted


@click.command("export")
@RUN
@click.option("--period", required=True, help="Period to export: number, label or fraction.")
@click.option("--out", type=FILE, required=True, help="PLY file to write.")
@SCENE
@STAGE
@PLUGIN
@DEVICE
def command(
    folder: Path,
    period: str,
    out: Path,
    scene: Path | None,
    stage: int | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Export a period of a finished run as Gaussians.

    RUN is the folder of the run, such as runs/plaza/chronogs-joint-balanced/seed0. The file is a
    PLY file as 3DGS writes it, in the world frame of the scene. What depends on the direction of
    view is fitted to the training views; the PSNR that this costs on the test views is printed.
    """
    run = open_run(folder, device=device, plugin=plugin, stage=stage)
    check_outside(out, [Path(run.source.scene_root), *([scene] if scene else [])], option="--out")
    check_file("--out", out)
    wanted = run.parse_period(period)
    announce("read the scene")
    trained_on = run.scene(scene)
    announce("export")
    gaussians = run.gaussians(wanted, scene=trained_on)
    write_gaussians(out, gaussians)
    announce("measure")
    loss = measure_loss(run, trained_on, wanted, gaussians)
    lines = [f"{len(gaussians):,} Gaussians of period {period}"]
    if loss is None:
        lines.append("PSNR lost: not measured, as no test photo shows this period")
    else:
        lost = round(loss.model - loss.exported, 2) + 0.0  # never -0.00
        pair = f"{loss.model:.2f} dB, exported {loss.exported:.2f} dB"
        lines.append(f"PSNR on {counted(loss.views, 'test view')}: {pair}: {lost:.2f} dB lost")
    if getattr(run.config, "exposure", "none") != "none":
        lines.append(
            "The exposure is in the colours; where the background shows, a viewer lacks it"
        )
    if getattr(run.config, "antialiased", False):
        lines.append("Switch on the antialiasing (Mip-Splatting) of the viewer, as in training")
    emit("\n".join(lines) + "\n", None)
    report_written(out)
