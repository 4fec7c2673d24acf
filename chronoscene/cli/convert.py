"""``chronoscene convert``: a scene of any format in another one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from chronoscene.cli.output import emit
from chronoscene.cli.progress import progress_bar
from chronoscene.convert import convert
from chronoscene.formats import format_names, load_format, model_notes, read_scene, writable_formats
from chronoscene.images.store import ImageSource
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash

LINKS: dict[str | None, ImageSource] = {None: "copy", "hard": "link", "sym": "symlink"}


def _period_help() -> str:
    known = {name: getattr(load_format(name), "PERIOD_BY", ()) for name in format_names()}
    rules = "; ".join(f"{name}: {', '.join(by)}" for name, by in known.items() if by)
    return f"How images are grouped into periods, where the format leaves a choice. {rules}."


def reading_options(scene: str) -> Callable[[Any], Any]:
    """The options ``--dataset-format`` and ``--period-by`` of a command that reads scenes."""
    help = f"Format of {scene}.  [default: detected]"
    format_option = click.option("--dataset-format", type=click.Choice(format_names()), help=help)
    period_option = click.option("--period-by", metavar="RULE", help=_period_help())
    return lambda command: format_option(period_option(command))


@click.command("convert")
@click.argument("source", type=click.Path(path_type=Path), metavar="SRC")
@click.argument("out", type=click.Path(path_type=Path))
@reading_options("SRC")
@click.option(
    "--to",
    "target",
    type=click.Choice(writable_formats()),
    default="chronoscene",
    show_default=True,
    help="Format of OUT.",
)
@click.option(
    "--link", type=click.Choice(["hard", "sym"]), help="Link the images instead of copying them."
)
def command(
    source: Path,
    out: Path,
    dataset_format: str | None,
    period_by: str | None,
    target: str,
    link: str | None,
) -> None:
    """Write the scene SRC in another format to the new folder OUT.

    SRC may have any supported format, and is not changed. OUT appears complete or not at all. Notes
    say what the target format cannot hold. DATASET.md describes the formats.
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
        say_note(warning)


def read_and_note(source: Path, dataset_format: str | None, period_by: str | None) -> Scene:
    """Read a scene; a model in an unusual place is said."""
    scene = read_scene(source, format=dataset_format, period_by=period_by)
    for note in model_notes(source, scene.format):
        say_note(note)
    return scene


def say_note(note: str) -> None:
    """One line on standard error."""
    click.secho(f"note: {note}", fg="yellow", err=True)


def describe(scene: Scene) -> str:
    """Counts of a scene on one line."""
    cameras = len({frame.camera.camera_id for frame in scene.frames})
    counts = (
        (len(scene.frames), "image"),
        (cameras, "camera"),
        (len(scene.points), "point"),
        (scene.num_periods, "period"),
    )
    return ", ".join(f"{n} {what}{'s' * (n != 1)}" for n, what in counts)


def describe_period(scene: Scene, period: int) -> str:
    """Label and counts of a period on one line."""
    train = len(scene.select(split="train", period=period))
    test = len(scene.select(split="test", period=period))
    label = scene.periods[period].label
    name = f"period {period}" + (f" ({label})" if label != str(period) else "")
    return f"{name}: {train} train, {test} test"
