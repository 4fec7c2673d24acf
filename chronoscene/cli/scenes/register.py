"""``chronoscene register``: captures of several dates in one frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from chronoscene.cli.options import EXISTING_FILE, PATH, TABLE, FiniteRange, refuse_options
from chronoscene.cli.output import check_place, emit, showing_notes
from chronoscene.cli.progress import progress_bar
from chronoscene.errors import ConfigError
from chronoscene.formats import read_scene
from chronoscene.geodesy import read_projected
from chronoscene.io.staging import check_outside
from chronoscene.registration.context import CALIBRATIONS, Options
from chronoscene.registration.features.camera_groups import AUTO, FEW, MANY, MIN_PHOTOS
from chronoscene.registration.output import LOG, Inspection
from chronoscene.registration.photos.captures import photo_folders, read_captures
from chronoscene.registration.pipeline import run
from chronoscene.registration.reconstruct.estimation import same_positions
from chronoscene.registration.result import ROUTES, Registered

DEFAULTS = Options()

FAILED = 1  # Exit status if a verdict is fail


@click.command("register")
@click.argument("captures", type=PATH)
@click.argument("out", type=PATH)
@TABLE
@click.option(
    "--into",
    "scene",
    type=PATH,
    help="Add CAPTURES as a new period to this scene, whose poses and cameras do not change.",
)
@click.option(
    "--route",
    type=click.Choice([r for r in ROUTES if r != "frozen"]),
    help="joint: all photos in one reconstruction; separate: one for each period, then aligned; "
    "resection: known cameras placed by control points, for few photos.  [default: joint if "
    "matches connect all periods]",
)
@click.option(
    "--work",
    type=PATH,
    help="Folder for features, matches and models, from which a later run continues.  "
    "[default: OUT.work]",
)
@click.option("--overwrite", is_flag=True, help="Replace an earlier registration at OUT.")
@click.option(
    "--max-image-size",
    type=click.IntRange(200),
    default=DEFAULTS.max_image_size,
    help="Pixels; larger photos are downscaled for feature extraction.",
)
@click.option(
    "--max-features",
    type=click.IntRange(100),
    default=DEFAULTS.max_features,
    help="Keep at most this many features of each photo.",
)
@click.option(
    "--exhaustive-limit",
    type=click.IntRange(0),
    default=DEFAULTS.exhaustive_limit,
    help="Match all pairs if there are at most this many photos, else likely pairs.",
)
@click.option(
    "--held-out",
    type=FiniteRange(0, 0.5),
    default=DEFAULTS.held_out,
    help="Share of the tracks across periods that are used only to test the result.",
)
@click.option(
    "--cameras",
    type=EXISTING_FILE,
    help="Known calibrations. Each line has a pattern of photo names as in OUT (with _ for blanks, "
    "and .png where photos are converted), then model, width, height and parameters as in COLMAP's "
    "cameras.txt. --route resection keeps them, others refine them.",
)
@click.option(
    "--camera-model",
    type=click.Choice([AUTO, "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]),
    default=DEFAULTS.camera_model,
    help=f"Camera model of COLMAP that is fitted to the photos; auto: {MANY} for a camera with at "
    f"least {MIN_PHOTOS} photos, else {FEW}.",
)
@click.option(
    "--calibration",
    type=click.Choice(CALIBRATIONS),
    default=DEFAULTS.calibration,
    help="per-period: a calibration of each camera for each period. shared: one for all periods. "
    f"auto: one for each period that has at least {MIN_PHOTOS} of its photos and is more than a "
    "day from the others.",
)
@click.option(
    "--threads",
    type=click.IntRange(1),
    help="With 1, every run gives bit-identical results.  [default: one per processor]",
)
@click.option(
    "--features",
    help="Features in place of SIFT: features.h5 of hloc, a database of COLMAP, or an installed "
    "extractor.",
)
@click.option(
    "--matches",
    help="Matches of these features: matches.h5 of hloc, a database of COLMAP, or an installed "
    "matcher.  [default: those of a database, else mutual nearest neighbours]",
)
@click.option(
    "--tie-points",
    type=EXISTING_FILE,
    help="CSV of point, image, x, y and optional world coordinates X, Y, Z and role (control or "
    "check), or ODM's gcp_list.txt. The points check the alignment, replace an alignment that "
    "failed, and place the model in the world.",
)
@click.option(
    "--crs",
    help="Projected reference system of the coordinates that are written, such as EPSG:32632; also "
    "of tie points whose file names none.  [default: that of the tie points]",
)
@click.option(
    "--tie-scale",
    type=FiniteRange(0, min_open=True),
    default=DEFAULTS.tie_scale,
    help="Size of these photos divided by that of the photos in which the tie points were clicked.",
)
@click.option(
    "--report",
    "page",
    is_flag=True,
    help="Also write registration.html, a page to inspect the result.",
)
@click.pass_context
def command(
    context: click.Context,
    captures: Path,
    out: Path,
    table: Path | None,
    scene: Path | None,
    **settings: Any,
) -> None:
    """Register photos of several dates in one frame.

    CAPTURES is a folder with a subfolder of photos for each period; or a folder of photos, whose
    periods are proposed from their dates; or a CSV of image and period. OUT is the new scene.
    Masks lie in masks/ beside the folder of photos: masks/2016/x.jpg.png for 2016/x.jpg, 0 where
    the photo does not count. The same command continues a run that was stopped.

    There are two verdicts: on the alignment of the periods with each other, and on the absolute
    position. Exit status: 0 if both are pass, doubtful or not checked, 1 if either is fail (the
    scene is written nevertheless), 2 if the photos cannot be registered or the usage is wrong.
    """
    kept = [*photo_folders(captures, table), *([] if scene is None else [scene])]
    options = Options(**settings)
    _check_together(options, scene)
    for option, place in (("OUT", out), ("--work", options.work or options.work_folder(out))):
        check_outside(place, kept, option=option)
        _check_not_around(place, kept, option)
        check_place(option, place)
    inspections: list[Inspection] = []
    with showing_notes(), progress_bar(f"read {captures}") as report:
        found = read_captures(captures, table=table)
        registered = run(
            found,
            out,
            options,
            into=None if scene is None else read_scene(scene),
            report=report,
            inspected=inspections.append,
        )
    text = summary(registered, out, options.crs) + "".join(i.summary for i in inspections)
    emit(text + "".join(f"note: {note}\n" for note in found.notes))
    if any(i.failed for i in inspections):
        context.exit(FAILED)


def _check_not_around(place: Path, folders: list[Path], option: str) -> None:
    """Refuse a folder that has photos in it, as what it holds is replaced.

    Raises:
        ConfigError: If it has.
    """
    for folder in folders:
        if folder.resolve().is_relative_to(place.resolve()):
            raise ConfigError(
                f"{option} {place}",
                expected="a folder of its own",
                found=f"{folder} in it",
                todo="choose another folder: what it holds is replaced",
            )


def _check_together(options: Options, scene: Path | None) -> None:
    """Refuse options that others, or their absence, make ineffective.

    Raises:
        ConfigError: If there are such options.
    """
    for names, applies, condition in (
        (("route", "calibration"), scene is not None, "with --into"),
        (("calibration", "camera_model"), options.cameras is not None, "with --cameras"),
        (("max_image_size", "max_features"), options.features is not None, "with --features"),
        (("exhaustive_limit",), Path(options.matches or "").is_file(), "with a file of --matches"),
        (("tie_scale",), options.tie_points is None, "without --tie-points"),
    ):
        if applies:
            refuse_options(names, condition)


def summary(registered: Registered, out: Path, crs: str | None) -> str:
    """The result in a few lines."""
    lines = [f"{out}: route {registered.route}, unit {registered.unit}"]
    for count in registered.counts():
        placed, photos = count["registered"], count["photos"]
        name = f"period {count['period']} ({count['label']})"
        lines.append(f"  {name}: {placed} of {photos} photos registered")
    for name, reason in sorted(registered.unregistered.items())[:10]:
        lines.append(f"  {name}: {reason}")
    if len(registered.unregistered) > 10:
        lines.append(f"  ... and {len(registered.unregistered) - 10} more; see {LOG}")
    lines.append(f"{len(registered.points)} points triangulated; decisions in {out / LOG}")
    if registered.route == "frozen" and (
        again := same_positions(registered, registered.num_periods - 1)
    ):
        lines.append(f"note: {again[0]}" + (f" ({len(again)} like this)" if again[1:] else ""))
    if crs is not None:
        if registered.georeference is None:
            lines.append(
                f"no coordinates in {crs}: neither GPS nor ground control places the model"
            )
        else:
            frame = registered.georeference
            remarks = read_projected("--crs", crs).remarks_at(frame.latitude, frame.longitude)
            lines += [f"note: {remark}" for remark in remarks]
    return "\n".join(lines) + "\n"
