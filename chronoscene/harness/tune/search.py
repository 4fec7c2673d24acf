"""Trials of a search, one after the other or several at a time, and what is kept of them."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chronoscene.checks import import_extra
from chronoscene.errors import ConfigError
from chronoscene.harness.files import records
from chronoscene.harness.files.predictions import MANIFEST
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.harness.files.source import read_bench_scene
from chronoscene.harness.plan.finished import first_difference
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.plan import Plan, plan_runs
from chronoscene.harness.plan.resolve import (
    ResolvedMethod,
    deciding_options,
    resolve_method,
    resolve_methods,
)
from chronoscene.harness.plan.settings import BenchSettings
from chronoscene.harness.run.local_pool import LocalPool, Pool, open_pool
from chronoscene.harness.run.progress import RunsDisplay
from chronoscene.harness.run.runner import BenchOutcome, Execute, run_plan
from chronoscene.harness.tune.report import TrialResult, best_of, read_results, write_report
from chronoscene.io.log import Log
from chronoscene.io.staging import alone_in
from chronoscene.methods import as_typed, load_spec
from chronoscene.methods.options import idle_options
from chronoscene.methods.search_space import draw, starting_point

if TYPE_CHECKING:
    from optuna.study import Study
    from optuna.trial import Trial

JOURNAL = "study.journal"
TRIALS = "trials"
SETTINGS = "settings"
"""Attribute of the study."""
REFUSALS = 20
"""Trials in a row whose options the method refuses, after which a search ends."""


@dataclass(frozen=True, slots=True)
class _Search:
    """A search that is open."""

    settings: BenchSettings
    """Settings of a trial, but for its folder and its options."""
    out: Path
    method: ResolvedMethod
    seed: int
    splits: int
    study: Study
    about: dict[str, Any]
    """Values that identify the search: one with others needs another folder."""

    def results(self) -> list[TrialResult]:
        """Write the report; return the trials that have ended."""
        results = read_results(self.study, self.method)
        write_report(results, self.method, self.about, self.out)
        return results

    def folder(self, trial: Trial) -> Path:
        """Return the folder of a trial."""
        return self.out / TRIALS / f"{trial.number:03d}"

    def places(self, trial: Trial) -> list[Path]:
        """Return the folders of runs of a trial, one for each choice of views."""
        folder = self.folder(trial)
        return [folder / str(i) for i in range(self.splits)] if self.splits > 1 else [folder]

    def benches(self, trial: Trial) -> list[BenchSettings]:
        """Return the settings of the benches of a trial, one for each choice of views."""
        drawn = draw(trial, self.method.spec, self.method.config)
        overrides = {name: as_typed(value) for name, value in drawn.items()}
        run = replace(self.settings.run, overrides=overrides)
        return [
            replace(self.settings, run=replace(run, runs=place, validation_seed=seed))
            for seed, place in enumerate(self.places(trial))
        ]


def tune(
    settings: BenchSettings,
    trials: int,
    log: Log,
    *,
    splits: int = 1,
    execute: Execute | None = None,
) -> list[TrialResult]:
    """Search for options with the best mean PSNR on validation views.

    Equal arguments give equal trials, one at a time. A search that was killed goes on where it
    was, as does one whose number of trials is raised.

    Args:
        settings: One method, strategy and seed; scenes, preset, machine; its folder of runs becomes
            that of the search.
        trials: Number of trials in all, failed ones among them. The first is the preset as it is.
        log: Called with lines for the user.
        splits: Number of choices of validation views. Each trial trains each scene with all of
            them, and its score is the mean.
        execute: As for `run_bench`.

    Returns:
        All trials. ``trials.csv`` in the folder has them, and ``preset.toml`` the best one.

    Raises:
        ConfigError: If Optuna is missing, the method has no search space, the folder has a search
            with other settings, no trial has a result, or the method refuses the options of
            `REFUSALS` trials in a row.
        ChronoSceneError: As for `run_bench`.
    """
    out = settings.run.runs
    out.mkdir(parents=True, exist_ok=True)
    with alone_in(out, "--out"):
        search = _open(settings, splits, out, log)
        missing = trials - sum(trial.state.is_finished() for trial in search.study.trials)
        if missing > 0:
            _run_trials(search, trials, missing, log, execute)
        results = search.results()
    if best_of(results) is None:
        raise ConfigError(
            f"tune {search.method.spec.name}",
            expected="a trial with a result",
            found=f"none; the first one ended so: {results[0].failure}",
            todo="correct that, and choose another folder with --out",
        )
    return results


def _open(settings: BenchSettings, splits: int, out: Path, log: Log) -> _Search:
    """Open the study of a folder, or begin it with the preset as its first trial."""
    optuna = import_extra("optuna", "tune", "chronoscene tune")
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    settings = replace(settings, run=replace(settings.run, validation=True))
    (reference,), (seed,), run = settings.methods, settings.seeds, settings.run
    method = resolve_method(reference, load_spec(reference), run)
    strategies = settings.strategies or (method.spec.strategy,)
    settings = replace(settings, strategies=strategies)
    searched = dict(method.spec.search)
    for name, needed in idle_options(method.config).items():
        if searched.pop(name, None) is not None:
            log(f"{name} is not searched: it has no effect without {needed}")
    method = replace(method, spec=replace(method.spec, search=searched))
    start = starting_point(method.spec, method.config)
    ours = _about(settings, method, log) | {"splits": splits}
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = JournalStorage(JournalFileBackend(str(out / JOURNAL)))
    study = optuna.create_study(
        storage=storage, study_name="tune", direction="maximize", load_if_exists=True
    )
    stored = study.user_attrs.get(SETTINGS)
    if stored is None:
        study.set_user_attr(SETTINGS, ours)
    elif (known := {"splits": 1} | stored) != ours:  # searches of earlier versions do not say it
        old, new = first_difference(known, ours)
        raise ConfigError(
            f"--out {out}",
            expected=f"a search with {new}",
            found=f"one with {old}",
            todo="choose another folder",
        )
    if not study.trials:
        study.enqueue_trial(start)
    return _Search(settings, out, method, seed, splits, study, ours)


def _about(settings: BenchSettings, method: ResolvedMethod, log: Log) -> dict[str, Any]:
    """Return the values that identify a search, in the form in which they are read again."""
    scenes = []
    for found in settings.scenes:
        log(f"read {found.path}")
        scene = read_bench_scene(found, validation=True)
        held = len(scene.select(split="test"))
        log(f"{scene.name}: {held} of {len(scene.frames)} training views are held back")
        scenes.append({"name": scene.name, "hash": scene_hash(scene)})
    about = {
        "method": method.spec.name,
        "preset": settings.run.preset_name,
        "iterations": method.config.iterations,
        "options": deciding_options(method.config),
        "space": {
            name: list(space) if isinstance(space, tuple) else [space.low, space.high, space.kind]
            for name, space in method.spec.search.items()
        },
        "scenes": scenes,
        "strategy": settings.strategies[0],
        "max_width": settings.run.max_width,
        "seed": settings.seeds[0],
    }
    found_again: dict[str, Any] = json.loads(json.dumps(about))
    return found_again


def _run_trials(
    search: _Search, trials: int, missing: int, log: Log, execute: Execute | None
) -> None:
    queue = islice(_queue(search, trials), missing)  # more may be left if several ran at a time
    under_way: dict[Future[list[BenchOutcome]], Trial] = {}
    with open_pool(search.settings) as opened:
        pool = opened or LocalPool(1)
        total = missing * len(search.settings.scenes) * search.splits
        with RunsDisplay(total, log) as display, ThreadPoolExecutor(pool.at_once) as threads:
            accepted = _accepted(search, queue, display.log)
            try:
                while True:
                    while len(under_way) < pool.at_once and (ready := next(accepted, None)):
                        trial, benches = ready
                        plans = [(plan_runs(bench, _silent), bench) for bench in benches]
                        future = threads.submit(_run, plans, pool, display, execute)
                        under_way[future] = trial
                    if not under_way:
                        return
                    for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                        outcomes = future.result()
                        finished = [run for one in outcomes for run in one.finished]
                        reasons = [failure.reason for one in outcomes for failure in one.failures]
                        _finish(search, under_way.pop(future), finished, reasons, display.log)
            except BaseException:
                pool.stop.ask()
                raise


def _accepted(
    search: _Search, queue: Iterable[Trial], log: Log
) -> Iterator[tuple[Trial, list[BenchSettings]]]:
    """Yield trials with their settings; those whose options the method refuses have failed."""
    refusals = 0
    for trial in queue:
        benches = search.benches(trial)
        try:
            resolve_methods(benches[0].methods, benches[0].run)
        except ConfigError as error:
            refusals += 1
            _finish(search, trial, (), [str(error)], log)
            if refusals == REFUSALS:
                raise ConfigError(
                    f"tune {search.method.spec.name}",
                    expected="a search space whose options the method takes",
                    found=f"{REFUSALS} refusals in a row; the last one: {error}",
                    todo="narrow the search space in its MethodSpec, and choose another folder "
                    "with --out",
                ) from error
        else:
            refusals = 0
            yield trial, benches


def _silent(line: str) -> None:
    """Drop a line: the display has its own."""


def _queue(search: _Search, trials: int) -> Iterator[Trial]:
    """Yield trials to run: first those that a killed search has left, then new ones.

    Each has a sampler of its own, seeded by its number, so that a search that goes on draws what it
    would have drawn.
    """
    import optuna

    study, running = search.study, optuna.trial.TrialState.RUNNING
    left = [trial for trial in study.trials if trial.state == running]
    begun = sum(trial.state != optuna.trial.TrialState.WAITING for trial in study.trials)
    for number in (*(trial.number for trial in left), *range(begun, trials)):
        seed = int(np.random.SeedSequence([search.seed, number]).generate_state(1)[0])
        study.sampler = optuna.samplers.TPESampler(seed=seed)
        if number < begun:
            yield optuna.trial.Trial(study, study.trials[number]._trial_id)
        else:
            yield study.ask()


def _run(
    plans: Sequence[tuple[Plan, BenchSettings]],
    pool: Pool,
    display: RunsDisplay,
    execute: Execute | None,
) -> list[BenchOutcome]:
    """Run the benches of a trial, in a thread of its own."""

    def in_pool(job: Job) -> records.Failure | None:
        with display.showing() as report:
            if (failure := pool.run(job, report)) is not None:
                display.leave_out(report)
        return failure

    return [run_plan(*planned, _silent, execute=execute or in_pool) for planned in plans]


def _finish(
    search: _Search, trial: Trial, finished: Sequence[Path], reasons: Sequence[str], log: Log
) -> None:
    """Record the result of a trial, and delete what it was made from.

    Args:
        search: The search.
        trial: A trial that has ended.
        finished: Folders of its finished runs.
        reasons: Why it has no others.
        log: Called with a line on the trial.
    """
    from optuna.trial import TrialState

    folder = search.folder(trial)
    runs = [records.read_run(run) for run in finished]
    value, ssim = (
        sum(run.aggregates["macro"].get(name, math.nan) for run in runs) / (len(runs) or math.nan)
        for name in ("psnr", "ssim")
    )
    unscored = [f"{run.scene}: {run.skipped['psnr']}" for run in runs if "psnr" in run.skipped]
    reason = "; ".join([*reasons, *unscored])
    if not reason and not math.isfinite(value):
        reason = f"PSNR is {value}"
    for name, found in (
        ("ssim", None if reason or math.isnan(ssim) else ssim),
        ("seconds", sum(run.seconds or 0.0 for run in runs)),
        ("bytes", sum(run.checkpoint_bytes or 0 for run in runs)),
        ("device", "; ".join(sorted({run.device for run in runs}))),
        ("commit", "; ".join(sorted({run.commit for run in runs}))),
        ("failure", reason),
    ):
        trial.set_user_attr(name, found)
    if reason:
        search.study.tell(trial, state=TrialState.FAIL)
        where = f", in {folder}" if folder.is_dir() else ""
        log(f"trial {trial.number} failed: {reason}{where}")
    else:
        search.study.tell(trial, value)
        best = search.study.best_trial
        log(f"trial {trial.number}: {value:.3f} dB; best {best.value:.3f} dB ({best.number})")
    parts = (records.CHECKPOINT, records.PREDICTIONS, records.STAGES)
    for place in search.places(trial):
        bulky = [path for part in parts for path in place.glob(f"*/*/seed*/{part}")]
        # Scenes may have the names of these two folders.
        bulky += [path.parent for path in place.glob(f"{records.GROUND_TRUTH}/*/{MANIFEST}")]
        for path in bulky:
            shutil.rmtree(path, ignore_errors=True)
        for path in place.glob(f"{records.PHOTOS}/*.npz"):
            path.unlink(missing_ok=True)
    search.results()
