"""What a bench runs: every scene, method, strategy and seed that was asked for, checked first."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from chronoscene.bench import results
from chronoscene.bench.job import Job, check_job
from chronoscene.bench.predictions import freeze_ground_truth
from chronoscene.bench.provenance import code_version, scene_hash
from chronoscene.bench.strategies import check_scene, effective_strategy
from chronoscene.errors import ConfigError
from chronoscene.formats import read_scene
from chronoscene.images.store import MAX_WIDTH, ImageStore
from chronoscene.methods import MethodSpec, load_spec
from chronoscene.metrics.lpips_weights import check_available
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash

BUDGET_NOTICE = "--budget: schedules follow the clock, and equal seeds do not give equal models"

Say = Callable[[str], None]
"""Takes one line for the user."""


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
    threads: int | None = None
    device: str = "auto"
    lpips_weights: Path | None = None
    dataset_format: str | None = None
    """Of the scenes; None to find out."""
    overwrite: bool = False
    """Whether finished runs with other settings may be replaced."""


def plan_jobs(settings: BenchSettings, say: Say) -> list[tuple[Job, MethodSpec]]:
    """All runs asked for, checked; freezes the ground truth of the scenes."""
    specs = [(name, load_spec(name)) for name in settings.methods]
    split_overrides(settings, [spec for _, spec in specs])
    if settings.lpips_weights is not None:
        check_available(settings.lpips_weights)
    scenes = []
    for path in settings.scenes:
        say(f"read {path}")
        scenes.append(read_scene(path, format=settings.dataset_format))
    _check_names(scenes)
    commit = code_version()
    plan: dict[Path, tuple[Job, MethodSpec]] = {}
    notices: dict[str, None] = {}
    for scene in scenes:
        check_scene(scene)
        say(f"{scene.name}: fingerprint of {len(scene.frames)} images, ground truth of test views")
        for job, spec in _scene_jobs(settings, scene, commit, specs):
            if settings.continue_to is not None:
                job = continued(job, spec, settings.continue_to)
            check_job(job, spec)
            plan.setdefault(job.folder, (job, spec))
            notices.update(dict.fromkeys(job.notices))
        store = ImageStore(scene, max_width=settings.max_width)
        freeze_ground_truth(settings.runs, scene, job.scene_hash, store, settings.max_width)
    for notice in notices:
        say(f"note: {notice}")
    return list(plan.values())


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
    settings: BenchSettings, scene: Scene, commit: str, specs: list[tuple[str, MethodSpec]]
) -> Iterator[tuple[Job, MethodSpec]]:
    """Every method, strategy and seed on one scene."""
    overrides = split_overrides(settings, [spec for _, spec in specs])
    digest, split = scene_hash(scene), split_hash(scene)
    budget = settings.budget_seconds
    for (reference, spec), wanted, seed in product(specs, settings.strategies, settings.seeds):
        strategy, notice = effective_strategy(spec, wanted)
        notices = [notice] if notice else []
        if strategy == "separate":
            each = settings.separate_iterations == "each"
            has = "each model has all" if each else "the models of a run share the"
            notices.append(f"separate: {has} iterations and time")
        job = Job(
            scene_root=str(scene.root.resolve()),
            scene_format=scene.format,
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
            separate_iterations=settings.separate_iterations,
            seed=seed,
            max_width=settings.max_width,
            checkpoint_seconds=settings.checkpoint_seconds,
            keep_training=settings.keep_training or settings.continue_to is not None,
            threads=settings.threads,
            device=settings.device,
            runs=str(settings.runs.resolve()),
            lpips_weights=str(settings.lpips_weights.resolve()) if settings.lpips_weights else None,
            commit=commit,
            notices=[*notices, *([] if budget is None else [BUDGET_NOTICE])],
            plugin_path=str(Path.cwd()) if ":" in reference else None,
        )
        yield job, spec


def continued(job: Job, spec: MethodSpec, iterations: int) -> Job:
    """The job that trains a finished run further.

    Args:
        job: With the settings of the finished run, apart from the number of iterations.
        spec: Its method.
        iterations: Of the whole training.

    Raises:
        ConfigError: If there is no such run, or nothing to train further or to go on from.
    """
    stop, earlier, found = {}, [], "none"
    if (job.folder / results.RUN_FILE).is_file():
        config = results.read_config(job.folder)["config"]
        stop, earlier = config["stop"], config.get("continued_from", [])
        found = "one with " + ", ".join(f"{k} {v}" for k, v in stop.items() if v is not None)
    before = stop.get("iterations")
    if before is None or before > iterations or stop["seconds"] is not None:
        raise ConfigError(
            job.folder,
            expected=f"a finished run that ended after at most {iterations} iterations",
            found=found,
            todo="correct --continue-to, or train anew with --iterations",
        )
    if before == iterations:
        return replace(job, iterations=before, continued_from=earlier)
    longer = replace(job, iterations=iterations, continued_from=[*earlier, before])
    if not is_finished(longer, spec) and not (job.folder / results.TRAINING).is_dir():
        raise ConfigError(
            job.folder,
            expected="a run that kept its training",
            found="its model alone",
            todo="train anew with --keep-training; such a run can be trained further",
        )
    return longer


def is_finished(job: Job, spec: MethodSpec, overwrite: bool = False) -> bool:
    """Whether the result is there already, made with the same settings from the same scene.

    Raises:
        ConfigError: If there is one made with other settings, unless it may be replaced.
    """
    if not (job.folder / results.RUN_FILE).is_file():
        return False
    results.read_run(job.folder)
    stored, wanted = results.read_config(job.folder), job.document(spec)
    if stored == wanted:
        return True
    if job.continued_from:  # a shorter run is not finished, one with other settings is refused
        wanted = job.shorter().document(spec)
        if stored == wanted:
            return False
    elif overwrite:
        return False
    raise _other_settings(job.folder, "a finished", stored, wanted)


def check_unfinished(job: Job, spec: MethodSpec, overwrite: bool = False) -> None:
    """Raise if there are checkpoints of a training with other settings; delete them if allowed.

    Raises:
        ConfigError: If there are.
    """
    if not (job.training / results.CONFIG_FILE).is_file():
        return
    stored, wanted = results.read_config(job.training), job.document(spec)
    if stored == wanted:
        return
    if not overwrite:
        raise _other_settings(job.training, "an unfinished", stored, wanted)
    shutil.rmtree(job.training)


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
