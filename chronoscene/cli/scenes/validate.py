"""``chronoscene validate``: every problem of a scene folder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import click

from chronoscene.cli.options import PATH, reading_options
from chronoscene.cli.output import OUT_FILE, check_file, check_place, emit, say, terminal_width
from chronoscene.cli.progress import tracked
from chronoscene.io.processes import map_parallel
from chronoscene.io.wording import counted
from chronoscene.kernels.runtime import keep_freed_memory
from chronoscene.validation.folder.scene_folder import Track, no_progress
from chronoscene.validation.repair.fix import check_fixable, fix_scene
from chronoscene.validation.report.html import write_html
from chronoscene.validation.report.json import write_json, write_sarif
from chronoscene.validation.report.rule_list import describe_rule
from chronoscene.validation.report.text import write_text
from chronoscene.validation.rule import SceneReport, is_valid
from chronoscene.validation.rules import choose_rules
from chronoscene.validation.run import ReadOptions, find_folders, lost_report, validate_scene

WRITERS = {"json": write_json, "sarif": write_sarif, "html": write_html}

NOT_VALID = 1  # Exit status when there are errors


def _explain(context: click.Context, option: click.Parameter, value: str | None) -> None:
    """Print the descriptions of some rules, and end."""
    if value is not None:
        rules = choose_rules(_codes([value]), place="--explain")
        emit("\n".join(map(describe_rule, rules)))
        context.exit(0)


@click.command("validate")
@click.argument("folder", type=PATH, metavar="DIR")
@click.option(
    "--format",
    "output_format",
    type=click.Choice(sorted([*WRITERS, "text"])),
    default="text",
    help="Output format.",
)
@OUT_FILE
@click.option("--sarif", type=PATH, help="Also write a SARIF report to this file.")
@click.option("--html", type=PATH, help="Also write an HTML page to this file.")
@click.option(
    "--select",
    multiple=True,
    metavar="CODES",
    help="Run these rules only, such as CS201,CS3,split-line.",
)
@click.option("--ignore", multiple=True, metavar="CODES", help="Do not run these rules.")
@click.option(
    "--explain",
    metavar="CODES",
    expose_value=False,
    is_eager=True,
    callback=_explain,
    help="Print what these rules check and what to do about findings. CS means all rules.",
)
@click.option("--strict", is_flag=True, help="Warnings make a scene invalid, too.")
@click.option(
    "--decode/--no-decode",
    default=False,
    help="Decode all images, which finds damaged and duplicate ones but takes time.",
)
@click.option(
    "--fix",
    type=PATH,
    metavar="OUT",
    help="Write a corrected copy to this new folder and report what remains.",
)
@reading_options("the scenes")
@click.pass_context
def command(
    context: click.Context,
    folder: Path,
    dataset_format: str | None,
    period_by: str | None,
    output_format: str,
    out: Path | None,
    sarif: Path | None,
    html: Path | None,
    select: tuple[str, ...],
    ignore: tuple[str, ...],
    strict: bool,
    decode: bool,
    fix: Path | None,
) -> None:
    """Check scenes and report all problems.

    DIR is a scene or a folder of scenes; it is never changed. With --fix, report and exit status
    are those of the corrected copy. --explain CS lists all rules.

    Exit status: 0 if the scene is valid, 1 if there are errors (with --strict, also warnings), 2 if
    there is no scene or the command is used wrongly.
    """
    read = ReadOptions(dataset_format, period_by)
    check = partial(_check, _codes(select), _codes(ignore), decode, read)
    choose_rules(_codes(select), _codes(ignore))  # errors in these options come first
    folders = find_folders(folder)
    for option, file in (("--out", out), ("--sarif", sarif), ("--html", html)):
        check_file(option, file, outside=folders)
    if fix is not None:
        check_place("--fix", fix, outside=folders)
        folders = _fix(folder, folders, fix, read)
    if len(folders) == 1:
        say(f"check {folders[0]}")
        reports = [check(folders[0], track=tracked)]
    else:
        done = map_parallel(check, folders, lost=lost_report)
        reports = list(tracked(done, "check scenes", total=len(folders)))
    if output_format == "text":
        text = write_text(reports, strict=strict, width=terminal_width(out))
    else:
        text = WRITERS[output_format](reports, strict=strict)
    emit(text, out)
    for option, file, write in (("--sarif", sarif, write_sarif), ("--html", html, write_html)):
        if file is not None:
            emit(write(reports, strict=strict), file, option=option)
    if not is_valid(reports, strict=strict):
        context.exit(NOT_VALID)


def _check(
    select: list[str],
    ignore: list[str],
    decode: bool,
    options: ReadOptions,
    path: Path,
    *,
    track: Track = no_progress,
) -> SceneReport:
    """Check one scene, perhaps in a process of its own, which gets names of rules, not rules."""
    keep_freed_memory()  # arrays as large as the model come and go
    rules = choose_rules(select, ignore)
    return validate_scene(path, rules=rules, decode=decode, track=track, options=options)


def _fix(folder: Path, scenes: Sequence[Path], out: Path, options: ReadOptions) -> list[Path]:
    """Write corrected copies of the scenes; list the corrections on standard error."""
    copies = []
    for scene in scenes:
        check_fixable(scene, options)  # before any copy is written
    for scene in scenes:
        copy = out if scene == folder else out / scene.name
        say(f"correct {scene}")
        repairs = fix_scene(scene, copy)
        say(f"{copy}: {counted(len(repairs), 'correction')}")
        for repair in repairs:
            say(f"  {repair.code or 'also'}: {repair.text}")
        copies.append(copy)
    return copies


def _codes(values: Iterable[str]) -> list[str]:
    """Split the values of a repeated option at commas."""
    return [code for value in values for code in value.split(",")]
