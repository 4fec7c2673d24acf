"""Definition of what may be compared, for tables, figures, trade-offs, studies, leaderboard.

Scores are compared within a *test*: equal scene and photos, test views, width, protocol and part of
the photos. Methods are ranked on the leaderboard if they had the same *effort* as well: the same
time on the same device where there was a budget, else as many training steps, those of all models
or stages together. A preset is no effort: those named ``paper`` have from 18,000 to 40,000 steps.
Elsewhere efforts may differ, and notes say so. Times are compared on one device only (`TIMES` of
`summary`).
What a paper printed is in no test: its photos, test views and hardware are not known to be ours.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import RunRecord, variant_options
from chronoscene.io.wording import shown
from chronoscene.scene.grouping import grouped

KEY = (
    *("scene", "scene_hash", "split_hash", "method", "strategy", "preset", "variant"),
    *("config_hash", "max_width", "device"),
)
"""Fields of `RunRecord` in which the seeds of a configuration agree on one device."""
_DIFFERENCES = {
    "name": ("scene", "names of the scene"),
    "width": ("max_width", "--max-width"),
    "protocol": ("protocol", "--protocol"),
    "fitted": ("fitted", "--fit-half"),
    "split": ("split_hash", "test views"),
    "scene": ("scene_hash", "photos, poses or points"),
}
"""Kinds of differences between tests of a scene: field of `RunRecord`, and meaning for users."""
_APART = re.compile(rf" \[(?:{'|'.join(_DIFFERENCES)}) [^]]*\]")


class Setting(NamedTuple):
    """Common properties of runs that are ranked together."""

    scene: str
    scene_hash: str
    split_hash: str
    max_width: int
    protocol: str
    fitted: str
    effort: str

    @property
    def test(self) -> tuple[str | int, ...]:
        """Everything but the effort: what scores have in common that may be compared."""
        return self[:-1]


def setting_of(run: RunRecord) -> Setting:
    """Return the setting of a run."""
    test = run.scene, run.scene_hash, run.split_hash, run.max_width, run.protocol, run.fitted
    return Setting(*test, effort_of(run))


def effort_of(run: RunRecord) -> str:
    """Describe the effort that a run was allowed, all models together."""
    if (seconds := budget_of(run)) is not None:
        return f"{seconds:g}s of training on {run.device}"
    if run.iterations is None:  # another program, which did not say
        return f"preset {run.preset}"
    return f"{run.iterations:,} training steps"


def budget_of(run: RunRecord) -> float | None:
    """Return the seconds that a run was allowed, all models together; None if steps end it."""
    options = variant_options(run.variant)
    if budget := re.fullmatch(r"(\d+(?:\.\d+)?(?:e\+\d+)?)s", options.get("budget", "")):
        each = options.get("separate_iterations") == "each" and run.strategy != "pooled"
        return float(budget[1]) * (len(run.period_labels) if each else 1)
    return None


def comparable(runs: Iterable[RunRecord]) -> dict[Setting, list[RunRecord]]:
    """Group runs by their setting, those of a scene side by side."""
    return dict(sorted(grouped((setting_of(run), run) for run in runs).items()))


def apart(records: Sequence[RunRecord]) -> list[RunRecord]:
    """Give each test of a scene a name of its own where there are several, and a notice.

    Tables, figures and means go by the name of the scene. A scene with several names has the first.
    """
    tests: dict[str, dict[tuple[str | int, ...], RunRecord]] = {}
    names_of: dict[str, str] = {}
    for run in records:
        name = names_of.setdefault(run.scene_hash, scene_of(run.scene))
        scene = run.scene if scene_of(run.scene) == name else name
        tests.setdefault(scene, {}).setdefault(setting_of(run).test, run)
    changes: dict[tuple[str | int, ...], dict[str, str]] = {}
    for scene, of_scene in tests.items():
        if len(of_scene) == 1:
            continue
        names = [
            {
                kind: str(getattr(run, field))[: 6 if field.endswith("hash") else None] or "none"
                for kind, (field, _) in _DIFFERENCES.items()
            }
            for run in of_scene.values()
        ]
        differing = [
            kind for kind in _DIFFERENCES if kind != "scene" and len({n[kind] for n in names}) > 1
        ]
        if len({tuple(n[kind] for kind in differing) for n in names}) < len(names):
            differing.append("scene")  # its hash covers the split, too
        values = {kind: ", ".join(dict.fromkeys(n[kind] for n in names)) for kind in differing}
        what = "; ".join(f"{_DIFFERENCES[kind][1]} ({text})" for kind, text in values.items())
        notice = f"{scene}: runs with different {what} are not compared, and stand apart"
        for test, n in zip(of_scene, names, strict=True):
            name = f"{scene} [{', '.join(f'{kind} {n[kind]}' for kind in differing)}]"
            changes[test] = {"scene": name, "notice": notice}
    found = []
    for run in records:
        if change := changes.get(setting_of(run).test):
            notices = [*run.notices, change["notice"]]
            run = run.model_copy(update={"scene": change["scene"], "notices": notices})
        found.append(run)
    return found


def scene_of(name: str) -> str:
    """Return the name of the scene, of one of its tests as `apart` calls it."""
    return _APART.sub("", name)


def several_scenes(names: Iterable[str]) -> bool:
    """Return True if a mean over scenes says something: of several, with one test of each.

    Args:
        names: As `apart` gives them.
    """
    tests = {*names}
    return len(tests) > 1 and len({*map(scene_of, tests)}) == len(tests)


def with_own_titles(records: Sequence[RunRecord]) -> list[RunRecord]:
    """Add the name of the method to titles that several methods have.

    Tables and figures go by the titles.
    """
    methods: dict[str, set[str]] = {}
    for run in records:
        methods.setdefault(run.title, set()).add(run.method)
    return [
        run.model_copy(update={"title": f"{run.title} [{run.method}]"})
        if len(methods[run.title]) > 1
        else run
        for run in records
    ]


def each_once(records: Iterable[RunRecord]) -> list[RunRecord]:
    """Leave copies of runs out, with a notice.

    Raises:
        ConfigError: If two runs of one seed, configuration, device and commit are no copies.
    """
    found: dict[tuple[object, ...], RunRecord] = {}
    fields = (*KEY, "seed", "commit")
    copies = []
    for run in records:
        first = found.setdefault(tuple(getattr(run, name) for name in fields), run)
        if first is run:
            continue
        if first != run.model_copy(update={"folder": first.folder}):
            raise ConfigError(
                run.folder,
                expected=f"{run.label} once",
                found=f"it also, with other values, in {first.folder}",
                todo="leave out the folder of one of the two",
            )
        copies.append(str(run.folder))
    runs = [*found.values()]
    if copies:
        notice = f"copies of runs, not counted: {shown(copies)}"
        runs[0] = runs[0].model_copy(update={"notices": [*runs[0].notices, notice]})
    return runs
