"""Run the steps: what holds is kept, what is missing or out of date is made."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.harness.plan.stop import parse_duration
from chronoscene.io.staging import (
    alone_in,
    check_not_current,
    check_outside,
    sha256_of,
    write_text_atomic,
)
from chronoscene.io.wording import format_time
from chronoscene.methods import build_config, is_preset_file, load_spec
from chronoscene.registration.photos.captures import find_captures, photo_folders
from chronoscene.registration.work_folder import fingerprint
from chronoscene.workflow.record import (
    RECORD_FILE,
    Options,
    Record,
    State,
    StepRecord,
    describe_changes,
    new_record,
    read_record,
)
from chronoscene.workflow.steps import METHOD, STEPS, Project, Skipped, Step
from chronoscene.workflow.summary_page import render_summary

SUMMARY = "index.html"


def start(captures: Path, table: Path | None, out: Path, options: Options) -> tuple[Record, str]:
    """Check the arguments of `Project` before long work.

    Returns:
        record: What an earlier call made, with the photos and options of now.
        changes: What changed since then, and the steps that follow from it, for people.

    Raises:
        ChronoSceneError: If an argument is wrong, or the folder is in use for something else.
    """
    build_config(load_spec(METHOD), preset=str(options["preset"]))
    if options["budget"] is not None:
        parse_duration(str(options["budget"]))
    check_outside(out, photo_folders(captures, table), option="OUT")
    check_not_current(out)
    before = read_record(out)
    if before is None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SceneError(
            out,
            expected=f"a new or empty folder, or one with the {RECORD_FILE} of an earlier call",
            found="one that is not empty" if out.is_dir() else "a file",
            todo="choose another folder",
        )
    record = new_record(*find_captures(captures, table), options)
    changes = describe_changes(before or record, record)
    made_anew: list[str] = []
    for step in STEPS:
        decides = {*step.options} | ({"photos"} if step.after is None else set())
        if step.after in made_anew or decides & changes.keys():
            made_anew.append(step.name)
    record.steps = {} if before is None else before.steps
    words = f"changed: {', '.join(changes.values())}; made anew: {', '.join(made_anew)}"
    return record, words if changes else ""


def run_steps(project: Project) -> Path:
    """Run all steps up to the first that fails; write record and summary page after each.

    Returns:
        The summary page.

    Raises:
        ConfigError: If another command works in the folder.
        ChronoSceneError: If a step fails.
    """
    project.out.mkdir(parents=True, exist_ok=True)
    with alone_in(project.out, "OUT"):
        return _run_missing(project)


def _run_missing(project: Project) -> Path:
    page = _write(project)
    for number, step in enumerate(STEPS, 1):
        label = f"[{number}/{len(STEPS)}] {step.name}"
        kept = _holding(project).get(step.name)
        if kept is not None and kept.state == "done":
            project.say(f"{label}: kept, made in {format_time(kept.seconds)}")
            continue
        project.say(f"{label}: {step.what}")
        made = _run_step(project, step)
        end = f"skipped, {made.reason}" if made.reason else f"done in {format_time(made.seconds)}"
        project.say(f"{label}: {end}")
    return page


def _run_step(project: Project, step: Step) -> StepRecord:
    """Run a step and record how it ended."""
    started, key, out = time.monotonic(), _key(project, step), project.out.resolve()
    results: Sequence[Path] = ()
    state: State = "failed"
    reason = "stopped before its end"
    project.record.steps.pop(step.name, None)
    _write(project)
    try:
        results = step.make(project)
        state, reason = "done", ""
    except Skipped as skipped:
        state, reason = "skipped", str(skipped)
    except (ChronoSceneError, OSError) as error:
        reason = str(error)
        raise
    finally:
        project.record.steps[step.name] = StepRecord(
            state=state,
            key=key,
            seconds=time.monotonic() - started,
            reason=reason,
            results=[path.resolve().relative_to(out).as_posix() for path in results],
        )
        _write(project)
    return project.record.steps[step.name]


def _write(project: Project) -> Path:
    project.record.write(project.out)
    write_text_atomic(project.out / SUMMARY, render_summary(project, _holding(project)))
    return project.out / SUMMARY


def _holding(project: Project) -> dict[str, StepRecord]:
    """Return the records that are of the present photos and options, and whose files are there."""
    holding: dict[str, StepRecord] = {}
    for step in STEPS:
        found = project.record.steps.get(step.name)
        source = None if step.after is None else holding.get(step.after)
        ready = step.after is None or (source is not None and source.state == "done")
        if found is None or not ready or found.key != _key(project, step):
            continue
        if all((project.out / path).is_file() for path in found.results):
            holding[step.name] = found
    return holding


def _key(project: Project, step: Step) -> str:
    """Fingerprint of all that the result of a step depends on."""
    record = project.record
    options = {name: record.options[name] for name in step.options}
    if is_preset_file(preset := str(options.get("preset"))):
        options["preset"] = sha256_of(Path(preset))
    if step.after is None:
        return fingerprint(step.name, options, record.photos)
    results = record.steps[step.after].results
    return fingerprint(step.name, options, [sha256_of(project.out / path) for path in results])
