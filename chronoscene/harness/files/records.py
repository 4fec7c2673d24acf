"""Record of a finished run, and the files that hold it.

``RUNS/<scene>/<method>-<strategy>-<preset>/seed<k>/run.json`` belongs to one run,
``RUNS/results.json`` is the list of all. Both are read back through `RunRecord`. Infinite values
(PSNR of equal images) are the string ``"Infinity"`` in JSON and ``inf`` in CSV.
"""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from chronoscene.errors import CheckpointError
from chronoscene.io.documents import plain_file, read_text
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.tables import csv_text
from chronoscene.methods import PeriodSharing

RUN_FILE = "run.json"
CONFIG_FILE = "config.json"
FAILURE_FILE = "failed.json"
ERROR_LOG = "error.log"
ROWS_FILE = "rows.csv"
CURVE_FILE = "curve.csv"
RESULTS_FILE = "results.json"
SOURCE_FILE = "source.json"
CHECKPOINT = "checkpoint"
TRAINING = "training"
PREDICTIONS = "predictions"
STAGES = "stages"
UNTRAINED = "untrained"
GROUND_TRUTH = "ground_truth"
PHOTOS = "photos"
FIGURES = "figures"
LOCKS = ".locks"  # Folder with a file for each run, and one for the summary


def _number(value: float) -> float:
    if math.isnan(value):
        raise ValueError("not a number")
    return value


Number = Annotated[float, AfterValidator(_number)]
PeriodId = Annotated[str, Field(pattern="^[0-9]{1,9}$")]
Values = dict[str, float]
Document = TypeVar("Document", bound=BaseModel)
Line = TypeVar("Line", bound="CurvePoint | ViewScore")


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """One line of ``curve.csv``. Seconds and iterations are those of the model named."""

    seconds: float
    iteration: int
    primitives: int
    psnr: float
    """Mean over the probe views, in dB."""
    parameters: int
    model: str


@dataclass(frozen=True, slots=True)
class ViewScore:
    """One value of one view."""

    view: str
    camera_period: int
    rendered_period: int
    region: str
    """One of `chronoscene.harness.score.regions.REGIONS`."""
    metric: str
    value: float


def size_of(folder: Path) -> int:
    """Sum the bytes of all files below a folder; 0 if there is none."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


class RunRecord(BaseModel):
    """One run: one method, strategy, scene and seed."""

    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="strings")

    method: str
    """Name on the command line."""
    strategy: str
    """Strategy that was run, which may differ from the one asked for; see `notices`."""
    scene: str
    seed: int
    aggregates: dict[str, dict[str, Number]]
    """``macro`` (mean over periods), ``micro`` (mean over views), ``worst`` (worst period)."""
    periods: dict[PeriodId, dict[str, Number]]
    """Mean over the views of each period, by period id."""
    regions: dict[str, dict[str, dict[str, dict[str, Number]]]] = {}
    """``changed`` and ``invariant`` to ``aggregates`` and ``periods`` of these parts of the images;
    empty where there are no change masks."""
    change_masks: str | None = None
    """Fingerprint of these masks."""
    stages: dict[str, dict[str, Values]] = {}
    """`periods` after each stage of ``sequential``, by the name of the stage; before the first one
    under `UNTRAINED`. A stage has the periods so far and the next one."""
    transfer: dict[str, Values] = {}
    """Effect of stages on earlier and later periods; see `chronoscene.harness.score.forgetting`."""
    seconds: Number | None
    """Training clock: setup and steps, without probes, rendering and scoring. None here and below:
    not measured; see `absent`."""
    iterations: int | None
    primitives: int | None
    primitive: str = "primitives"
    """Unit of `primitives`: ``Gaussians``, ``anchors``."""
    drawn: Number | None = None
    """Gaussians that touch a test view, mean over the views; None if the method does not say."""
    sharing: PeriodSharing | None = None
    """Account of what the periods share in the model."""
    checkpoint_bytes: int | None
    peak_memory_bytes: int | None
    """Largest resident memory of the process from the start of training to the end of rendering;
    None if it is unknown."""
    device: str
    commit: str
    skipped: dict[str, str]
    """Metric to the reason for its absence."""
    absent: dict[str, str] = {}
    """Cost, by the name of its field here, to the reason for its absence."""

    title: str
    """Name of the method in tables."""
    preset: str
    variant: str = ""
    """Options that differ from the preset, such as ``sh_degree=2``."""
    protocol: str = ""
    """Name in `PROTOCOLS` of the protocol that the run was made under, or empty."""
    fitted: str = ""
    """Part of each test photo that the appearance was fitted to, such as ``left half``, so that
    only the rest is scored; or empty."""
    method_version: str
    config_hash: str
    """Hash of everything that decides the result but scene, seed, device and threads."""
    scene_hash: str
    split_hash: str
    period_labels: dict[PeriodId, str]
    parameters: int | None
    """Numbers stored in the checkpoint."""
    warmup_seconds: float | None
    """Compiling and loading of kernels before the clock starts; not part of `seconds`."""
    empty_steps: int = 0
    """Steps whose view showed nothing of the model; nothing is learned from them."""
    skipped_steps: int = 0
    """Steps that changed nothing since their loss or a gradient was not finite."""
    resumed: int = 0
    """Number of times that the training was resumed from a checkpoint."""
    waited_seconds: float = 0.0
    """Waiting for photos that were not decoded yet, and pauses of the process; not part of
    `seconds`."""
    setup_seconds: float | None
    """Share of `seconds` before the first step."""
    render_seconds: Number | None
    """Mean time to render a test view, by the model as it was saved and loaded again."""
    peak_device_memory_bytes: int | None
    """Largest memory held on a GPU; None on a CPU."""
    threads: int | None
    max_width: int
    libraries: dict[str, str]
    started: str
    """Start of the process that finished the run; UTC, ISO 8601."""
    notices: list[str]
    rows: Sequence[ViewScore] = Field(default=(), exclude=True)
    """Content of ``rows.csv``, if it was read; not part of ``run.json``."""
    folder: Path = Field(default=Path(), exclude=True)
    """Folder of the run, known if `rows` are."""

    @property
    def label(self) -> str:
        """Name of the run, as `Job.label`."""
        names = (self.method, self.strategy, self.preset, self.variant)
        return f"{self.scene}: {' '.join(filter(None, names))} seed {self.seed}"


def variant_options(variant: str) -> dict[str, str]:
    """Return the options in a `RunRecord.variant`, with their values as text."""
    # A comma inside of a value is followed by no name.
    parts = filter(None, re.split(r",(?=\w+=)", variant))
    return dict(part.partition("=")[::2] for part in parts)


class _Decides(BaseModel):
    model_config = ConfigDict(extra="allow")

    method_config: dict[str, Any]


class _Config(BaseModel):
    """Content of ``config.json``: `ResolvedRun.document`, of which readers need this."""

    model_config = ConfigDict(extra="allow")

    config: _Decides


class Failure(BaseModel):
    """Reason for which a run ended without a result."""

    model_config = ConfigDict(extra="forbid")

    method: str
    strategy: str
    preset: str
    variant: str = ""
    scene: str
    seed: int
    reason: str


RUN_COLUMNS = (
    *("scene", "scene_hash", "split_hash", "method", "method_version"),
    *("strategy", "preset", "variant", "config_hash", "seed", "device"),
)
ROW_COLUMNS = tuple(field.name for field in fields(ViewScore))


def write_run(folder: Path, record: RunRecord, rows: Iterable[ViewScore]) -> None:
    """Write ``rows.csv`` and then ``run.json``, whose presence says that the run is complete."""
    shared = [getattr(record, name) for name in RUN_COLUMNS]
    table = [[*shared, *astuple(row)] for row in rows]
    write_text_atomic(folder / ROWS_FILE, csv_text((*RUN_COLUMNS, *ROW_COLUMNS), table))
    write_text_atomic(folder / RUN_FILE, record.model_dump_json(indent=1) + "\n")


def read_run(folder: Path) -> RunRecord:
    """Read ``run.json``.

    Raises:
        CheckpointError: If it is missing or damaged.
    """
    path = folder / RUN_FILE
    if not path.exists():
        found, todo = "no such file", "run bench first"
        patterns = [f"{'*/' * depth}seed*/{RUN_FILE}" for depth in range(3)]
        below = sorted(chain(*map(folder.glob, patterns)))
        if folder.is_file():
            found, todo = "a file in place of the folder", f"name {folder.parent}"
        elif (failure := read_failure(folder)) is not None:
            found, todo = f"a run that failed: {failure.reason}", "run bench again"
        elif below:
            found, todo = "a folder of runs", f"name one of them, such as {below[0].parent}"
        raise CheckpointError(path, expected="a finished run", found=found, todo=todo)
    return read_document(path, RunRecord, expected="a finished run")


def read_config(folder: Path) -> dict[str, Any]:
    """Read ``config.json``, as `ResolvedRun.document` was.

    Raises:
        CheckpointError: If it is missing or damaged.
    """
    path, todo = folder / CONFIG_FILE, "delete the run"
    return read_document(path, _Config, expected="the config of the run", todo=todo).model_dump()


def read_rows(folder: Path) -> list[ViewScore]:
    """Read ``rows.csv`` of one run.

    Raises:
        CheckpointError: If it is missing or damaged.
    """
    return read_lines(folder / ROWS_FILE, ViewScore, expected="the rows of a run")


def read_with_rows(folder: Path) -> RunRecord:
    """Read a finished run with the values of its views.

    Raises:
        CheckpointError: If a file is missing or damaged.
    """
    return read_run(folder).model_copy(update={"rows": read_rows(folder), "folder": folder})


def read_lines(path: Path, kind: type[Line], *, expected: str) -> list[Line]:
    """Read a CSV file with the fields of a dataclass among its columns.

    Raises:
        CheckpointError: If it is missing or damaged.
    """
    types = {"str": str, "int": int, "float": float}
    columns = [(field.name, types[str(field.type)]) for field in fields(kind)]
    try:
        with plain_file(path).open(encoding="utf-8", newline="") as file:
            lines = csv.DictReader(file)
            return [kind(*[convert(line[name]) for name, convert in columns]) for line in lines]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise CheckpointError(
            path,
            expected=expected,
            found=f"{type(error).__name__}: {error}",
            todo="delete the run and run bench again",
        ) from error


def read_document(
    path: Path,
    kind: type[Document],
    *,
    expected: str,
    found: str = "no such file",
    todo: str = "run bench again",
) -> Document:
    """Read a JSON file that this package wrote.

    Args:
        path: The file.
        kind: Its content.
        expected: For the message if it is missing, as ``found`` and ``todo``.

    Raises:
        CheckpointError: If it is missing or damaged.
    """
    try:
        return kind.model_validate_json(plain_file(path).read_bytes())
    except FileNotFoundError as error:
        raise CheckpointError(path, expected=expected, found=found, todo=todo) from error
    except OSError as error:
        raise damaged(path, error.strerror or str(error)) from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise damaged(path, f"{first['msg']} ({where})") from error


def damaged(path: Path, found: str) -> CheckpointError:
    """Make the error for a file that is not as it was written."""
    todo = "delete its folder and run bench again"
    return CheckpointError(path, expected="what bench wrote", found=found, todo=todo)


def run_folders(runs: Path) -> list[Path]:
    """Return the folders of all finished runs, sorted by path."""
    return sorted(p.parent for p in runs.glob(f"*/*/seed*/{RUN_FILE}") if _is_final(p.parent))


def no_runs(folder: Path, found: str = "no run in it") -> CheckpointError:
    """Make the error for a folder without runs; names the folder of runs that is near."""
    todo = "run bench first"
    for depth, inside in enumerate((f"*/seed*/{RUN_FILE}", f"seed*/{RUN_FILE}", RUN_FILE), 1):
        if any(folder.glob(inside)):
            todo = f"name {os.path.normpath(folder.joinpath(*[os.pardir] * depth))}"
    if below := sorted(folder.glob(f"*/*/*/seed*/{RUN_FILE}")):
        todo = f"name {below[0].parents[3]}"
    expected = "a folder of runs, with SCENE/METHOD/seed0 in it"
    return CheckpointError(folder, expected=expected, found=found, todo=todo)


def read_failures(runs: Path) -> list[Failure]:
    """Read the failures of all runs that failed when they were last tried."""
    folders = sorted(p.parent for p in runs.glob(f"*/*/seed*/{FAILURE_FILE}"))
    return [f for p in folders if _is_final(p) and (f := read_failure(p)) is not None]


def write_failure(folder: Path, failure: Failure) -> None:
    """Write ``failed.json``."""
    write_text_atomic(folder / FAILURE_FILE, failure.model_dump_json(indent=1) + "\n")


def read_failure(folder: Path) -> Failure | None:
    """Read the failure of the run in a folder; None if it did not fail."""
    path = folder / FAILURE_FILE
    return read_document(path, Failure, expected="a failure") if path.is_file() else None


def _is_final(folder: Path) -> bool:
    return folder.name.removeprefix("seed").isdigit()


def write_summary(runs: Path, damaged: dict[Path, str] | None = None) -> list[RunRecord]:
    """Write ``results.json`` and ``rows.csv`` of all finished runs below a folder.

    Commands that share the folder do so one after the other: the last one has the runs of all.

    Args:
        runs: The folder.
        damaged: Gets the runs that cannot be read, with the reason; they are left out, and without
            any other run nothing is written.

    Raises:
        CheckpointError: If a file of a run is missing or damaged, unless ``damaged`` is given.
    """
    from filelock import FileLock

    (runs / LOCKS).mkdir(parents=True, exist_ok=True)
    with FileLock(runs / LOCKS / "summary.lock"):
        records, lines = [], [",".join((*RUN_COLUMNS, *ROW_COLUMNS)) + "\n"]
        for folder in run_folders(runs):
            try:
                record = read_run(folder)
                rows = read_text(folder / ROWS_FILE, error=CheckpointError)
            except CheckpointError as error:
                if damaged is None:
                    raise
                damaged[folder] = str(error)
                continue
            records.append(record)
            lines += rows.splitlines(keepends=True)[1:]
        if records or not damaged:
            documents = [json.loads(record.model_dump_json()) for record in records]
            text = json.dumps(documents, indent=1, allow_nan=False) + "\n"
            write_text_atomic(runs / RESULTS_FILE, text)
            write_text_atomic(runs / ROWS_FILE, "".join(lines))
    return records


def write_summary_of_readable(runs: Path) -> dict[Path, str]:
    """Write the summary without damaged runs, none if there is no other; return why they are."""
    damaged: dict[Path, str] = {}
    if run_folders(runs):
        write_summary(runs, damaged)
    return damaged
