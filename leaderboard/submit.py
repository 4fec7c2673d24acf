"""Measured entries from finished runs."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

from filelock import FileLock
from pydantic import ValidationError

from chronoscene.errors import ConfigError
from chronoscene.harness.files.ground_truth import truth_of
from chronoscene.harness.files.predictions import read_manifest, write_manifest
from chronoscene.harness.files.records import (
    PREDICTIONS,
    RUN_FILE,
    no_runs,
    read_rows,
    read_run,
    run_folders,
)
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.scoring import score_folder
from chronoscene.io.staging import needing_space, partial_name, write_text_atomic
from chronoscene.metrics.registry import make_scorers
from leaderboard.entries import (
    EntryRun,
    MeasuredEntry,
    ScoredView,
    predictions_folder,
    read_entry,
    reason_of,
)
from leaderboard.verification import check_values

LOCK = ".lock"


def submit(folders: Iterable[Path], to: Path) -> list[Path]:
    """Add runs to the entries of a folder; a run of a seed that is there replaces it.

    An entry of older code remains one until all of its seeds are replaced.

    The predictions are scored again, and copied beside the entry: without them nobody could verify
    it. Those of other periods than that of the photo are left out.

    Args:
        folders: Of single runs, or of many.
        to: Folder of entries; made if there is none.

    Returns:
        The files of entries that were written.

    Raises:
        CheckpointError: If a run is damaged, or its images are not those that its manifest lists.
        ConfigError: If a run cannot be what it says, or the file of an entry that is there.
    """
    runs = [(folder, entry_run(folder)) for given in folders for folder in _runs_of(given)]
    to.mkdir(parents=True, exist_ok=True)
    with FileLock(to / LOCK):  # another command may add a seed to the same entry
        return _add(runs, to)


def _add(given: Iterable[tuple[Path, EntryRun]], to: Path) -> list[Path]:
    """Add runs, each with its folder, to the entries that are there."""
    entries: dict[Path, MeasuredEntry] = {}
    sources: dict[Path, Path] = {}
    for folder, run in given:
        path = to / file_name(run)
        known = entries.get(path) or (read_entry(path) if path.exists() else None)
        by_seed = {r.record.seed: r for r in (*(known.runs if known else ()), run)}
        runs = tuple(by_seed[seed] for seed in sorted(by_seed))
        sources[predictions_folder(path, run.record.seed)] = folder / PREDICTIONS
        is_kept = any(predictions_folder(path, seed) not in sources for seed in by_seed)
        outdated = known is not None and known.outdated and is_kept
        try:
            entries[path] = MeasuredEntry(outdated=outdated, runs=runs)
        except ValidationError as error:
            raise _refused(folder, reason_of(error)) from error
    for place, source in sources.items():
        _copy_predictions(source, place)
    for path, entry in entries.items():
        write_text_atomic(path, entry.model_dump_json(indent=1) + "\n")
    return [*entries]


def _refused(folder: Path, found: str) -> ConfigError:
    """Make the error of a run that cannot be in an entry."""
    return ConfigError(
        folder,
        expected="a finished run that can be an entry",
        found=found,
        todo="submit runs as bench wrote them; a scene of yours must not be named like one in "
        "leaderboard/scenes.toml",
    )


def _copy_predictions(source: Path, place: Path) -> None:
    """Copy the images of the periods of their photos, with their manifest, in place of others."""
    manifest = read_manifest(source)
    partial = place.with_name(partial_name(place.name))
    try:
        with needing_space(place):
            for image in manifest.own_images:
                target = partial / image.file
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source / image.file, target)
            write_manifest(partial, manifest.model_copy(update={"images": manifest.own_images}))
        shutil.rmtree(place, ignore_errors=True)
        partial.rename(place)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _runs_of(folder: Path) -> list[Path]:
    if (folder / RUN_FILE).is_file():
        return [folder]
    if not (found := run_folders(folder)):
        raise no_runs(folder, "no finished run in it")
    return found


def entry_run(folder: Path) -> EntryRun:
    """Make the part of an entry from a run. Errors as for `submit`."""
    record = read_run(folder)
    predictions = folder / PREDICTIONS
    manifest = read_manifest(predictions)
    if manifest.scene_hash != record.scene_hash:
        raise _refused(folder, "predictions of another scene")
    values: dict[str, dict[str, float]] = {}
    for row in read_rows(folder):
        if row.region == ALL and row.rendered_period == row.camera_period:
            values.setdefault(row.view, {})[row.metric] = row.value
    images = {i.view: i for i in manifest.own_images}
    if not values.keys() <= images.keys():
        raise _refused(folder, "other views in its rows than among its predictions")
    try:
        run = EntryRun(
            record=record.model_copy(update={"regions": {}, "stages": {}, "transfer": {}}),
            views=tuple(
                ScoredView(
                    view=view,
                    period=i.camera_period,
                    sha256=i.sha256,
                    values=values.get(view, {}),  # none where the mask ignores every pixel
                )
                for view, i in images.items()
            ),
        )
    except ValidationError as error:
        raise _refused(folder, reason_of(error)) from error
    scorers = make_scorers({row.metric for row in run.rows})
    check_values(folder, run, score_folder(predictions, truth_of(folder.resolve()), scorers))
    return run


def file_name(entry: EntryRun) -> str:
    """Return a readable and unique name for the file of an entry, below a folder per scene."""
    run = entry.record
    words = run.scene, "-".join((run.method, run.strategy, run.preset))
    scene, plain = (re.sub(r"[^\w.-]+", "_", text)[:100] for text in words)
    key = MeasuredEntry(runs=(entry,)).key
    return f"{scene}/{plain}-{hashlib.sha256(repr(key).encode()).hexdigest()[:8]}.json"
