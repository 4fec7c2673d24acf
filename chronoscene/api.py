"""The public interface of ChronoScene in Python; ``import chronoscene as cs`` has all of it.

docs/guides/python-api.md shows it on a scene. Everything else in the package may change from one
version to the next.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from chronoscene.checks import check_choice
from chronoscene.errors import ChronoSceneError, ConfigError, SceneError
from chronoscene.formats import read_scene
from chronoscene.harness.files.records import (
    ROW_COLUMNS,
    ROWS_FILE,
    RUN_COLUMNS,
    Failure,
    read_with_rows,
)
from chronoscene.harness.plan.settings import PHOTO_MEMORY, bench_settings
from chronoscene.harness.plan.stop import parse_duration
from chronoscene.harness.report.summary import ENTRY_COLUMNS, summarise
from chronoscene.harness.run.runner import run_bench
from chronoscene.harness.score.views import PredictedView
from chronoscene.harness.use.trained_run import TrainedRun, open_run
from chronoscene.images.store import MAX_WIDTH
from chronoscene.io.log import Log
from chronoscene.methods import as_typed
from chronoscene.scene import Camera, Frame, Scene
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.statistics.counts import COUNT_RULES, CountRule
from chronoscene.statistics.measures import measure_scene
from chronoscene.validation.rule import SceneReport
from chronoscene.validation.rules import choose_rules
from chronoscene.validation.run import ReadOptions, find_folders, validate_scene

if TYPE_CHECKING:
    from pandas import DataFrame, Series

__all__ = [
    "BenchmarkResult",
    "Camera",
    "ChronoSceneError",
    "Frame",
    "GaussianCloud",
    "PredictedView",
    "Scene",
    "SceneReport",
    "Statistics",
    "TrainedRun",
    "bench",
    "open_run",
    "read_scene",
    "stats",
    "validate",
]


def validate(
    path: str | Path,
    *,
    select: str | Sequence[str] = (),
    ignore: str | Sequence[str] = (),
    decode: bool = False,
    format: str | None = None,
    period_by: str | None = None,
) -> SceneReport:
    """Check a scene folder as ``chronoscene validate`` does. Writes nothing.

    Args:
        path: Folder of one scene.
        select: Codes or names of the rules to run, such as ``CS201``, ``CS3`` or ``split-line``,
            or one of them; all if empty.
        ignore: Rules not to run.
        decode: Decode all images, which finds damaged and duplicate ones but takes time.
        format: Name of the dataset format; None to detect it.
        period_by: Grouping of images into periods, for formats with a choice.

    Returns:
        The report; ``report.is_valid`` is true if there are no errors.

    Raises:
        SceneError: If there is no scene in the folder, or several.
        ConfigError: If a rule, the format or the grouping is unknown.

    Example:
        >>> report = validate("data/plaza")
        >>> [f"{f.code} {f}" for f in report.findings if f.severity == "error"]
    """
    path = Path(path)
    rules = choose_rules(_several(select), _several(ignore))
    if (found := find_folders(path)) != [path]:
        raise SceneError(
            path,
            expected="the folder of one scene",
            found=f"a folder of {len(found)} scenes",
            todo="validate them one by one",
        )
    return validate_scene(path, rules=rules, decode=decode, options=ReadOptions(format, period_by))


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Contents of a scene as pandas tables. Made by `stats`."""

    periods: DataFrame
    """One row per period: ``label``, ``date``, ``images``, ``train``, ``test``, ``points`` and the
    fields of `chronoscene.statistics.measures.Measures`. NaN or None where nothing is measured."""
    whole: Series
    """The same quantities of the whole scene."""
    overlap: DataFrame
    """Share of the points seen in a period (row) that another one (column) sees, too. 0..1"""
    in_view: DataFrame
    """Share of the points seen in a period (row) that lie in view of the cameras of another one
    (column). 0..1"""
    unit: str
    """Unit of the world: ``metre`` or ``unknown``."""


def stats(
    scene: Scene | str | Path,
    *,
    count: CountRule = "assigned",
    format: str | None = None,
    period_by: str | None = None,
) -> Statistics:
    """Measure a scene as ``chronoscene stats`` does.

    Args:
        scene: A scene, or the folder of one.
        count: ``assigned`` counts each point once, in the period with most observations of it;
            ``seen`` counts it in every period whose images see it.
        format: Name of the dataset format of a folder; None to detect it.
        period_by: Grouping of images into periods, for formats with a choice.

    Raises:
        SceneError: If the folder cannot be read.
        ConfigError: If an argument has an unknown value.

    Example:
        >>> stats("data/plaza").periods[["images", "points", "track_mean"]]
    """
    import pandas as pd

    check_choice("count", count, COUNT_RULES)
    if not isinstance(scene, Scene):
        scene = read_scene(scene, format=format, period_by=period_by)
    found = measure_scene(scene, count=count)
    counts = [asdict(period) for period in found.counts.periods]
    measures = [asdict(measured) for measured in found.periods]
    rows = [a | b for a, b in zip(counts, measures, strict=True)]
    periods = pd.DataFrame(rows).set_index("id").rename_axis("period")
    sums = {name: sum(row[name] for row in counts) for name in ("images", "train", "test")}
    return Statistics(
        periods=periods,
        whole=pd.Series({**sums, "points": found.counts.points, **asdict(found.whole)}),
        overlap=_between(periods, found.overlap),
        in_view=_between(periods, found.in_view),
        unit=found.unit,
    )


def _between(periods: DataFrame, shares: Sequence[Sequence[float | None]]) -> DataFrame:
    """Return a table of all pairs of periods."""
    import pandas as pd

    return pd.DataFrame(shares, periods.index, periods.index, dtype=float)


@dataclass(frozen=True, slots=True)
class BenchmarkResult:
    """Finished and failed runs of `bench`."""

    runs: tuple[Path, ...]
    """Folders of the finished runs, which `open_run` takes."""
    failures: tuple[Failure, ...]
    """Runs without a result; ``failure.reason`` names the error."""

    def table(self, metrics: str | Sequence[str] = ()) -> DataFrame:
        """Return means over seeds with spread and intervals, as ``chronoscene table`` shows them.

        Args:
            metrics: Names of the metrics wanted, or one of them; all if empty.

        Returns:
            One row per scene, method, quantity and column (``period 0``, ``macro``, ...);
            `chronoscene.harness.report.summary.ENTRY_COLUMNS` describes the columns.
        """
        records = [read_with_rows(folder) for folder in self.runs]
        return summarise(records, _several(metrics))[[*ENTRY_COLUMNS]]

    def rows(self) -> DataFrame:
        """Return the values of single test views: one row per run, view, region and metric."""
        import pandas as pd

        # Names stay text, also those that are numbers, and an empty variant stays empty.
        numbers = {"seed": int, "camera_period": int, "rendered_period": int, "value": float}
        kinds = dict.fromkeys((*RUN_COLUMNS, *ROW_COLUMNS), str) | numbers
        read = partial(pd.read_csv, dtype=kinds, keep_default_na=False)
        tables = [read(folder / ROWS_FILE) for folder in self.runs]
        return pd.concat(tables or [pd.DataFrame(columns=[*kinds])], ignore_index=True)


def bench(
    scenes: str | Path | Sequence[str | Path],
    methods: str | Sequence[str],
    *,
    out: str | Path,
    preset: str | Path = "balanced",
    iterations: int | None = None,
    budget: str | float | None = None,
    seeds: Sequence[int] = (0,),
    strategies: str | Sequence[str] = (),
    overrides: Mapping[str, object] | None = None,
    max_width: int = MAX_WIDTH,
    validation: bool = False,
    validation_seed: int = 0,
    fit_half: bool = False,
    device: str = "auto",
    threads: int | None = None,
    jobs: int | None = None,
    photo_memory: float = PHOTO_MEMORY / 1e9,
    overwrite: bool = False,
    format: str | None = None,
    period_by: str | None = None,
    log: Log | None = None,
) -> BenchmarkResult:
    """Train methods on scenes, render the test views and score them, as ``chronoscene bench`` does.

    Finished runs in ``out`` are kept, so the same call resumes after an interruption. Each run is
    trained in a process of its own.

    Args:
        scenes: Folders of scenes, or of folders that have scenes in them; or one of them.
        methods: Names, or ``module:SPEC``.
        out: Folder of runs.
        preset: Preset of the methods, or the path of a preset file.
        iterations: Training steps; None for those of the preset.
        budget: End of the training by the clock: seconds, or a text such as ``5m``. Schedules
            follow the clock then, and equal seeds do not give equal models.
        seeds: Each method is trained once per seed.
        strategies: One or several of ``joint``, ``pooled``, ``separate`` and ``sequential``; none
            for that of each method.
        overrides: Options of the methods: ``key`` for all methods, ``method.key`` for one.
        max_width: Wider images are scaled down to this width in pixels.
        validation: Hold blocks of the training views back and score these; test views are not read.
        validation_seed: Seed of the choice of these blocks.
        fit_half: Fit the appearance of each test view to the left half of its photo, and score the
            right half.
        device: ``auto``, ``cpu`` or ``cuda``.
        threads: Threads per run; None for all cores.
        jobs: Number of runs at a time; None for one.
        photo_memory: Memory of a run for training photos in GB, including their decoding.
        overwrite: Replace finished runs and unfinished trainings that have other settings.
        format: Name of the dataset format of the scenes; None to detect it.
        period_by: Grouping of images into periods, for formats with a choice.
        log: Function that takes a line about each step of the plan; None for none. The progress of
            each training goes to standard error in any case.

    Raises:
        ChronoSceneError: If anything asked for is wrong; nothing is trained then. Failures during
            a run are in the result instead.

    Example:
        >>> result = bench("data/plaza", ["chronogs", "3dgs"], out="runs", budget="90s")
        >>> result.table(["psnr"])
    """
    if isinstance(seeds, int | str):
        raise ConfigError(
            "seeds", expected="seeds such as [0] or range(3)", found=repr(seeds), todo="list them"
        )
    scenes = [scenes] if isinstance(scenes, str | Path | Scene) else scenes
    for scene in scenes:
        if isinstance(scene, Scene):
            todo = f"name {scene.root}, with format and period_by if it was read with these"
            raise ConfigError("scenes", expected="folders", found="a Scene", todo=todo)
    folders = [Path(scene) for scene in scenes]
    methods, seeds = _several(methods), tuple(seeds)
    for name, given in (("scenes", folders), ("methods", methods), ("seeds", seeds)):
        if not given:
            raise ConfigError(name, expected="at least one", found="none", todo="name some")
    settings = bench_settings(
        folders,
        methods,
        Path(out),
        preset=str(preset),
        overrides={key: as_typed(value) for key, value in (overrides or {}).items()},
        iterations=iterations,
        budget_seconds=parse_duration(budget, "budget") if isinstance(budget, str) else budget,
        max_width=max_width,
        validation=validation,
        validation_seed=validation_seed,
        fit_half=fit_half,
        threads=threads,
        device=device,
        strategies=_several(strategies),
        seeds=seeds,
        dataset_format=format,
        period_by=period_by,
        overwrite=overwrite,
        jobs=jobs,
        photo_memory=round(photo_memory * 1e9),
    )
    outcome = run_bench(settings, log or (lambda line: None))
    return BenchmarkResult(outcome.finished, outcome.failures)


def _several(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)
