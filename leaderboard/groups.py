"""Groups of runs that are ranked together.

Runs are compared if they are of the same scene and photos, test views and width, and had the same
effort: the same time on the same device where there was a budget, else the same preset. Within such
a group, each aggregate is compared with itself alone. What a paper printed is in no group: photos,
test views and hardware of a printed number are not known to be ours.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from chronoscene.harness.files.records import RunRecord


class Setting(NamedTuple):
    """Common settings of the runs of a group."""

    scene: str
    scene_hash: str
    split_hash: str
    max_width: int
    effort: str


def effort_of(run: RunRecord) -> str:
    """Describe the effort that a run was allowed."""
    given = [part for part in run.variant.split(",") if part.startswith(("budget=", "iterations="))]
    for part in given:
        if part.startswith("budget="):
            return f"{part.removeprefix('budget=')} of training on {run.device}"
    return ", ".join([f"preset {run.preset}", *given])


def setting_of(run: RunRecord) -> Setting:
    """Return the setting of a run."""
    return Setting(run.scene, run.scene_hash, run.split_hash, run.max_width, effort_of(run))


def comparable(runs: Iterable[RunRecord]) -> dict[Setting, list[RunRecord]]:
    """Group runs by their setting, those of a scene side by side."""
    groups: dict[Setting, list[RunRecord]] = {}
    for run in runs:
        groups.setdefault(setting_of(run), []).append(run)
    return dict(sorted(groups.items()))
