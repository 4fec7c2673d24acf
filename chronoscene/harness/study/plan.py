"""Studies: TOML files with a question about a method and the rows of the table that answers it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from itertools import chain, combinations
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import RUN_FILE
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.plan import Plan, plan_runs
from chronoscene.harness.plan.resolve import check_overrides, overrides_of
from chronoscene.harness.plan.settings import SHARING, BenchSettings
from chronoscene.harness.report.summary import COSTS
from chronoscene.harness.run.local_pool import open_pool
from chronoscene.harness.run.runner import BenchOutcome, Execute, run_plan
from chronoscene.io.log import Log
from chronoscene.methods import as_typed, installed_methods, load_spec
from chronoscene.metrics.registry import all_metrics

FOLDER = "studies"
"""Folder of a method's package with its studies."""
SUFFIX = ".toml"


class StudyRow(BaseModel):
    """One line of the table."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    label: str
    method: str = ""
    """Name, or ``module:SPEC``; empty for the method of the study."""
    strategy: str = "joint"
    separate_iterations: str | None = None
    options: Mapping[str, Any] = Field(default={}, alias="set")
    """Options of the method, beside those of the preset."""
    published: Mapping[str, Mapping[str, float]] = {}
    """Scene to metric, or cost in the unit of `RunRecord`, to the published figure."""


class Study(BaseModel):
    """Content of a study file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    question: str
    method: str
    """Name, or ``module:SPEC``."""
    source: str = ""
    """Publication of the published figures."""
    notes: tuple[str, ...] = ()
    rows: tuple[StudyRow, ...] = Field(min_length=2)
    """The other rows are compared with the first one."""


def installed_studies() -> dict[str, Path]:
    """Return the files of all studies of installed methods, by name."""
    found: dict[str, Path] = {}
    for package in dict.fromkeys(entry.module for entry in installed_methods().values()):
        spec = None
        with suppress(Exception):  # whatever the code of others raises
            spec = find_spec(package)
        for place in (spec.submodule_search_locations if spec else None) or ():
            found |= {file.stem: file for file in sorted(Path(place, FOLDER).glob(f"*{SUFFIX}"))}
    return found


def find_study(name: str) -> Path:
    """Return the file of a study.

    Args:
        name: Name of a study of an installed method, or a path that ends with ``.toml``.

    Raises:
        ConfigError: If there is no such study.
    """
    if name.endswith(SUFFIX):
        return Path(name)
    installed = installed_studies()
    check_choice("study", name, [*installed, f"FILE{SUFFIX}"])
    return installed[name]


def read_study(path: Path) -> Study:
    """Read a study file.

    Raises:
        ConfigError: If it is missing or damaged, or has an unknown key or value.
    """
    try:
        study = Study.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise _wrong(path, f"{first['msg']} ({where})") from error
    except (OSError, ValueError) as error:  # ValueError: TOML or UTF-8
        raise _wrong(path, str(getattr(error, "strerror", None) or error)) from error
    labels = [row.label for row in study.rows]
    if len(set(labels)) < len(labels):
        raise _wrong(path, f"labels {', '.join(map(repr, labels))}, which are not all different")
    quantities = [*all_metrics(), *(cost.name for cost in COSTS)]
    for row in study.rows:
        place = f"{path}: row {row.label!r}"
        check_choice(f"{place}: strategy", row.strategy, STRATEGIES)
        if row.separate_iterations is not None:
            check_choice(f"{place}: separate_iterations", row.separate_iterations, SHARING)
        for quantity in chain(*row.published.values()):
            check_choice(f"{place}: published", quantity, quantities)
    return study


def _wrong(path: Path, found: str) -> ConfigError:
    return ConfigError(
        path,
        expected="a study file",
        found=found,
        todo="correct it; docs/guides/studies.md describes the form",
    )


def _check_different(plans: Mapping[str, Plan]) -> None:
    """Refuse rows whose configurations are equal: a table of their differences says nothing.

    Raises:
        ConfigError: If there are such.
    """
    for (label, plan), (other, same) in combinations(plans.items(), 2):
        if plan.runs.keys() & same.runs.keys():
            raise ConfigError(
                f"study: rows {label!r} and {other!r}",
                expected="runs of different settings",
                found="equal ones, with this preset and these overrides",
                todo="use another --preset, leave --set out, or correct the study",
            )


def run_study(
    study: Study, settings: BenchSettings, log: Log, *, execute: Execute | None = None
) -> tuple[BenchOutcome, dict[str, list[Path]]]:
    """Check all rows of a study, then run those that are not finished.

    Args:
        study: The study.
        settings: Scenes, preset, seeds, machine; overrides hold for rows that do not set the option
            themselves. Methods and strategies are those of the study.
        log: Called with lines for the user, without repetitions.
        execute: As for `run_bench`.

    Returns:
        The outcome, and the folders of the finished runs of each row by its label.

    Raises:
        ChronoSceneError: If a row cannot be run; nothing is trained then.
    """
    methods = tuple(dict.fromkeys(row.method or study.method for row in study.rows))
    specs = {name: load_spec(name) for name in methods}
    check_overrides(settings.run.overrides, [spec.name for spec in specs.values()])
    logged: set[str] = set()

    def once(line: str) -> None:
        if line not in logged:
            logged.add(line)
            log(line)

    plans: dict[str, Plan] = {}
    with open_pool(settings) as pool:
        for row in study.rows:
            method = row.method or study.method
            own = {key: as_typed(value) for key, value in row.options.items()}
            changed = replace(
                settings.run,
                separate_iterations=row.separate_iterations,
                overrides=overrides_of(settings.run.overrides, specs[method].name) | own,
            )
            asked = replace(settings, methods=(method,), strategies=(row.strategy,), run=changed)
            plans[row.label] = plan_runs(asked, once)
        _check_different(plans)
        plan = Plan({}, {})
        for row_plan in plans.values():
            plan.runs.update(row_plan.runs)
            plan.todo.update(row_plan.todo)
        outcome = run_plan(plan, settings, log, execute=execute, pool=pool)
    finished = {
        label: [folder for folder in rows.runs if (folder / RUN_FILE).is_file()]
        for label, rows in plans.items()
    }
    return outcome, finished
