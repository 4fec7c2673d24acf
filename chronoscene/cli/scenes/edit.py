"""``chronoscene edit``: a scene without some images, periods or points, or with other names."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import click

from chronoscene.cli.options import LINK, PATH, parse_assignments, reading_options
from chronoscene.cli.output import check_place, emit
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.scenes.reading import LINKS, describe, describe_period, show_note
from chronoscene.convert import obstacles, remarks_on
from chronoscene.edit import MIN_VIEWS, Box, Edited, Edits, edit, read_for_edit
from chronoscene.errors import ConfigError
from chronoscene.formats import detect
from chronoscene.io.wording import counted
from chronoscene.registration.output import CERTIFICATE, copy_records
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash


@click.command("edit")
@click.argument("source", type=PATH, metavar="SCENE")
@click.argument("out", type=PATH)
@click.option("--drop", metavar="IMAGES", multiple=True,
              help="Leave out an image, or all that match a pattern such as 'a/*.jpg'. "
              "May be repeated.")  # fmt: skip
@click.option("--drop-period", "drop_periods", metavar="PERIOD", multiple=True,
              help="Leave out a period, given by label or id. May be repeated.")  # fmt: skip
@click.option("--keep", metavar="IMAGES", multiple=True,
              help="Leave out all images but these. May be repeated.")  # fmt: skip
@click.option("--keep-period", "keep_periods", metavar="PERIOD", multiple=True,
              help="Leave out all periods but these. May be repeated.")  # fmt: skip
@click.option("--crop", metavar="XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX",
              help="Leave out the points outside of this box in the world of the scene, and images "
              "that see points, but none in it.")  # fmt: skip
@click.option("--rename", metavar="OLD=NEW", multiple=True,
              help="Give a period (label or id) another label, or an image another name. Periods "
              "that get the same label are merged. May be repeated.")  # fmt: skip
@LINK
@reading_options("SCENE")
def command(
    source: Path,
    out: Path,
    drop: tuple[str, ...],
    drop_periods: tuple[str, ...],
    keep: tuple[str, ...],
    keep_periods: tuple[str, ...],
    crop: str | None,
    rename: tuple[str, ...],
    link: str | None,
    dataset_format: str | None,
    period_by: str | None,
) -> None:
    """Drop images, periods or points; rename periods or images.

    OUT is a new folder in the ChronoScene format; SCENE is not changed. An image stays if all
    options allow it. If a period is left out, the others are renumbered. The split of the remaining
    images, their poses and masks, and the labels and dates of the periods stay. A point that loses
    observations with dropped images is removed if fewer than two are left.
    """
    edits = Edits(
        keep=keep,
        drop=drop,
        keep_periods=keep_periods,
        drop_periods=drop_periods,
        crop=None if crop is None else parse_box(crop),
        rename=parse_assignments(rename, "--rename"),
    )
    if edits == Edits():
        raise click.UsageError("give something to do: --drop, --keep, --crop, --rename, ...")
    check_place("OUT", out, outside=[source])
    with progress_bar(f"read {source}") as bar:
        detected = detect(source, format=dataset_format, period_by=period_by)
        scene, left, images, points = read_for_edit(detected, edits)
        done = edit(scene, out, left, image_source=LINKS[link], progress=partial(bar, "images"))
    done = replace(  # with what was left out when the scene was read
        done, images_dropped=done.images_dropped + images, points_unseen=done.points_unseen + points
    )
    copied = copy_records(scene, out, certificate=not done.renamed)
    emit(report(done))
    notes = [*detected.notes]
    if done.renamed and (scene.root / CERTIFICATE).is_file():
        notes.append(
            f"{CERTIFICATE} is not copied: a certificate does not describe a scene whose periods "
            "or images have other names"
        )
        copied = (*copied, CERTIFICATE)  # one note on it is enough
    for note in (*notes, *remarks_on(scene, copied), *obstacles(done.scene), *_poor(done.scene)):
        show_note(note)


def parse_box(text: str) -> Box:
    """Parse six numbers: the smallest corner of a box, then the largest.

    Raises:
        ConfigError: If the text is something else, or the box is empty.
    """
    try:
        x0, y0, z0, x1, y1, z1 = map(float, text.split(","))
    except ValueError:
        x0 = y0 = z0 = x1 = y1 = z1 = float("nan")
    if not (x0 <= x1 and y0 <= y1 and z0 <= z1):
        raise ConfigError(
            "--crop",
            expected="six numbers XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX, each minimum up to its maximum",
            found=repr(text),
            todo="write them with commas; with --crop=... if the first is negative",
        )
    return x0, y0, z0, x1, y1, z1


def report(done: Edited) -> str:
    """Sizes and losses, for people."""
    new = done.scene
    lines = [f"{new.root}: {describe(new)}"]
    lines += [f"  {describe_period(new, period.id)}" for period in new.periods]
    lines.append(f"{counted(done.images_dropped, 'image')} left out")
    if done.images_outside:
        lines[-1] += f", {done.images_outside} of them because they see nothing in the box"
    points = [
        f"{number} {why}"
        for number, why in (
            (done.points_outside, "outside of the box"),
            (done.points_unseen, f"with fewer than {MIN_VIEWS} observations left"),
        )
        if number
    ]
    lines.append(f"points left out: {', '.join(points) or 'none'}")
    lines.append(f"split hash {split_hash(new)}")
    return "\n".join(lines) + "\n"


def _poor(scene: Scene) -> list[str]:
    """List the periods that have no training image."""
    return [
        f"period {p.title} has no training images"
        for p in scene.periods
        if not scene.select(split="train", period=p.id)
    ]
