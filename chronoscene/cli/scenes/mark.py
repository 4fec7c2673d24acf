"""``chronoscene mark``: a page on which tie and control points are marked in photos."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import EXISTING_FILE, PATH, TABLE, FiniteRange, refuse_options
from chronoscene.cli.output import check_file, emit, say
from chronoscene.cli.progress import progress_bar
from chronoscene.errors import ConfigError
from chronoscene.geodesy import read_reference_system
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.wording import counted
from chronoscene.registration.photos.captures import photo_folders, read_captures
from chronoscene.registration.report.marking import marking_page
from chronoscene.registration.ties.tie_points import by_photo, read_tie_points


@click.command("mark")
@click.argument("captures", type=PATH)
@click.argument("page", type=PATH)
@TABLE
@click.option(
    "--tie-points",
    type=EXISTING_FILE,
    help="Points to start with, as register reads them; rows with a name and world coordinates "
    "only are points to be marked.",
)
@click.option(
    "--tie-scale",
    type=FiniteRange(0, min_open=True),
    default=1.0,
    help="Size of these photos divided by that of the photos in which the tie points were clicked.",
)
@click.option("--crs", help="Reference system of the tie points, if their file names none.")
@click.option(
    "--model",
    type=PATH,
    help="COLMAP model of these photos, such as OUT.work/model-joint of register: the page then "
    "shows epipolar lines and predicted places.",
)
@click.option(
    "--max-size",
    type=click.IntRange(200, 8000),
    default=1600,
    help="Pixels of the longer side of the photos in the page.",
)
def command(
    captures: Path,
    page: Path,
    table: Path | None,
    tie_points: Path | None,
    tie_scale: float,
    crs: str | None,
    model: Path | None,
    max_size: int,
) -> None:
    """Make a page to mark points in photos.

    CAPTURES is what register reads. PAGE is one HTML file with the photos in it: open it in a
    browser, mark points, and save points.csv, which register reads by --tie-points. Coordinates are
    in pixels of the original photos.
    """
    check_file("PAGE", page, outside=photo_folders(captures, table))
    system = None if crs is None else read_reference_system("--crs", crs, error=ConfigError)
    points = None
    if tie_points is None:
        refuse_options(("tie_scale", "crs"), "without --tie-points")
    else:
        points = read_tie_points(tie_points, scale=tie_scale, crs=system)
    with progress_bar(f"read {captures}") as report:
        read = read_captures(captures, table=table)
        found, names = read.images, [c.name for c in read.images]
        if points is not None:
            points = by_photo(points, {c.name: (c.width, c.height) for c in found})
        text = marking_page(
            found, points=points, model=model, max_size=max_size, title=page.stem, report=report
        )
    write_text_atomic(page, text)
    for name, _, reason in read.refused:
        say(f"note: {name} is not on the page: {reason}")
    for note in read.left_out:
        say(f"note: {note}")
    clicks = [] if points is None else [c.image for p in points.points for c in p.clicks]
    if others := [image for image in clicks if image not in names]:
        say(
            f"note: {counted(len(others), 'click')} in photos that are not in CAPTURES, such as "
            f"{others[0]!r}: the page does not show them, but saves them with the others"
        )
    emit(f"{page}: {len(found)} photos, {len(text) / 1e6:.1f} MB; open it in a browser\n")
