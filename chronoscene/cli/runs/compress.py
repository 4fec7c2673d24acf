"""``chronoscene compress``: a finished run in few bytes."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import DEVICE, PLUGIN, RUN, SCENE, FiniteRange, refuse_options
from chronoscene.cli.output import emit, report_written, say
from chronoscene.harness.files.records import read_run
from chronoscene.harness.use.compression import compress_run
from chronoscene.harness.use.trained_run import open_run


@click.command("compress")
@RUN
@click.option(
    "--max-loss",
    type=FiniteRange(min=0, max=100, min_open=True),
    default=0.1,
    help="Largest loss of PSNR on training views, in dB.",
)
@click.option("--plain", is_flag=True, help="Use half floats and LZMA only.")
@SCENE
@PLUGIN
@DEVICE
def command(
    folder: Path,
    max_loss: float,
    plain: bool,
    scene: Path | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Compress the model of a finished run.

    RUN is the folder of the run, such as runs/plaza/chronogs-joint-balanced/seed0. The compressed
    model becomes a run beside it, with its own scores and its own row in chronoscene table.
    """
    if plain:
        refuse_options(["max_loss"], "with --plain, which does not round to a loss")
    run = open_run(folder, device=device, plugin=plugin)
    say("read the scene")
    out = compress_run(run, run.scene(scene), max_loss=None if plain else max_loss, log=say)
    before, after = run.record, read_run(out)
    sizes = [record.checkpoint_bytes or 0 for record in (before, after)]
    lines = [f"{sizes[0]:,} bytes -> {sizes[1]:,} bytes, {sizes[1] / sizes[0]:.1%}"]
    lines += [
        f"{name} {old:.3f} -> {after.aggregates['macro'][name]:.3f} on test views"
        for name, old in before.aggregates.get("macro", {}).items()
        if name in after.aggregates["macro"]
    ]
    emit("\n".join(lines) + "\n")
    report_written(out)
