"""``chronoscene render``: pictures of a finished run, from any camera at any period."""

from __future__ import annotations

from mimetypes import guess_type
from pathlib import Path

import click

from chronoscene.cli.options import (
    DEVICE,
    IMAGE_SIZE,
    PATH,
    PLUGIN,
    RUN,
    SCENE,
    STAGE,
    FiniteFloat,
    FiniteRange,
    refuse_options,
)
from chronoscene.cli.output import check_file, check_place, report_written
from chronoscene.cli.progress import tracked
from chronoscene.errors import ConfigError
from chronoscene.harness.use.cameras import VIEWS, OrbitShape, find_viewpoints, with_periods
from chronoscene.harness.use.rendering import (
    check_viewpoints,
    is_animation,
    render_viewpoints,
    write_pictures,
)
from chronoscene.harness.use.trained_run import open_run
from chronoscene.kernels.runtime import keep_freed_memory


@click.command("render")
@RUN
@click.option(
    "--out",
    type=PATH,
    required=True,
    help="New folder for PNG files, or an animation (.mp4 or .webp).",
)
@click.option(
    "--cameras",
    default="test",
    help=f"{', '.join(VIEWS)}, the folder of a COLMAP model, or a JSON camera path of nerfstudio. "
    "Poses are in the world of the scene; those of a camera path beside dataparser_transforms.json "
    "are in the frame of that model.",
)
@click.option(
    "--period",
    help="Period (number, label or fraction), or a range FROM:TO, through which an orbit or path "
    "passes once; any other camera stands still meanwhile.  [default: the period of each camera]",
)
@click.option("--appearance-period", help="Show the geometry in the colours of this period.")
@click.option(
    "--frames",
    type=click.IntRange(min=1),
    default=120,
    help="Number of pictures of an orbit or a range of periods.",
)
@click.option(
    "--fps",
    type=FiniteRange(min=0.1, max=240),
    default=24,
    help="Pictures per second of an animation.",
)
@click.option(
    "--size",
    type=IMAGE_SIZE,
    metavar="WIDTHxHEIGHT",
    help="Pixels of the pictures of an orbit.  [default: the size of the evaluation]",
)
@click.option(
    "--radius",
    type=FiniteRange(min=0, min_open=True),
    help="Level distance of an orbit from the middle of the sparse points, in units of the scene.",
)
@click.option(
    "--height",
    type=FiniteFloat(),
    help="Height of an orbit above the middle of the sparse points, in units of the scene.",
)
@SCENE
@STAGE
@PLUGIN
@DEVICE
def command(
    folder: Path,
    out: Path,
    cameras: str,
    period: str | None,
    appearance_period: str | None,
    frames: int,
    fps: float,
    size: tuple[int, int] | None,
    radius: float | None,
    height: float | None,
    scene: Path | None,
    stage: int | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Render a finished run from any camera.

    RUN is the folder of the run, such as runs/plaza/chronogs-joint-balanced/seed0. An orbit circles
    the middle of the sparse points, at the height and distance of the cameras unless others are
    given.
    """
    keep_freed_memory()  # arrays as large as those of the picture before
    run = open_run(folder, device=device, plugin=plugin, stage=stage)
    scenes = [Path(run.source.scene_root), *([scene] if scene else [])]
    if is_animation(out):
        check_file("--out", out, outside=scenes)
    elif (guess_type(out)[0] or "").startswith(("image/", "video/")):
        raise ConfigError(
            "--out",
            expected="a folder, or a file that ends in .mp4 or .webp",
            found=str(out),
            todo="choose one of them",
        )
    else:
        refuse_options(("fps",), "for a folder of pictures")
        check_place("--out", out, outside=scenes)
    periods = () if period is None else run.parse_periods(period)
    appearance = None if appearance_period is None else run.parse_period(appearance_period)
    found = find_viewpoints(cameras, run, scene, frames, OrbitShape(size, radius, height))
    if cameras != "orbit" and (found.is_path or len(periods) < 2):
        refuse_options(("frames",), "where cameras and periods give the number of pictures")
    viewpoints = with_periods(found, run, periods, frames)
    check_viewpoints(run, viewpoints, out, appearance)
    images = render_viewpoints(run, viewpoints, appearance_period=appearance)
    names = (viewpoint.name for viewpoint in viewpoints)
    write_pictures(out, names, tracked(images, "render", total=len(viewpoints)), fps=fps)
    report_written(out)
