"""Plan of a bench: a checked run for each scene, method, strategy and seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path

from chronoscene.errors import ConfigError
from chronoscene.harness.files.ground_truth import freeze_ground_truth
from chronoscene.harness.files.records import TRAINING
from chronoscene.harness.files.source import RunOrigin
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.checks import check_run
from chronoscene.harness.plan.finished import continued, is_to_do
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.memory import check_room, device_need, views_at_a_time
from chronoscene.harness.plan.parts import effective_strategy
from chronoscene.harness.plan.resolve import ResolvedMethod, ResolvedRun, resolve_methods
from chronoscene.harness.plan.scenes import BenchScene, read_scenes
from chronoscene.harness.plan.settings import BenchSettings
from chronoscene.io.log import Log
from chronoscene.kernels.runtime import available_threads, check_device

BUDGET_NOTICE = "--budget: schedules follow the clock, and equal seeds do not give equal models"


@dataclass(frozen=True, slots=True)
class Plan:
    """Runs that were asked for, by their folders."""

    runs: dict[Path, ResolvedRun]
    todo: dict[Path, ResolvedRun]
    """Runs without a result when the plan was made."""


def plan_runs(settings: BenchSettings, log: Log) -> Plan:
    """Resolve and check all runs asked for; freezes the ground truth of the scenes."""
    shared = settings.run
    methods = resolve_methods(settings.methods, shared)
    asked = [(m, s) for m in methods for s in settings.strategies or (m.spec.strategy,)]
    if shared.separate_iterations is not None:
        _check_sharing(asked)
    if settings.ray is None:  # else the machine that runs a job checks its own
        gsplat = any(method.spec.draws_gaussians for method in methods)
        check_device(shared.device, gsplat=gsplat)
        if (shared.threads or 0) > (there := available_threads()):
            log(f"note: --threads {shared.threads}: a run has {there}, one for each processor")
    runs: dict[Path, ResolvedRun] = {}
    todo: dict[Path, ResolvedRun] = {}
    for scene in read_scenes(settings, log):
        of_scene = {run.job.folder: run for run in _runs_of_scene(settings, scene, asked)}
        missing = {k: run for k, run in of_scene.items() if is_to_do(run, settings.overwrite)}
        for folder, run in of_scene.items() if shared.keep_training else ():
            kept = (folder / TRAINING).is_dir() or run.job.training.is_dir()
            if folder not in missing and not kept:
                log(f"note: {folder} has its model alone: delete it to keep a training there")
        if trained := [run for run in missing.values() if run.spec.runner is None]:
            views = max(views_at_a_time(run.config, shared.threads) for run in trained)
            here = settings.ray is None
            log(check_room(scene.needs, shared.runs, len(trained), views=views, here=here))
        if shared.device == "cuda":
            configs = {run.spec.name: (run.spec, run.config) for run in missing.values()}
            for needed in configs.values():
                if line := device_need(scene.content, scene.needs, *needed):
                    log(line)
        freeze_ground_truth(shared.runs, scene.content, scene.hash, shared.max_width)
        runs |= of_scene
        todo |= missing
    for notice in dict.fromkeys(chain(*(run.job.notices for run in runs.values()))):
        log(f"note: {notice}")
    return Plan(runs, todo)


def _check_sharing(asked: list[tuple[ResolvedMethod, str]]) -> None:
    """Refuse a way of sharing iterations where no method has any under its strategies.

    Raises:
        ConfigError: If that is so.
    """
    if not any(method.has_sharing(strategy) for method, strategy in asked):
        raise ConfigError(
            "--separate-iterations",
            expected="strategy separate or sequential, or a preset with iterations per period",
            found=", ".join(dict.fromkeys(strategy for _, strategy in asked)),
            todo="leave it out, or use --iterations",
        )


def _runs_of_scene(
    settings: BenchSettings, scene: BenchScene, asked: list[tuple[ResolvedMethod, str]]
) -> Iterator[ResolvedRun]:
    """Yield every method, with each of its strategies and seeds, on one scene, checked."""
    for (method, wanted), seed in product(asked, settings.seeds):
        strategy, notices = _strategy(method, wanted)
        own = method.settings
        if own.budget_seconds is not None:
            notices.append(BUDGET_NOTICE)
        views = views_at_a_time(method.config, own.threads)
        own = replace(own, keep_training=own.keep_training or settings.continue_to is not None)
        job = Job(
            origin=RunOrigin(
                method=method.reference,
                plugin_path=str(Path.cwd()) if ":" in method.reference else None,
                scene_root=str(scene.source.path.resolve()),
                scene_format=scene.source.name,
                period_by=scene.source.period_by,
                validation=own.validation,
                validation_seed=own.validation_seed,
                shrink=own.shrink,
            ),
            scene=scene.content.name,
            scene_hash=scene.hash,
            scene_stamp=scene.stamp,
            split_hash=scene.split_hash,
            method_name=method.spec.name,
            strategy=strategy,
            seed=seed,
            settings=own,
            notices=notices,
            memory=settings.job_memory or scene.needs.of_run(views),
            photo_pixels=scene.needs.pixels,
        )
        run = method.run(job)
        check_run(run)
        if settings.continue_to is not None:
            run = continued(run, method, settings.continue_to)
        yield run


def _strategy(method: ResolvedMethod, wanted: str) -> tuple[str, list[str]]:
    """The strategy that a method can follow, and notices for the user."""
    strategy, notice = effective_strategy(method.spec, wanted)
    notices, kind = [notice] if notice else [], STRATEGIES[strategy]
    each = method.sharing(strategy) == "each"
    if strategy == "joint" and each:
        notices.append("joint: the model has all iterations and time once for each period")
    if kind.model_per_period or kind.in_order:
        unit = "stage" if kind.in_order else "model"
        has = f"each {unit} has all" if each else f"the {unit}s of a run share the"
        notices.append(f"{strategy}: {has} iterations and time")
    return strategy, notices
