"""Measured results, as files that anybody may hand in: one per method, setting and machine.

An entry has the values of all test views, from which means, intervals and ties follow, so that none
of these has to be believed; and the hashes of the images that were scored. Nothing in an entry is
trusted: what is not a number of a plausible size or a plain text is refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import RunRecord, ViewScore
from chronoscene.harness.report.comparable import KEY
from chronoscene.harness.report.summary import COSTS
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.scoring import aggregate
from chronoscene.io.documents import plain_file
from chronoscene.io.staging import leads_out
from chronoscene.metrics.registry import all_metrics

MAX_BYTES = 50_000_000
"""Largest entry. A thousand views with ten metrics and ten seeds have less than ten million."""
MAX_VALUE = 1e3
"""Largest absolute value of a metric."""
MAX_COST = 1e15
"""Largest absolute value of any other number."""

_NAME = re.compile(r"\w[\w .,:+@()-]{0,99}")
_HASH = re.compile(r"[0-9a-f]{64}")
_NOT_TEXT = re.compile(r"[<\x00-\x1f\x7f]")

Sha256 = Annotated[str, Field(pattern=f"^{_HASH.pattern}$")]


class ScoredView(BaseModel):
    """A test view: the image that was scored, and its values."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    view: str
    period: int
    sha256: Sha256
    """Hash of the predicted image."""
    values: dict[str, float]


class EntryRun(BaseModel):
    """One seed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    record: RunRecord
    """``run.json``, without regions and stages."""
    views: tuple[ScoredView, ...]

    @model_validator(mode="after")
    def _plausible(self) -> EntryRun:
        _check_values(self.model_dump())
        record = self.record
        for name in ("scene", "method", "strategy", "preset"):
            if not _NAME.fullmatch(getattr(record, name)):
                raise ValueError(f"{name} is no plain name: {getattr(record, name)!r}")
        for name in ("scene_hash", "split_hash", "config_hash"):
            if not _HASH.fullmatch(getattr(record, name)):
                raise ValueError(f"{name} is no SHA-256")
        for cost in COSTS:
            if (getattr(record, cost.name) or 0) < 0:
                raise ValueError(f"{cost.name} is negative")
        if any(leads_out(view.view) for view in self.views):
            raise ValueError("the name of a view leads out of its folder")
        if len({view.view for view in self.views}) < len(self.views):
            raise ValueError("a view twice")
        if unknown := {name for view in self.views for name in view.values} - {*all_metrics()}:
            raise ValueError(f"unknown metrics: {', '.join(sorted(unknown))}")
        if "validation=true" in record.variant.split(","):
            raise ValueError("scores of validation views: run bench without --validation")
        if record.regions or record.stages or record.transfer:
            raise ValueError("regions and stages are no part of an entry")
        if not _agree((record.aggregates, record.periods), aggregate(self.rows)):
            raise ValueError("the means are not those of the views")
        if not record.periods or not record.periods.keys() <= record.period_labels.keys():
            raise ValueError("a period without a label, or no period")
        return self

    @property
    def rows(self) -> list[ViewScore]:
        """Values as rows of a run."""
        return [
            ViewScore(v.view, v.period, v.period, ALL, metric, value)
            for v in self.views
            for metric, value in v.values.items()
        ]


class MeasuredEntry(BaseModel):
    """Results of a method on a scene, in one setting and on one machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format_version: Literal[1] = 1
    kind: Literal["measured"] = "measured"
    outdated: bool = False
    """True for results of older code: its presets, or what it made of them, have changed since."""
    runs: tuple[EntryRun, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _of_one_kind(self) -> MeasuredEntry:
        for name in KEY:
            if len({getattr(run.record, name) for run in self.runs}) > 1:
                raise ValueError(f"runs that differ in {name}")
        if len({run.record.seed for run in self.runs}) < len(self.runs):
            raise ValueError("a seed twice")
        return self

    @property
    def key(self) -> tuple[Any, ...]:
        """Values that differ between entries."""
        return tuple(getattr(self.runs[0].record, name) for name in KEY)

    @property
    def records(self) -> list[RunRecord]:
        """Runs, with their rows; the title of a method says if its code is outdated."""
        mark = " of older code" if self.outdated else ""
        return [
            run.record.model_copy(update={"rows": run.rows, "title": run.record.title + mark})
            for run in self.runs
        ]


def read_entry(path: Path) -> MeasuredEntry:
    """Read a measured entry.

    Raises:
        ConfigError: If it is anything else, or not plausible.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise refused(path, f"more than {MAX_BYTES} bytes")
        return MeasuredEntry.model_validate_json(plain_file(path).read_bytes())
    except ValidationError as error:
        raise refused(path, reason_of(error)) from error
    except OSError as error:
        raise refused(path, error.strerror or str(error)) from error


def read_entries(folder: Path) -> dict[Path, MeasuredEntry]:
    """Read all entries below a folder, by file.

    Raises:
        ConfigError: If one is refused, or two are of the same runs.
    """
    entries: dict[Path, MeasuredEntry] = {}
    keys = set()
    for path in sorted(folder.rglob("*.json")):
        entry = entries[path] = read_entry(path)
        if entry.key in keys:
            raise refused(path, "an entry of the same method and setting as in another file")
        keys.add(entry.key)
    return entries


def refused(place: Path, found: str) -> ConfigError:
    """Make the error of an entry, or of a run for one, that is refused."""
    return ConfigError(
        place,
        expected="a measured entry, as chronoscene submit writes it",
        found=found,
        todo="make it again with chronoscene submit from the finished runs",
    )


def reason_of(error: ValidationError) -> str:
    """Describe the first problem, and its place."""
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(map(str, first["loc"])) or "the file"
    return f"{first['msg'].removeprefix('Value error, ')} ({where[:200]})"


def _leaves(value: Any) -> Iterator[Any]:
    """Yield all texts and numbers, also the keys of mappings."""
    if isinstance(value, dict):
        yield from value
        value = value.values()
    elif not isinstance(value, list | tuple):
        yield value
        return
    for item in value:
        yield from _leaves(item)


def _check_values(document: dict[str, Any]) -> None:
    record = document["record"]
    metrics = [record["aggregates"], record["periods"], [v["values"] for v in document["views"]]]
    _check_numbers(_leaves(metrics), MAX_VALUE)
    _check_numbers(_leaves(document), MAX_COST)
    for leaf in _leaves(document):
        if isinstance(leaf, str) and (_NOT_TEXT.search(leaf) or len(leaf) > 1000):
            raise ValueError(f"a text with markup, control characters or too long: {leaf[:60]!r}")


def _check_numbers(leaves: Iterable[Any], largest: float) -> None:
    for leaf in leaves:
        if isinstance(leaf, int | float) and not abs(leaf) <= largest:  # NaN is refused, too
            raise ValueError(f"a number that cannot be: {str(leaf)[:20]}")


def _agree(claimed: Any, computed: Any) -> bool:
    """Return True if nested values have equal keys and, but for rounding, equal numbers."""
    if isinstance(claimed, dict):
        return claimed.keys() == computed.keys() and all(
            _agree(claimed[name], computed[name]) for name in claimed
        )
    if isinstance(claimed, tuple):
        return all(map(_agree, claimed, computed))
    return math.isclose(claimed, computed, rel_tol=1e-9, abs_tol=1e-12)
