"""``chronoscene undistort``: a scene whose cameras are all PINHOLE."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from chronoscene.cli.options import PATH, reading_options
from chronoscene.cli.output import emit
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.scenes.reading import LINKS, describe, read_and_note, show_note
from chronoscene.convert import remarks_on
from chronoscene.images.undistortion import CameraChange
from chronoscene.io.staging import check_outside
from chronoscene.io.wording import counted
from chronoscene.registration.output import copy_records
from chronoscene.scene.splits import split_hash
from chronoscene.undistort import Undistortion, undistort


@click.command("undistort")
@click.argument("source", type=PATH, metavar="SCENE")
@click.argument("out", type=PATH)
@click.option(
    "--center", is_flag=True, help="Crop the images so that the principal point is in their centre."
)
@click.option(
    "--threads",
    type=click.IntRange(1),
    help="Number of images processed at the same time.  [default: one per processor]",
)
@click.option(
    "--link",
    type=click.Choice(["hard", "sym"]),
    help="Link images that do not change instead of copying them.",
)
@reading_options("SCENE")
def command(
    source: Path,
    out: Path,
    center: bool,
    threads: int | None,
    link: str | None,
    dataset_format: str | None,
    period_by: str | None,
) -> None:
    """Undistort the images of a scene.

    OUT is a new folder in the ChronoScene format; SCENE is not changed. All cameras become PINHOLE.
    Observations of points move with the images; poses, periods and split do not change. Images of
    cameras without distortion are copied; others become 8-bit RGB, and transparent pixels become a
    mask.
    """
    check_outside(out, [source], option="OUT")
    with progress_bar(f"read {source}") as bar:
        scene = read_and_note(source, dataset_format, period_by)
        done = undistort(
            scene,
            out,
            center=center,
            threads=threads,
            image_source=LINKS[link],
            progress=partial(bar, "images"),
        )
    copied = copy_records(scene, out)
    emit(report(done))
    for note in remarks_on(scene, copied):
        show_note(note)


def report(done: Undistortion) -> str:
    """Sizes and losses, for people."""
    lines = [f"{done.scene.root}: {describe(done.scene)}"]
    lines += [f"  {_describe_change(change)}" for change in done.changes[:20]]
    if len(done.changes) > 20:
        lines.append(f"  ... and {len(done.changes) - 20} more cameras")
    if done.observations_lost:
        lines.append(
            f"dropped: {counted(done.observations_lost, 'observation')} outside of the new images, "
            f"and {counted(done.points_lost, 'point')} without any other"
        )
    lines.append(f"split hash {split_hash(done.scene)}")
    return "\n".join(lines) + "\n"


def _describe_change(change: CameraChange) -> str:
    source, target = change.source, change.target
    fx, fy, cx, cy = target.params
    what = "images unchanged" if change.is_copy else "images resampled"
    return (
        f"camera {target.camera_id}: {source.model} {source.width} x {source.height} -> PINHOLE "
        f"{target.width} x {target.height}, f {fx:.2f} {fy:.2f}, c {cx:.2f} {cy:.2f}; {what}"
    )
