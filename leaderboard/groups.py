"""Groups of runs that are ranked together.

Runs are compared if they are of the same scene and photos, test views and width, and had the same
effort: the same time on the same device where there was a budget, else as many training steps,
those of all models or stages together. A preset is no effort: those named ``paper`` have from
18,000 to 40,000 steps. Within such a group, each aggregate is compared with itself alone. What a
paper printed is in no group: photos, test views and hardware of a printed number are not known to
be ours.
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
    options = dict(part.partition("=")[::2] for part in run.variant.split(","))
    if budget := options.get("budget"):
        each = ", each model" if "separate_iterations" in options else ""
        return f"{budget} of training on {run.device}{each}"
    if run.iterations is None:  # another program, which did not say
        return f"preset {run.preset}"
    return f"{run.iterations:,} training steps"


def setting_of(run: RunRecord) -> Setting:
    """Return the setting of a run."""
    return Setting(run.scene, run.scene_hash, run.split_hash, run.max_width, effort_of(run))


def comparable(runs: Iterable[RunRecord]) -> dict[Setting, list[RunRecord]]:
    """Group runs by their setting, those of a scene side by side."""
    groups: dict[Setting, list[RunRecord]] = {}
    for run in runs:
        groups.setdefault(setting_of(run), []).append(run)
    return dict(sorted(groups.items()))
