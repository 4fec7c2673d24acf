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
from chronoscene.formats import writable_formats
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
def command(
    source: Path,
    out: Path,
    dataset_format: str | None,
    period_by: str | None,
    target: str,
    link: str | None,
) -> None:
    """Convert a scene to another format.

    SRC is a scene in any supported format; it is not changed. OUT is a new folder, which appears
    complete or not at all. Notes list what the target format cannot hold. DATASET.md describes the
    formats.
    """
    with progress_bar(f"read {source}") as bar:
        done = convert(
            source,
            out,
            source_format=dataset_format,
            target=target,
            period_by=period_by,
            image_source=LINKS[link],
            progress=partial(bar, "images"),
        )
    scene = done.scene
    lines = [f"{out}: {target} from {scene.format}, {describe(scene)}"]
    lines += [f"  {describe_period(scene, period.id)}" for period in scene.periods]
    lines.append(f"split: {scene.split_rule}; hash {split_hash(scene)}")
    emit("\n".join(lines) + "\n", None)
    for warning in done.warnings:
        show_note(warning)
