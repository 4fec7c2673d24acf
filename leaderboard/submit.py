"""Measured entries from finished runs."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from chronoscene.harness.files.predictions import load_image, read_manifest
from chronoscene.harness.files.records import (
    PREDICTIONS,
    RUN_FILE,
    read_rows,
    read_run,
    run_folders,
)
from chronoscene.harness.score.regions import ALL
from chronoscene.io.staging import write_text_atomic
from leaderboard.entries import (
    EntryRun,
    MeasuredEntry,
    ScoredView,
    read_entries,
    reason_of,
    refused,
)


def submit(folders: Iterable[Path], to: Path) -> list[Path]:
    """Add runs to the entries of a folder; a run of a seed that is there replaces it.

    Args:
        folders: Of single runs, or of many.
        to: Folder of entries; made if there is none.

    Returns:
        The files that were written.

    Raises:
        CheckpointError: If a run is damaged, or its images are not those that its manifest lists.
        ConfigError: If a run is not plausible, or an entry that is there is not.
    """
    entries = read_entries(to)
    places = {entry.key: path for path, entry in entries.items()}
    changed = {}
    for folder in (run for given in folders for run in _runs_of(given)):
        entry = MeasuredEntry(runs=(entry_run(folder),))
        path = places.setdefault(entry.key, to / file_name(entry))
        known = entries.get(path, entry)
        by_seed = {run.record.seed: run for run in (*known.runs, *entry.runs)}
        runs = tuple(by_seed[seed] for seed in sorted(by_seed))
        entries[path] = MeasuredEntry(outdated=known.outdated, runs=runs)
        changed[path] = entries[path]
    for path, entry in changed.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(path, entry.model_dump_json(indent=1) + "\n")
    return [*changed]


def _runs_of(folder: Path) -> list[Path]:
    if (folder / RUN_FILE).is_file():
        return [folder]
    if not (found := run_folders(folder)):
        read_run(folder)  # says what is missing
    return found


def entry_run(folder: Path) -> EntryRun:
    """Make the part of an entry from a run. Errors as for `submit`."""
    record = read_run(folder)
    predictions = folder / PREDICTIONS
    manifest = read_manifest(predictions)
    if manifest.scene_hash != record.scene_hash:
        raise refused(folder, "predictions of another scene")
    values: dict[str, dict[str, float]] = {}
    for row in read_rows(folder):
        if row.region == ALL and row.rendered_period == row.camera_period:
            values.setdefault(row.view, {})[row.metric] = row.value
    images = {i.view: i for i in manifest.images if i.rendered_period == i.camera_period}
    if images.keys() != values.keys():
        raise refused(folder, "other views in its rows than among its predictions")
    for image in images.values():
        load_image(predictions, image)  # checks the hash
    try:
        return EntryRun(
            record=record.model_copy(update={"regions": {}, "stages": {}, "transfer": {}}),
            views=tuple(
                ScoredView(view=view, period=i.camera_period, sha256=i.sha256, values=values[view])
                for view, i in images.items()
            ),
        )
    except ValidationError as error:
        raise refused(folder, reason_of(error)) from error


def file_name(entry: MeasuredEntry) -> str:
    """Return a readable and unique name for the file of an entry, below a folder per scene."""
    run = entry.runs[0].record
    words = run.scene, "-".join((run.method, run.strategy, run.preset))
    scene, plain = (re.sub(r"[^\w.-]+", "_", text)[:100] for text in words)
    return f"{scene}/{plain}-{hashlib.sha256(repr(entry.key).encode()).hexdigest()[:8]}.json"
