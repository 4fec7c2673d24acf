"""Entries of the leaderboard beside the runs that they were made of, with scores computed again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from chronoscene.errors import ConfigError
from chronoscene.harness.report.comparable import KEY
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.verification import Verified
from leaderboard.entries import EntryRun, read_entry


def verify_entries(folder: Path, runs: Iterable[Verified]) -> Iterator[Verified]:
    """Compare each run of all entries with the run of equal `KEY` and seed, if it is there.

    Args:
        folder: Folder of entries. Those that cannot be read are findings, not errors.
        runs: What `chronoscene.harness.score.verification.verify` found.
    """
    keys = (*KEY, "seed")
    there = {
        tuple(getattr(run.record, name) for name in keys): run
        for run in runs
        if run.record is not None and run.images
    }
    for path in sorted(folder.rglob("*.json")):
        try:
            entry = read_entry(path)
        except ConfigError as error:
            yield Verified(str(path), differs=[str(error)])
            continue
        for part in entry.runs:
            label = f"{path}: seed {part.record.seed}"
            run = there.get(tuple(getattr(part.record, name) for name in keys))
            if run is None:
                yield Verified(
                    label, unchecked={"entry": "no run of it in RUNS (unchecked in the table)"}
                )
            else:
                yield _verified(label, part, run)


def _verified(label: str, part: EntryRun, run: Verified) -> Verified:
    """Compare images and values; metrics that the run has not are left out."""
    assert run.record is not None
    found = Verified(label, len(part.views))
    images = {view.view: view.sha256 for view in part.views}
    found.compare("sha256", images, run.images)
    given = {name for view in part.views for name in view.values}
    found.metrics = tuple(name for name in run.metrics if name in given)
    reason = "not computed for its run"
    found.unchecked = {name: run.unchecked.get(name, reason) for name in given - {*run.metrics}}
    computed: dict[str, dict[str, float]] = {}
    for row in run.record.rows:
        if row.region == ALL and row.metric in found.metrics:
            computed.setdefault(row.view, {})[row.metric] = row.value
    stored = {
        view.view: {name: value for name, value in view.values.items() if name in found.metrics}
        for view in part.views
    }
    # The means of an entry are those of its views, or it would have been refused.
    found.compare("views", stored, computed)
    return found
