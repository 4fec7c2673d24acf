"""``chronoscene split``: choose the test images of a scene anew."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import click

from chronoscene.cli.options import PATH, reading_options, refuse_options
from chronoscene.cli.output import A_FILE, check_place, emit, say, writing_to
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.scenes.reading import describe_period, read_and_note, show_note
from chronoscene.convert import remarks_on
from chronoscene.edit import chosen_periods
from chronoscene.errors import ConfigError
from chronoscene.formats import chronoscene as our_format
from chronoscene.images.exif import capture_times
from chronoscene.io.staging import check_outside, write_text_atomic
from chronoscene.registration.output import copy_records
from chronoscene.scene.split_making import FRACTION, STRATEGIES, NewSplit, SplitSettings, make_split


@click.command("split")
@click.argument("source", type=PATH, metavar="SCENE")
@click.argument("out", type=PATH, required=False)
@click.option(
    "--strategy",
    type=click.Choice(STRATEGIES),
    default="stratified",
    help="How to choose. stratified: one of every 8 images in name order, in each period. blocked: "
    "all cameras in some blocks of space, the same in all periods. date: the images of each period "
    "that were taken last. periods: all images of some periods. none: no images; methods are then "
    "trained on all of them and cannot be scored.",
)
@click.option(
    "--fraction", type=float, help=f"Share of test images, 0 to 1.  [default: {FRACTION}]"
)
@click.option(
    "--every", type=int, metavar="N", help="Take one of N images as a test image: --fraction 1/N."
)
@click.option(
    "--offset",
    type=int,
    default=0,
    help="For stratified: index of the first test image in each period.",
)
@click.option(
    "--seed",
    type=int,
    help="For stratified: draw a random image of every N neighbours, not the first. For "
    "blocked: choose other blocks.",
)
@click.option("--blocks", type=int, metavar="N", help="For blocked: total number of blocks.")
@click.option(
    "--period",
    "periods",
    metavar="PERIOD",
    multiple=True,
    help="For periods: label or id of a period to hold out. May be repeated.",
)
@click.option(
    "--scene-out",
    type=PATH,
    help="Also write the scene with the new split to this new folder. Images are hard-linked where "
    "the file system allows it.",
)
@reading_options("SCENE")
def command(
    source: Path,
    out: Path | None,
    fraction: float | None,
    every: int | None,
    periods: tuple[str, ...],
    scene_out: Path | None,
    dataset_format: str | None,
    period_by: str | None,
    **options: Any,
) -> None:
    """Choose new test images of a scene.

    Their names are written to the file OUT, a test.txt as described in DATASET.md; a JSON file
    beside it records the settings. SCENE is not changed; --scene-out writes a copy with the new
    split.
    """
    if options["strategy"] in ("periods", "none"):
        refuse_options(["fraction", "every"], f"with --strategy {options['strategy']}")
    _check_targets(source, out, scene_out)
    say(f"read {source}")
    scene = read_and_note(source, dataset_format, period_by)
    chosen = tuple(sorted(chosen_periods(scene, periods, "--period")))
    settings = SplitSettings(fraction=_fraction(fraction, every), periods=chosen, **options)
    names = [f.name for f in scene.frames] if settings.strategy == "date" else []
    split = make_split(scene, settings, capture_times(scene.images_root, names))
    for frame in split.scene.frames:
        our_format.check_writable_name(source, frame)
    notes: list[str] = []
    if scene_out is not None:
        with progress_bar() as bar:
            our_format.write(
                split.scene, scene_out, image_source="link", progress=partial(bar, "images")
            )
        _write(split, scene_out / our_format.TEST, "--scene-out")
        notes = remarks_on(scene, copy_records(scene, scene_out))
    if out is not None:
        _write(split, out, "OUT")
    emit(report(split))
    for note in notes:
        show_note(note)


def _fraction(fraction: float | None, every: int | None) -> float:
    if fraction is not None and every is not None:
        raise click.UsageError("give --fraction or --every, not both")
    if every is not None and every < 2:
        raise click.BadParameter("2 or more is needed", param_hint="--every")
    return 1 / every if every is not None else FRACTION if fraction is None else fraction


def _check_targets(source: Path, out: Path | None, scene_out: Path | None) -> None:
    """Refuse to write into the scene, over an existing file, or nowhere."""
    if out is None and scene_out is None:
        raise click.UsageError("give a file OUT, or --scene-out")
    if out is not None:
        check_outside(out, [source], option="OUT")
    if scene_out is not None:
        check_place("--scene-out", scene_out, outside=[source])
    if out is not None and not out.name:
        raise click.BadParameter("the name of a file is needed", param_hint="OUT")
    if out is not None and _json_beside(out) == out:
        raise ConfigError(
            out,
            expected="a name for the list that does not end in .json",
            found="one that does",
            todo="name it test.txt; its settings are written to test.json beside it",
        )
    for file in (out, out and _json_beside(out)):
        if file is not None and file.exists():
            raise ConfigError(
                file, expected="a new file", found="an existing one", todo="choose another name"
            )


def _json_beside(out: Path) -> Path:
    return out.with_name(f"{out.stem}.json")


def _write(split: NewSplit, out: Path, option: str) -> None:
    names = "".join(f"{f.name}\n" for f in split.scene.select(split="test"))
    record = json.dumps(split.record(), indent=1, ensure_ascii=False) + "\n"
    with writing_to(option, out, expected=A_FILE):
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(out, names)
        write_text_atomic(_json_beside(out), record)


def report(split: NewSplit) -> str:
    """Counts, distances and hash, for people."""
    scene = split.scene
    lines = [f"{scene.name}: {split.settings.strategy}"]
    lines += [f"  {describe_period(scene, period.id)}" for period in scene.periods]
    for what, pair in (
        ("nearest training camera", split.nearest),
        ("  of the same period", split.nearest_same_period),
    ):
        if pair is not None:
            lines.append(f"{what}: median {pair[0]:.4g}, smallest {pair[1]:.4g} world units")
    for period in scene.periods:
        for kind in ("train", "test"):
            if not scene.select(split=kind, period=period.id):
                lines.append(f"note: period {period.id} has no {kind} images")
    lines.append(f"split hash {split.hash}")
    return "\n".join(lines) + "\n"
