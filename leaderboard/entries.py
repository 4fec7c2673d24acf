"""Measured results, as files that anybody may hand in: one per method, setting and machine.

An entry has the values of all test views, from which means, intervals and ties follow, and the
hashes of the images that were scored, which lie beside it (`predictions_folder`). Nothing in it is
trusted: what cannot be true is refused here, and the rest is a claim until the images have been
scored again (`leaderboard.verification`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import MANIFEST
from chronoscene.harness.files.protocols import PROTOCOLS
from chronoscene.harness.files.records import RunRecord, ViewScore, variant_options
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.report.comparable import KEY
from chronoscene.harness.report.summary import COSTS
from chronoscene.harness.score.images import STRATEGY as EXTERNAL
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.scoring import aggregate
from chronoscene.io.documents import plain_file
from chronoscene.io.staging import leads_out
from chronoscene.metrics.registry import all_metrics
from leaderboard.registry import check_effort, check_scene

MAX_BYTES = 10_000_000
"""Largest file of an entry. A thousand views with three metrics and ten seeds have 3,000,000."""
MAX_RUNS, MAX_VIEWS, MAX_PERIODS = 30, 2_000, 200
MAX_COST = 1e15
"""Largest absolute value of a number that is no metric."""

_NAME = re.compile(r"\w[\w .,:+@()-]{0,99}", re.ASCII)
_VALUE = r"(\[[\w.+ ,-]*\]|[\w.,+:() -]+)"  # A tuple is written in brackets
_VARIANT = re.compile(rf"(\w+={_VALUE}(,\w+={_VALUE})*)?", re.ASCII)
_WORDS = re.compile("publish|verif|claim|measure", re.IGNORECASE)  # of the board
_HASH = re.compile(r"[0-9a-f]{64}")

Sha256 = Annotated[str, Field(pattern=f"^{_HASH.pattern}$")]


class ScoredView(BaseModel):
    """A test view: the image that was scored, and its values."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    view: str
    period: int = Field(ge=0, lt=MAX_PERIODS)
    sha256: Sha256
    """Hash of the predicted image."""
    values: dict[str, float]
    """Empty if the mask of the photo ignores every pixel."""


class EntryRun(BaseModel):
    """One seed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    record: RunRecord
    """``run.json``, without regions and stages."""
    views: tuple[ScoredView, ...] = Field(max_length=MAX_VIEWS)

    @model_validator(mode="after")
    def _plausible(self) -> EntryRun:
        record = self.record
        _check_texts(record)
        _check_numbers(record)
        _check_views(self.views)
        if record.regions or record.stages or record.transfer:
            raise ValueError("regions and stages are no part of an entry")
        if not _agree((record.aggregates, record.periods), aggregate(self.rows)):
            raise ValueError("the means are not those of the views")
        if not record.periods or not record.periods.keys() <= record.period_labels.keys():
            raise ValueError("a period without a label, or no period")
        check_effort(record)
        check_scene(record, [(view.view, view.period) for view in self.scored])
        return self

    @property
    def scored(self) -> list[ScoredView]:
        """Views that have values."""
        return [view for view in self.views if view.values]

    @property
    def images(self) -> dict[str, str]:
        """Hash of the prediction of each view."""
        return {view.view: view.sha256 for view in self.views}

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
    runs: tuple[EntryRun, ...] = Field(min_length=1, max_length=MAX_RUNS)

    @model_validator(mode="after")
    def _of_one_kind(self) -> MeasuredEntry:
        for name in KEY:
            if len({getattr(run.record, name) for run in self.runs}) > 1:
                raise ValueError(f"runs that differ in {name}")
        if len({run.record.seed for run in self.runs}) < len(self.runs):
            raise ValueError("a seed twice")
        if len({frozenset(view.view for view in run.scored) for run in self.runs}) > 1:
            raise ValueError("seeds with values of different views")
        for one, other in combinations(self.runs, 2):
            if {*one.images.items()} & {*other.images.items()}:
                seeds = f"{one.record.seed} and {other.record.seed}"
                raise ValueError(f"seeds {seeds} have the same image of a view")
        return self

    @property
    def key(self) -> tuple[Any, ...]:
        """Values that differ between entries."""
        return tuple(getattr(self.runs[0].record, name) for name in KEY)


def read_entry(path: Path) -> MeasuredEntry:
    """Read a measured entry.

    Raises:
        ConfigError: If it is anything else, or cannot be true.
    """
    try:
        if path.is_symlink():
            raise refused(path, "a link")
        if path.stat().st_size > MAX_BYTES:
            raise refused(path, f"more than {MAX_BYTES} bytes")
        return MeasuredEntry.model_validate_json(plain_file(path).read_bytes())
    except ValidationError as error:
        raise refused(path, reason_of(error)) from error
    except OSError as error:
        raise refused(path, error.strerror or str(error)) from error


def entry_files(folder: Path) -> list[Path]:
    """Return all files below a folder that should be entries, sorted."""
    return sorted(path for path in folder.rglob("*.json") if path.name != MANIFEST)


def predictions_folder(entry: Path, seed: int) -> Path:
    """Return where the predictions of a seed are, with their manifest: beside the entry."""
    return entry.with_suffix("") / f"seed{seed}"


def refused(place: Path, found: str) -> ConfigError:
    """Make the error of an entry that is refused."""
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


def _check_texts(record: RunRecord) -> None:
    for name in ("scene", "method", "title", "strategy", "preset"):
        if not _NAME.fullmatch(text := getattr(record, name)) or _WORDS.search(text):
            raise ValueError(f"{name} is no plain name: {text[:60]!r}")
    if record.strategy == EXTERNAL:
        raise ValueError("images of another program (score-images): name the runs of bench alone")
    if record.strategy not in STRATEGIES:
        raise ValueError(f"unknown strategy: {record.strategy}")
    if not _VARIANT.fullmatch(record.variant) or _WORDS.search(record.variant):
        raise ValueError(f"variant is no list of options: {record.variant[:60]!r}")
    if variant_options(record.variant).get("validation") == "true":
        raise ValueError("scores of validation views: run bench without --validation")
    if record.fitted:
        raise ValueError("scores of halves of photos: run bench without --fit-half")
    if record.protocol:
        _check_protocol(record)
    for name in ("scene_hash", "split_hash", "config_hash"):
        if not _HASH.fullmatch(getattr(record, name)):
            raise ValueError(f"{name} is no SHA-256")
    for leaf in _leaves(record.model_dump()):
        if isinstance(leaf, str) and (not leaf.isprintable() or "<" in leaf or len(leaf) > 1000):
            raise ValueError(f"a text with markup, control characters or too long: {leaf[:60]!r}")
    if len(record.device) > 200 or len(record.commit) > 100:  # several if it was resumed
        raise ValueError("a text too long: device or commit")


def _check_protocol(record: RunRecord) -> None:
    protocol = PROTOCOLS.get(record.protocol)
    if protocol is None:
        raise ValueError(f"unknown protocol: {record.protocol[:60]!r}")
    if record.strategy not in protocol.strategies or record.max_width != protocol.max_width:
        raise ValueError(f"another strategy or width than protocol {record.protocol} has")


def _check_numbers(record: RunRecord) -> None:
    for leaf in _leaves(record.model_dump()):
        if isinstance(leaf, int | float) and not abs(leaf) <= MAX_COST:  # NaN is refused, too
            raise ValueError(f"a number that cannot be: {str(leaf)[:20]}")
    for cost in COSTS:
        if (getattr(record, cost.name) or 0) < 0:
            raise ValueError(f"{cost.name} is negative")
    if record.max_width < 1:
        raise ValueError("max_width is not positive")


def _check_views(views: tuple[ScoredView, ...]) -> None:
    known = all_metrics()
    metrics = next((view.values.keys() for view in views if view.values), ())
    for view in views:
        if leads_out(view.view) or not view.view.isprintable() or len(view.view) > 200:
            raise ValueError("the name of a view leads out of its folder, or is no plain text")
        if view.values and view.values.keys() != metrics:
            raise ValueError("views with other metrics than the first one")
        if unknown := view.values.keys() - known.keys():
            raise ValueError(f"unknown metrics: {', '.join(sorted(unknown))[:100]!r}")
        for name, value in view.values.items():
            low, high = known[name].bounds
            if not low <= value <= high:
                raise ValueError(f"{name} that cannot be: {str(value)[:20]}")
    if len({view.view for view in views}) < len(views):
        raise ValueError("a view twice")


def _agree(claimed: Any, computed: Any) -> bool:
    """Return True if nested values have equal keys and, but for rounding, equal numbers."""
    if isinstance(claimed, dict):
        return claimed.keys() == computed.keys() and all(
            _agree(claimed[name], computed[name]) for name in claimed
        )
    if isinstance(claimed, tuple):
        return all(map(_agree, claimed, computed))
    return math.isclose(claimed, computed, rel_tol=1e-9, abs_tol=1e-12)
