"""What a bench runs: every scene, method, strategy and seed that was asked for, checked first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from chronoscene.bench.files import records
from chronoscene.bench.files.ground_truth import freeze_ground_truth
from chronoscene.bench.files.provenance import scene_hash
from chronoscene.bench.files.strategies import STRATEGIES
from chronoscene.bench.plan.checks import check_job
from chronoscene.bench.plan.job import PHOTO_DISK, PHOTO_MEMORY, Job
from chronoscene.bench.plan.memory import check_room, expected_memory
from chronoscene.bench.plan.parts import check_scene, effective_strategy
from chronoscene.errors import ConfigError
from chronoscene.formats import read_scene
from chronoscene.formats.shared.grouping import absolute_rule
from chronoscene.images.store import MAX_WIDTH, ImageStore
from chronoscene.methods import MethodSpec, load_spec
from chronoscene.metrics.lpips_weights import check_available
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash

BUDGET_NOTICE = "--budget: schedules follow the clock, and equal seeds do not give equal models"

Say = Callable[[str], None]
"""Takes one line for the user."""

Plan = list[tuple[Job, MethodSpec]]
"""Runs, each with its method."""


@dataclass(frozen=True, slots=True)
class BenchSettings:
    """Everything that the user asked for."""

    scenes: tuple[Path, ...]
    methods: tuple[str, ...]
    """Names, or ``module:SPEC``."""
    runs: Path
    strategies: tuple[str, ...] = ("joint",)
    preset: str = "balanced"
    overrides: Mapping[str, str] | None = None
    """``key`` for all methods that are run, or ``method.key`` for one."""
    iterations: int | None = None
    budget_seconds: float | None = None
    separate_iterations: str = "total"
    seeds: tuple[int, ...] = (0,)
    continue_to: int | None = None
    """Train finished runs further, up to so many iterations."""
    checkpoint_seconds: float = 300.0
    """Time from one checkpoint of a training to the next."""
    keep_training: bool = False
    """Whether finished runs keep what it takes to train them further."""
    max_width: int = MAX_WIDTH
    photo_memory: int = PHOTO_MEMORY
    photo_disk: int = PHOTO_DISK
    """Bytes that training photos may take in memory, and decoded on disk."""
    threads: int | None = None
    device: str = "auto"
    lpips_weights: Path | None = None
    dataset_format: str | None = None
    """Of the scenes; None to find out."""
    period_by: str | None = None
    """How their images are grouped into periods, where the format leaves a choice."""
    overwrite: bool = False
    """Whether finished runs with other settings may be replaced."""
    jobs: int | None = None
    """How many runs there are at a time; None for one, or as many as the cluster has room for."""
    job_memory: int | None = None
    """Bytes of memory that a run takes; None for an estimate."""
    ray: str | None = None
    """Address of the Ray cluster that they are run on; None for this machine."""


def plan_jobs(settings: BenchSettings, say: Say) -> Plan:
    """All runs asked for, checked; freezes the ground truth of the scenes."""
    specs = [(name, load_spec(name)) for name in settings.methods]
    _check_lengths(settings)
    split_overrides(settings, [spec for _, spec in specs])
    if settings.lpips_weights is not None:
        check_available(settings.lpips_weights)
    scenes = []
    for path in settings.scenes:
        say(f"read {path}")
        scenes.append(
            read_scene(path, format=settings.dataset_format, period_by=settings.period_by)
        )
    _check_names(scenes)
    plan: dict[Path, tuple[Job, MethodSpec]] = {}
    notices: dict[str, None] = {}
    for scene in scenes:
        check_scene(scene)
        say(f"{scene.name}: fingerprint of {len(scene.frames)} images, ground truth of test views")
        unfinished = 0
        for job, spec in _scene_jobs(settings, scene, specs):
            check_job(job, spec)
            job = job.with_variant(spec)
            if settings.continue_to is not None:
                job = continued(job, spec, settings.continue_to)
            job = replace(job, memory=settings.job_memory or expected_memory(scene, job))
            plan.setdefault(job.folder, (job, spec))
            notices.update(dict.fromkeys(job.notices))
            unfinished += spec.runner is None and not is_finished(job, spec, settings.overwrite)
        if unfinished:
            say(check_room(scene, job, unfinished, here=settings.ray is None))
        store = ImageStore(scene, max_width=settings.max_width, memory_limit=settings.photo_memory)
        freeze_ground_truth(settings.runs, scene, job.scene_hash, store, settings.max_width)
    for notice in notices:
        say(f"note: {notice}")
    return list(plan.values())


def _check_lengths(settings: BenchSettings) -> None:
    """Refuse two numbers of iterations, of which one would silently win.

    Raises:
        ConfigError: If several options give one.
    """
    given = {
        "--continue-to": settings.continue_to,
        "--iterations": settings.iterations,
        "--set iterations": any(
            key.rpartition(".")[2] == "iterations" for key in settings.overrides or {}
        ),
        "--budget": settings.continue_to and settings.budget_seconds,
    }
    options = [name for name, value in given.items() if value]
    if len(options) > 1:
        raise ConfigError(
            options[0],
            expected=f"no {' and no '.join(options[1:])} beside it",
            found=" and ".join(options[1:]),
            todo="leave all of them but one out",
        )


def split_overrides(settings: BenchSettings, specs: list[MethodSpec]) -> dict[str, dict[str, str]]:
    """Overrides of each method: those without a prefix, then those with its name before a dot.

    Raises:
        ConfigError: If a prefix names a method that is not run.
    """
    names = [spec.name for spec in specs]
    chosen: dict[str, dict[str, str]] = {name: {} for name in names}
    items = (settings.overrides or {}).items()
    for key, value in sorted(items, key=lambda item: "." in item[0]):
        method, dot, rest = key.rpartition(".")
        if dot and method not in names:
            raise ConfigError(
                f"--set {key}",
                expected=f"a key, or one after {', '.join(f'{n}.' for n in names)}",
                found=repr(method),
                todo="use the name of a method that is run",
            )
        for name in [method] if dot else names:
            chosen[name][rest] = value
    return chosen


def _check_names(scenes: list[Scene]) -> None:
    by_name: dict[str, Scene] = {}
    for scene in scenes:
        other = by_name.setdefault(scene.name, scene)
        if other is not scene:
            raise ConfigError(
                scene.root,
                expected="a scene with a unique name",
                found=f"{scene.name!r}, the name of {other.root} too",
                todo="rename a folder, or run the scenes with different --out",
            )


def _scene_jobs(
    settings: BenchSettings, scene: Scene, specs: list[tuple[str, MethodSpec]]
) -> Iterator[tuple[Job, MethodSpec]]:
    """Every method, strategy and seed on one scene."""
    overrides = split_overrides(settings, [spec for _, spec in specs])
    digest, split = scene_hash(scene), split_hash(scene)
    budget = settings.budget_seconds
    for (reference, spec), wanted, seed in product(specs, settings.strategies, settings.seeds):
        strategy, notice = effective_strategy(spec, wanted)
        notices = [notice] if notice else []
        kind, sharing = STRATEGIES[strategy], "total"
        if kind.model_per_period or kind.in_order:
            sharing, unit = settings.separate_iterations, "stage" if kind.in_order else "model"
            has = f"each {unit} has all" if sharing == "each" else f"the {unit}s of a run share the"
            notices.append(f"{strategy}: {has} iterations and time")
        job = Job(
            scene_root=str(scene.root.resolve()),
            scene_format=scene.format,
            period_by=absolute_rule(settings.period_by),
            scene=scene.name,
            scene_hash=digest,
            split_hash=split,
            method=reference,
            method_name=spec.name,
            strategy=strategy,
            preset=settings.preset,
            overrides=overrides[spec.name],
            iterations=settings.iterations,
            budget_seconds=budget,
            separate_iterations=sharing,
            seed=seed,
            max_width=settings.max_width,
            photo_memory=settings.photo_memory,
            photo_disk=settings.photo_disk,
            checkpoint_seconds=settings.checkpoint_seconds,
            keep_training=settings.keep_training or settings.continue_to is not None,
            threads=settings.threads,
            device=settings.device,
            runs=str(settings.runs.resolve()),
            lpips_weights=str(settings.lpips_weights.resolve()) if settings.lpips_weights else None,
            notices=[*notices, *([] if budget is None else [BUDGET_NOTICE])],
            plugin_path=str(Path.cwd()) if ":" in reference else None,
        )
        yield job, spec


def continued(job: Job, spec: MethodSpec, iterations: int) -> Job:
    """The job that trains a finished run further: the longest there is.

    Args:
        job: With the settings of the finished run, apart from the number of iterations.
        spec: Its method.
        iterations: Of the whole training.

    Raises:
        ConfigError: If there is no such run, or nothing to train further or to go on from.
    """
    there = {done.iterations or 0: done for done in _lengths(job, spec)}
    shorter = [length for length in there if length <= iterations]
    if not shorter:
        raise ConfigError(
            job.folder,
            expected=f"a finished run that ended after at most {iterations} iterations",
            found=f"one with {min(there)}" if there else "none",
            todo="correct --continue-to, or train anew with --iterations",
        )
    last = there[max(shorter)]
    is_finished(last, spec)  # raises if its settings are others
    if last.iterations == iterations:
        return last
    if not (last.folder / records.TRAINING).is_dir():
        raise ConfigError(
            last.folder,
            expected="a run that kept its training",
            found="its model alone",
            todo="train anew with --keep-training; such a run can be trained further",
        )
    lengths = [*last.continued_from, max(shorter)]
    longer = replace(job, iterations=iterations, continued_from=lengths)
    return replace(longer, continues=str(last.folder)).with_variant(spec)


def _lengths(job: Job, spec: MethodSpec) -> Iterator[Job]:
    """Finished runs like a job apart from the number of iterations, those begun afresh first."""
    found = []
    for file in sorted(job.folder.parent.parent.glob(f"*/{job.folder.name}/{records.RUN_FILE}")):
        config = records.read_config(file.parent)["config"]
        earlier = config.get("continued_from", [])
        length = config.get("stop", {}).get("iterations")  # images of other programs have none
        same = replace(job, iterations=length, continued_from=earlier)
        if length is not None and same.with_variant(spec).folder == file.parent:
            found.append(same.with_variant(spec))
    yield from sorted(found, key=lambda done: len(done.continued_from))


def is_finished(job: Job, spec: MethodSpec, overwrite: bool = False) -> bool:
    """Whether the result is there already, made with the same settings from the same scene.

    Raises:
        ConfigError: If there is one made with other settings, unless it may be replaced.
    """
    if not (job.folder / records.RUN_FILE).is_file():
        return False
    records.read_run(job.folder)
    stored, wanted = records.read_config(job.folder), job.document(spec)
    if stored == wanted or overwrite:
        return stored == wanted
    raise _other_settings(job.folder, "a finished", stored, wanted)


def is_obsolete(job: Job, spec: MethodSpec, overwrite: bool = False) -> bool:
    """Whether there are checkpoints of a training with other settings, which may be deleted.

    Raises:
        ConfigError: If there are, and they may not.
    """
    if not (job.training / records.CONFIG_FILE).is_file():
        return False
    stored, wanted = records.read_config(job.training), job.document(spec)
    if stored == wanted or overwrite:
        return stored != wanted
    raise _other_settings(job.training, "an unfinished", stored, wanted)


def _other_settings(folder: Path, kind: str, stored: Any, wanted: Any) -> ConfigError:
    old, new = first_difference(stored, wanted)
    return ConfigError(
        folder,
        expected=f"a run with {new}",
        found=f"{kind} one with {old}",
        todo="choose another folder with --out, or pass --overwrite",
    )


def first_difference(old: Any, new: Any, key: str = "settings") -> tuple[str, str]:
    """The first difference of two documents, as ``key value`` of both."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*new, *(k for k in old if k not in new)]:
            if old.get(name) != new.get(name):
                return first_difference(old.get(name), new.get(name), name)
    return f"{key} {old}", f"{key} {new}"
