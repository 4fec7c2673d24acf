"""``chronoscene convert``: a scene of any format in another one."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from chronoscene.cli.options import LINK, PATH, reading_options
from chronoscene.cli.output import emit
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.scenes.reading import LINKS, describe, describe_period, show_note
from chronoscene.convert import convert
from chronoscene.errors import ConfigError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import read_scene, writable_formats
from chronoscene.geodesy import Georeference, from_crs, read_projected
from chronoscene.io.staging import check_outside
from chronoscene.registration.output import copy_records
from chronoscene.registration.report.coordinates import (
    coordinate_files,
    local_frame,
    write_coordinates,
)
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash


@click.command("convert")
@click.argument("source", type=PATH, metavar="SRC")
@click.argument("out", type=PATH)
@reading_options("SRC")
@click.option(
    "--to",
    "target",
    type=click.Choice(writable_formats()),
    default="chronoscene",
    help="Format of OUT.",
)
@LINK
@click.option(
    "--crs",
    help="Also write cameras.csv and points.ply in this projected reference system, such as "
    "EPSG:32632, for a scene that is georeferenced.",
)
def command(
    source: Path,
    out: Path,
    dataset_format: str | None,
    period_by: str | None,
    target: str,
    link: str | None,
    crs: str | None,
) -> None:
    """Convert a scene to another format.

    SRC is a scene in any supported format; it is not changed. OUT is a new folder, which appears
    complete or not at all. Notes list what the target format cannot hold. DATASET.md describes the
    formats.
    """
    system = None if crs is None else read_projected("--crs", crs)
    check_outside(out, [source], option="OUT")

    def add(scene: Scene) -> tuple[str, ...]:
        copied = copy_records(scene, out) if target == our_format.NAME else ()
        return copied if system is None else (*copied, *coordinate_files())

    with progress_bar(f"read {source}") as bar:
        done = convert(
            source,
            out,
            source_format=dataset_format,
            target=target,
            period_by=period_by,
            image_source=LINKS[link],
            progress=partial(bar, "images"),
            check=None if system is None else _local_frame,
            add=add,
        )
    # OUT may have other names of images and another split than SRC.
    scene = read_scene(out, format=target)
    notes = list(done.warnings)
    if system is not None:
        frame = _local_frame(done.scene)
        write_coordinates(out, scene, frame, system)
        notes += system.remarks_at(frame.latitude, frame.longitude)
    lines = [f"{out}: {target} from {done.scene.format}, {describe(scene)}"]
    lines += [f"  {describe_period(scene, period.id)}" for period in scene.periods]
    lines.append(f"split: {scene.split_rule}; hash {split_hash(scene)}")
    emit("\n".join(lines) + "\n")
    for note in notes:
        show_note(note)


def _local_frame(scene: Scene) -> Georeference:
    """Return the local frame of a registration that a scene is in.

    Raises:
        ConfigError: If it is in another system, or in none.
    """
    world = scene.world
    frame = from_crs(world.crs)
    if frame is not None and not any(world.offset):
        return local_frame(scene) or frame  # without metres, its kind of heights is not known
    found, todo = "one without a reference system", "register it with GPS or ground control"
    if world.crs is not None:
        found = f"{world.crs} with the offset {', '.join(f'{x:.12g}' for x in world.offset)}"
        todo = "add the offset to the coordinates of the scene: the sums are in that system"
    raise ConfigError(
        "--crs",
        expected="a georeferenced scene in the local frame of register, without an offset",
        found=found,
        todo=todo,
    )
