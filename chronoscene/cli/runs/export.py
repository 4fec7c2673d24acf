"""``chronoscene export``: Gaussians of a finished run in files for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import DEVICE, PATH, PLUGIN, RUN, SCENE, STAGE
from chronoscene.cli.output import check_file, check_place, emit, report_written, say
from chronoscene.errors import ConfigError
from chronoscene.harness.use.export import make_file, period_files, prepare
from chronoscene.harness.use.trained_run import TrainedRun, open_run
from chronoscene.io.staging import replacing, staged_folder
from chronoscene.scene import Scene
from chronoscene.splat_files import SUFFIXES

ALL = "all"


@click.command("export")
@RUN
@click.option("--period", required=True, help="Period to export: number, label, fraction, or all.")
@click.option(
    "--out",
    type=PATH,
    required=True,
    help="File to write; with --period all, a new folder for a file per period.",
)
@click.option(
    "--to",
    "kind",
    type=click.Choice(list(SUFFIXES)),
    help="Format.  [default: by the end of --out; ply with --period all]",
)
@click.option(
    "--for",
    "viewers",
    type=click.Choice(["plain", "antialiased"]),
    help="Viewers without or with the antialiasing filter of the training.  [default: plain, "
    "unless that loses 0.3 dB or more on the training views]",
)
@SCENE
@STAGE
@PLUGIN
@DEVICE
def command(
    folder: Path,
    period: str,
    out: Path,
    kind: str | None,
    viewers: str | None,
    scene: Path | None,
    stage: int | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Export periods of a finished run as Gaussians.

    RUN is the folder of the run, such as runs/plaza/chronogs-joint-balanced/seed0. Files are in the
    world frame of the scene, as PLY (of 3DGS), SPZ, SOG, SPLAT or glTF (.glb). What depends on the
    direction of view is fitted to the training views. Each file is read back, and the PSNR that it
    costs on the test views is printed.
    """
    run = open_run(folder, device=device, plugin=plugin, stage=stage)
    kind = _format_of(out, kind, a_folder=period == ALL)
    scenes = [Path(run.source.scene_root), *([scene] if scene else [])]
    if period != ALL:
        check_file("--out", out, outside=scenes)
        wanted = run.parse_period(period)
        data = _make(run, _read_scene(run, scene), wanted, period, kind, viewers)
        with replacing(out) as partial:
            partial.write_bytes(data)
    else:
        check_place("--out", out, outside=scenes)
        read = _read_scene(run, scene)
        with staged_folder(out) as staged:
            labels = run.record.period_labels
            for number, name in period_files(labels, kind).items():
                data = _make(run, read, float(number), labels[str(number)], kind, viewers)
                (staged / name).write_bytes(data)
    report_written(out)


def _read_scene(run: TrainedRun, root: Path | None) -> Scene:
    say("read the scene")
    return run.scene(root)


def _make(
    run: TrainedRun, scene: Scene, period: float, name: str, kind: str, viewers: str | None
) -> bytes:
    """Make the file of a period; print what it holds and what it loses."""
    say(f"export period {name}")
    prepared = prepare(run, scene, period, viewers)
    say(f"write and measure period {name}")
    made = make_file(run, scene, period, prepared, kind)
    size = f"{len(made.data) / 1e6:.2f} MB"
    lines = [f"{len(prepared.cloud):,} Gaussians of period {name}, {size}", *made.comments[1:]]
    emit("\n".join(lines) + "\n")
    return made.data


def _format_of(out: Path, kind: str | None, *, a_folder: bool) -> str:
    """Return the format that --to or the end of --out names.

    Raises:
        ConfigError: If neither does, or they disagree.
    """
    kinds = {suffix: name for name, suffix in SUFFIXES.items()}
    by_name = kinds.get(out.suffix.lower())
    if a_folder:
        if by_name is None:
            return kind or "ply"
        found, expected, todo = "a file", "a folder, for a file per period", "name a folder"
    elif by_name is not None and kind in (None, by_name):
        return by_name
    else:
        found = f"{out.suffix or 'no end'}{f' with --to {kind}' if kind else ''}"
        expected = f"a file that ends in {SUFFIXES[kind] if kind else ', '.join(kinds)}"
        todo = "choose another name" if kind else "name the format by the end of the file"
    raise ConfigError(f"--out {out}", expected=expected, found=found, todo=todo)
