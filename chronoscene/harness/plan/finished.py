"""Runs that are there already: finished, unfinished, or made with other settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from chronoscene.errors import ConfigError
from chronoscene.harness.files import records
from chronoscene.harness.files.source import read_source
from chronoscene.harness.plan.resolve import ResolvedMethod, ResolvedRun


def is_finished(run: ResolvedRun, overwrite: bool = False) -> bool:
    """Return True if the result is there, made with the same settings from the same scene.

    Raises:
        ConfigError: If there is one made with other settings, or by another method of the same
            name, unless it may be replaced.
    """
    folder, method = run.job.folder, run.job.origin.method
    if not (folder / records.RUN_FILE).is_file():
        return False
    if not _matches(run, folder, "a finished", overwrite):
        return False
    # Runs of earlier versions do not say where their method is.
    made_by = read_source(folder).method if (folder / records.SOURCE_FILE).is_file() else method
    if made_by != method and not overwrite:
        raise _conflict(folder, f"a run of {method}", f"a finished one of {made_by}")
    return made_by == method


def is_obsolete(run: ResolvedRun, overwrite: bool = False) -> bool:
    """Return True if there are checkpoints that may be deleted: of a training with other settings.

    Checkpoints without settings are what an interrupted deletion has left.

    Raises:
        ConfigError: If there are checkpoints with other settings that may not be deleted.
    """
    if not (run.job.training / records.CONFIG_FILE).is_file():
        return run.job.training.is_dir()
    return not _matches(run, run.job.training, "an unfinished", overwrite)


def is_to_do(run: ResolvedRun, overwrite: bool) -> bool:
    """Return True if a run is neither finished nor in conflict with what is there.

    Raises:
        ConfigError: If a result or checkpoints with other settings are there and may not be
            replaced.
    """
    if is_finished(run, overwrite):
        return False
    is_obsolete(run, overwrite)
    return True


def _matches(run: ResolvedRun, folder: Path, kind: str, overwrite: bool) -> bool:
    if folder == run.job.folder:
        records.read_run(folder)  # raises if it is damaged
    stored = records.read_config(folder)
    if stored == run.document or overwrite:
        return bool(stored == run.document)
    old, new = first_difference(stored, run.document)
    raise _conflict(folder, f"a run with {new}", f"{kind} one with {old}")


def _conflict(folder: Path, expected: str, found: str) -> ConfigError:
    todo = "choose another folder with --out, or pass --overwrite"
    return ConfigError(folder, expected=expected, found=found, todo=todo)


def first_difference(old: Any, new: Any, key: str = "settings") -> tuple[str, str]:
    """Return the first difference of two documents, as ``key value`` of both."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*new, *(k for k in old if k not in new)]:
            if old.get(name) != new.get(name):
                return first_difference(old.get(name), new.get(name), name)
    return f"{key} {old}", f"{key} {new}"


def continued(run: ResolvedRun, method: ResolvedMethod, iterations: int) -> ResolvedRun:
    """Return the run that trains the longest finished one further.

    Args:
        run: The run with the settings of the finished one, apart from the number of iterations.
        method: Its method.
        iterations: Number of iterations of the whole training.

    Raises:
        ConfigError: If there is no finished run, or it did not keep its training.
    """
    there = {done.config.iterations: done for done in _other_lengths(run, method)}
    shorter = [length for length in there if length <= iterations]
    if not shorter:
        raise ConfigError(
            run.job.folder,
            expected=f"a finished run that ended after at most {iterations} iterations",
            found=f"one with {min(there)}" if there else "none",
            todo="correct --continue-to, or train anew with --iterations",
        )
    last = there[max(shorter)]
    is_finished(last)  # raises if its settings are others
    if last.config.iterations == iterations:
        return last
    if not (last.job.folder / records.TRAINING).is_dir():
        raise ConfigError(
            last.job.folder,
            expected="a run that kept its training",
            found="its model alone",
            todo="delete that folder and train anew with --keep-training",
        )
    job = replace(
        run.job.with_settings(iterations=iterations),
        continued_from=[*last.job.continued_from, max(shorter)],
        continues=str(last.job.folder),
    )
    return method.run(job)


def _other_lengths(run: ResolvedRun, method: ResolvedMethod) -> Iterator[ResolvedRun]:
    """Finished runs like this apart from the number of iterations, those begun afresh first."""
    found, folder = [], run.job.folder
    for file in sorted(folder.parent.parent.glob(f"*/{folder.name}/{records.RUN_FILE}")):
        config = records.read_config(file.parent)["config"]
        length = config.get("stop", {}).get("iterations")  # images of other programs have none
        if length is None:
            continue
        earlier = config.get("continued_from", [])
        job = replace(run.job.with_settings(iterations=length), continued_from=earlier)
        other = method.run(job)
        if other.job.folder == file.parent:
            found.append(other)
    yield from sorted(found, key=lambda done: len(done.job.continued_from))
