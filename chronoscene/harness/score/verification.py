"""Finished runs checked against their own images: every score computed again, nothing written.

Scores are deterministic: on the machine that computed them they come out equal to the bit. Other
versions of the libraries of floating-point numbers may differ in the last digits, so values agree
within `TOLERANCE`.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, make_dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from chronoscene.compression.file import COMPRESSED_FILE, META_FILE, TENSOR_FILE
from chronoscene.errors import CheckpointError, ChronoSceneError, MetricUnavailableError
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import MANIFEST, read_manifest
from chronoscene.harness.files.provenance import config_hash
from chronoscene.harness.files.records import (
    CHECKPOINT,
    CONFIG_FILE,
    PREDICTIONS,
    RESULTS_FILE,
    ROWS_FILE,
    RUN_COLUMNS,
    RUN_FILE,
    STAGES,
    RunRecord,
    ViewScore,
    no_runs,
    read_config,
    read_lines,
    read_with_rows,
    run_folders,
    size_of,
)
from chronoscene.harness.files.strategies import STRATEGIES, period_part
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.scoring import (
    check_installed,
    metrics_of,
    put_scores,
    score_folder,
    score_stages,
)
from chronoscene.io.documents import read_json_document
from chronoscene.io.processes import Report
from chronoscene.io.staging import sha256_of
from chronoscene.metrics.registry import Scorers, all_metrics, make_scorers

TOLERANCE = 1e-6
"""Largest difference of numbers that agree, relative to the larger one if that is above 1."""
IDENTITY = ("scene", "method", "strategy", "preset", "variant", "seed")
"""Fields of `RunRecord` that name a run in a folder of runs."""
SCORES = ("aggregates", "periods", "regions", "change_masks", "stages", "transfer")
"""Fields of `RunRecord` that follow from the images."""
NOTHING = "nothing"  # In place of a value that is not there

_SummaryRow = make_dataclass(
    "_SummaryRow", [(name, "str") for name in RUN_COLUMNS], bases=(ViewScore,), frozen=True
)


class Difference(NamedTuple):
    """A place at which a file does not say what was computed."""

    place: str
    stored: Any
    computed: Any

    @property
    def size(self) -> float:
        """Absolute difference of two numbers; infinite for anything else."""
        stored, computed = _number(self.stored), _number(self.computed)
        return math.inf if stored is None or computed is None else abs(stored - computed)

    @property
    def agrees(self) -> bool:
        """True for numbers within `TOLERANCE`; different integers never agree."""
        if isinstance(self.stored, int) and isinstance(self.computed, int):
            return False
        size = self.size
        if not math.isfinite(size):
            return False
        return size <= TOLERANCE * max(1.0, abs(self.stored), abs(self.computed))


@dataclass(slots=True)
class Verified:
    """Outcome for a run, for what a file says of one, or for an entry of the leaderboard."""

    label: str
    views: int = 0
    metrics: tuple[str, ...] = ()
    """Metrics that were computed again."""
    unchecked: dict[str, str] = field(default_factory=dict)
    """Metric, or whatever could not be compared, to the reason."""
    largest: float = 0.0
    """Largest difference between two numbers that were compared."""
    differs: list[str] = field(default_factory=list)
    """First difference of each file."""
    absent: list[str] = field(default_factory=list)
    """Files and values that are missing."""
    record: RunRecord | None = None
    """With scores and rows as computed; those of unchecked metrics are as stored."""
    images: dict[str, str] = field(default_factory=dict)
    """View to the SHA-256 of its prediction."""

    @property
    def verdict(self) -> str:
        """``differs``, ``incomplete``, ``unchecked`` if nothing was compared, or ``ok``."""
        if self.differs or self.absent:
            return "differs" if self.differs else "incomplete"
        return "unchecked" if self.unchecked and not self.metrics else "ok"

    def compare(self, file: str, stored: Any, computed: Any) -> None:
        """Compare nested values of a file with what they should be."""
        found = [*differences(stored, computed)]
        self.largest = max([self.largest, *(d.size for d in found if math.isfinite(d.size))])
        if wrong := [difference for difference in found if not difference.agrees]:
            place, old, new = wrong[0]
            more = f"; {len(wrong) - 1} more in this file" if len(wrong) > 1 else ""
            self.differs.append(f"{file}: {place}: expected {new}, found {old}{more}")

    def attempt(self, check: Callable[[], None]) -> None:
        """Run a check; an error of it becomes a finding."""
        try:
            check()
        except (ChronoSceneError, OSError) as error:
            gone = isinstance(error, FileNotFoundError | MetricUnavailableError)
            found = getattr(error, "found", "")
            gone |= found in ("no such file", "nothing") or found.startswith("FileNotFound")
            (self.absent if gone else self.differs).append(str(error))


def verify(
    runs: Path, *, lpips_weights: Path | None = None, progress: Report | None = None
) -> list[Verified]:
    """Check all finished runs of a folder, or a single one, and what the files of all runs say.

    Args:
        runs: Folder of runs, or of one run.
        lpips_weights: As for `make_scorers`.
        progress: Told how many runs are done.

    Raises:
        CheckpointError: If there is no finished run.
        MetricUnavailableError: If the user named weights that cannot be used.
    """
    single = (runs / RUN_FILE).is_file()
    folders = [runs] if single else run_folders(runs)
    if not folders:
        raise no_runs(runs, "no finished run in it")
    summary = Summary(runs.resolve().parents[2] if single else runs)
    found = [Verified(str(folder)) for folder in folders]
    for run, folder in zip(found, folders, strict=True):
        run.attempt(partial(_read, run, folder))
    recorded = {name for run in found if run.record for name in metrics_of(run.record)}
    scorers = make_scorers(recorded & all_metrics().keys(), lpips_weights=lpips_weights)
    for number, (run, folder) in enumerate(zip(found, folders, strict=True)):
        if progress is not None:
            progress("check runs", number, len(folders))
        if run.record is not None:
            _verify_run(run, folder, run.record, summary, scorers)
    return found if single else [*found, *summary.without_run(found)]


def _read(run: Verified, folder: Path) -> None:
    run.record = read_with_rows(folder)


def _verify_run(
    run: Verified, folder: Path, record: RunRecord, summary: Summary, scorers: Scorers
) -> None:
    """Compare everything about a run that can be computed with what its files say."""
    truth = ground_truth_folder(summary.runs, record.scene)
    run.attempt(lambda: _check_config(run, folder, record))
    run.attempt(lambda: _check_model(run, folder, record))
    run.attempt(lambda: _check_scores(run, folder, record, truth, scorers))
    if run.record is not record:  # scores were computed
        for file, check in ((RESULTS_FILE, summary.check_results), (ROWS_FILE, summary.check_rows)):
            if (summary.runs / file).is_file():
                run.attempt(partial(check, run))
            else:
                run.absent.append(f"{summary.runs / file}; chronoscene score writes it")


def _check_config(run: Verified, folder: Path, record: RunRecord) -> None:
    document = read_config(folder)
    config = document["config"]
    names = ("method", "preset", "strategy", "max_width")
    computed = {name: getattr(record, name) for name in ("scene", "scene_hash", "seed")}
    computed |= {"config_hash": config_hash(config)}
    computed |= {"config": {name: getattr(record, name) for name in names}}
    stored = {name: document.get(name, NOTHING) for name in computed}
    stored |= {"config": {name: config.get(name, NOTHING) for name in names}}
    run.compare(CONFIG_FILE, stored, computed)
    hashes = {"config_hash": record.config_hash}, {"config_hash": computed["config_hash"]}
    run.compare(RUN_FILE, *hashes)


def _check_model(run: Verified, folder: Path, record: RunRecord) -> None:
    """Compare the size of the model, and hashes in its description."""
    if record.checkpoint_bytes is None:  # of another program
        return
    model = folder / CHECKPOINT
    if record.strategy in STRATEGIES and STRATEGIES[record.strategy].in_order:
        model /= period_part(len(record.period_labels) - 1)
    if not model.is_dir():
        raise CheckpointError(
            model, expected="the model", found="no such file", todo="run bench again"
        )
    stored = {"checkpoint_bytes": record.checkpoint_bytes}
    run.compare(RUN_FILE, stored, {"checkpoint_bytes": size_of(model)})
    for path in sorted(model.rglob(META_FILE)):
        stored = read_json_document(path, error=CheckpointError, todo="run bench again")
        if "tensors_sha256" in stored:  # written by this package
            whole = path.with_name(TENSOR_FILE)
            file = whole if whole.is_file() else path.with_name(COMPRESSED_FILE)
            same = {"tensors_sha256": stored["tensors_sha256"]}
            run.compare(str(path), same, {"tensors_sha256": sha256_of(file)})


def _check_scores(
    run: Verified, folder: Path, record: RunRecord, truth: Path, scorers: Scorers
) -> None:
    """Score the predictions again, as ``chronoscene score`` does, and compare."""
    manifest = read_manifest(folder / PREDICTIONS)
    run.images = {image.view: image.sha256 for image in manifest.images}
    run.views = len(run.images)
    names = {"method", "strategy", "seed"} & manifest.details.keys()
    run.compare(
        f"{PREDICTIONS}/{MANIFEST}",
        {"scene_hash": manifest.scene_hash, "details": {n: manifest.details[n] for n in names}},
        {"scene_hash": record.scene_hash, "details": {n: getattr(record, n) for n in names}},
    )
    computed = _score_again(run, folder, record, truth, scorers)
    run.compare(ROWS_FILE, _by_place(record.rows), _by_place(computed.rows))
    stored, scores = (json.loads(r.model_dump_json(include={*SCORES})) for r in (record, computed))
    run.compare(RUN_FILE, stored, scores)
    run.record = computed


def _score_again(
    run: Verified, folder: Path, record: RunRecord, truth: Path, scorers: Scorers
) -> RunRecord:
    """Return the record with scores and rows as computed; unchecked metrics keep their values."""
    recorded = metrics_of(record)
    check_installed(folder, recorded)
    functions = {name: f for name, f in scorers.functions.items() if name in recorded}
    run.metrics = tuple(functions)
    run.unchecked = {name: scorers.skipped[name] for name in sorted(recorded - functions.keys())}
    if run.unchecked and not functions:
        run.absent.append(f"{folder}: no metric that can be computed here")
    known = Scorers(functions, {})
    scores = score_folder(folder / PREDICTIONS, truth, known, fitted=record.fitted)
    # Regions may have been scored by some of the metrics only.
    parts = {(row.region, row.metric) for row in record.rows}
    parts |= {(ALL, name) for name in recorded}
    for region, part in record.regions.items():
        parts |= {(region, name) for name in part.get("aggregates", {}).get("macro", {})}
    rows = [row for row in scores.rows if (row.region, row.metric) in parts]
    rows += [row for row in record.rows if row.metric in run.unchecked]
    computed = record.model_copy(deep=True)
    put_scores(computed, replace(scores, rows=tuple(rows)))
    computed.skipped, computed.rows = record.skipped, rows
    if record.stages and not (folder / STAGES).is_dir():
        raise CheckpointError(
            folder / STAGES,
            expected="the predictions of each stage",
            found="no such file",
            todo="run bench again",
        )
    score_stages(folder, computed, truth, known)
    return computed


def _by_place(rows: Iterable[ViewScore]) -> dict[str, float]:
    """Values of rows by what they are of; their number is the last value."""
    rows = list(rows)
    values = {
        f"{row.metric} of {row.view} as of period {row.rendered_period}, "
        f"taken in {row.camera_period}, {row.region}": row.value
        for row in rows
    }
    return values | {"number of rows": len(rows)}


class Summary:
    """The files of all runs: ``results.json`` and ``rows.csv``."""

    def __init__(self, runs: Path) -> None:
        self.runs = runs

    @cached_property
    def results(self) -> dict[tuple[str, ...], list[Any]]:
        """Objects of ``results.json``, by what names their run."""
        path, found = self.runs / RESULTS_FILE, defaultdict(list)
        todo = "write it again with chronoscene score"
        for document in read_json_document(path, list, error=CheckpointError, todo=todo):
            stored = _completed(document)
            named = stored if isinstance(stored, dict) else {}
            found[tuple(str(named.get(name, "")) for name in IDENTITY)].append(stored)
        return dict(found)

    @cached_property
    def rows(self) -> dict[tuple[str, ...], list[ViewScore]]:
        """Lines of ``rows.csv`` by run."""
        path, found = self.runs / ROWS_FILE, defaultdict(list)
        row: Any
        for row in read_lines(path, _SummaryRow, expected="the rows of all runs"):
            found[tuple(getattr(row, name) for name in RUN_COLUMNS)].append(row)
        return dict(found)

    def check_results(self, run: Verified) -> None:
        """Compare the object of a run with its computed record."""
        assert run.record is not None
        stored = self.results.get(_identity(run.record), [])
        if not stored:
            run.absent.append(f"{RESULTS_FILE}: no such run")
            return
        document = json.loads(run.record.model_dump_json())
        run.compare(RESULTS_FILE, stored, [document])

    def check_rows(self, run: Verified) -> None:
        """Compare the lines of a run with its computed rows."""
        record = run.record
        assert record is not None
        rows = self.rows.get(tuple(str(getattr(record, name)) for name in RUN_COLUMNS), [])
        if record.rows and not rows:
            run.absent.append(f"{ROWS_FILE} of all runs: no line of this run")
            return
        run.compare(f"{ROWS_FILE} of all runs", _by_place(rows), _by_place(record.rows))

    def without_run(self, found: Iterable[Verified]) -> Iterator[Verified]:
        """Yield results of runs that are not there."""
        there = {_identity(run.record) for run in found if run.record is not None}
        try:
            names = [" ".join(filter(None, key)) for key in self.results if key not in there]
        except (ChronoSceneError, OSError):  # every run has said it
            return
        for name in names:
            absent = ["no folder of such a run that can be read"]
            yield Verified(f"{self.runs / RESULTS_FILE}: {name}", absent=absent)


def _completed(document: Any) -> Any:
    """Fill in fields that an earlier version did not write; what is no record is left as it is."""
    try:
        record = RunRecord.model_validate_json(json.dumps(document))
    except ValidationError:
        return document
    return json.loads(record.model_dump_json())


def _identity(record: RunRecord) -> tuple[str, ...]:
    return tuple(str(getattr(record, name)) for name in IDENTITY)


def differences(stored: Any, computed: Any, place: str = "") -> Iterator[Difference]:
    """Yield the places at which two nested values are not equal."""
    if isinstance(stored, dict) and isinstance(computed, dict):
        for name in dict.fromkeys([*computed, *stored]):
            inner = f"{place}.{name}" if place else str(name)
            yield from differences(stored.get(name, NOTHING), computed.get(name, NOTHING), inner)
    elif isinstance(stored, list) and isinstance(computed, list) and len(stored) == len(computed):
        for number, pair in enumerate(zip(stored, computed, strict=True)):
            yield from differences(*pair, f"{place}[{number}]" if place else "")
    elif stored != computed:
        yield Difference(place or "its runs", stored, computed)


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None
