"""Plan of a bench: a checked run for each scene, method, strategy and seed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.harness.files.ground_truth import freeze_ground_truth
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.harness.files.source import read_bench_scene
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.checks import check_run
from chronoscene.harness.plan.finished import continued, is_to_do
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.memory import check_room, photo_needs
from chronoscene.harness.plan.parts import check_points, check_scene, effective_strategy
from chronoscene.harness.plan.resolve import ResolvedMethod, ResolvedRun, resolve_method
from chronoscene.harness.plan.settings import BenchSettings
from chronoscene.images.store import ImageStore
from chronoscene.io.log import Log
from chronoscene.kernels.runtime import check_device
from chronoscene.methods import load_spec
from chronoscene.metrics.lpips_weights import check_available
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash

BUDGET_NOTICE = "--budget: schedules follow the clock, and equal seeds do not give equal models"


@dataclass(frozen=True, slots=True)
class Plan:
    """Runs that were asked for, by their folders."""

    runs: dict[Path, ResolvedRun]
    todo: dict[Path, ResolvedRun]
    """Runs without a result when the plan was made."""

    def update(self, other: Plan) -> None:
        """Add the runs of another plan; a folder has one run."""
        self.runs.update(other.runs)
        self.todo.update(other.todo)


def plan_runs(settings: BenchSettings, log: Log) -> Plan:
    """Resolve and check all runs asked for; freezes the ground truth of the scenes."""
    specs = [(reference, load_spec(reference)) for reference in settings.methods]
    settings.check([spec.name for _, spec in specs])
    shared = settings.run.absolute()
    if shared.lpips_weights is not None:
        check_available(shared.lpips_weights)
    methods = [resolve_method(reference, spec, shared) for reference, spec in specs]
    for _, spec in specs:
        if shared.device != "auto":
            check_choice(f"{spec.name} --device", shared.device, spec.devices)
    if settings.ray is None:  # else the machine that runs a job checks its own
        check_device(shared.device)
    plan = Plan({}, {})
    notices: dict[str, None] = {}
    for scene in _read_scenes(settings, log):
        log(f"{scene.name}: fingerprint of {len(scene.frames)} images, ground truth of test views")
        store = ImageStore(scene, max_width=shared.max_width, memory_limit=shared.photo_memory)
        needs = photo_needs(scene, store, shared)
        memory = settings.job_memory or needs.of_run
        runs = {run.job.folder: run for run in _runs_of_scene(settings, scene, methods, memory)}
        todo = {k: run for k, run in runs.items() if is_to_do(run, settings.overwrite)}
        trained = sum(run.spec.runner is None for run in todo.values())
        if trained:
            here = settings.ray is None
            log(check_room(scene, needs, shared.runs, trained, here=here))
        digest = next(iter(runs.values())).job.scene_hash
        freeze_ground_truth(shared.runs, scene, digest, store, shared.max_width)
        notices.update(dict.fromkeys(chain(*(run.job.notices for run in runs.values()))))
        plan.update(Plan(runs, todo))
    for notice in notices:
        log(f"note: {notice}")
    return plan


def _read_scenes(settings: BenchSettings, log: Log) -> Iterable[Scene]:
    """Read all scenes before any of them is trained on; each has a name of its own."""
    scenes: dict[str, Scene] = {}
    for path in settings.scenes:
        log(f"read {path}")
        scene = read_bench_scene(
            path,
            format=settings.dataset_format,
            period_by=settings.run.period_by,
            validation=settings.run.validation,
        )
        if other := scenes.get(scene.name):
            raise ConfigError(
                scene.root,
                expected="a scene with a unique name",
                found=f"{scene.name!r}, the name of {other.root} too",
                todo="rename a folder, or run the scenes with different --out",
            )
        scenes[scene.name] = scene
        check_scene(scene)
        check_points(scene)
    return scenes.values()


def _runs_of_scene(
    settings: BenchSettings, scene: Scene, methods: list[ResolvedMethod], memory: int
) -> Iterator[ResolvedRun]:
    """Yield every method, strategy and seed on one scene, checked."""
    digest, split = scene_hash(scene), split_hash(scene)
    for method, wanted, seed in product(methods, settings.strategies, settings.seeds):
        strategy, notices = _strategy(method, wanted)
        own = method.settings
        if own.budget_seconds is not None:
            notices.append(BUDGET_NOTICE)
        own = replace(own, keep_training=own.keep_training or settings.continue_to is not None)
        job = Job(
            scene_root=str(scene.root.resolve()),
            scene_format=scene.format,
            scene=scene.name,
            scene_hash=digest,
            split_hash=split,
            method=method.reference,
            method_name=method.spec.name,
            strategy=strategy,
            seed=seed,
            settings=own,
            notices=notices,
            plugin_path=str(Path.cwd()) if ":" in method.reference else None,
            memory=memory,
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
