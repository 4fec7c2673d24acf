"""The bench: plan all runs, skip the finished ones, run the others one by one."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from chronoscene.bench import results
from chronoscene.bench.ground_truth import freeze_ground_truth
from chronoscene.bench.identity import code_version, scene_hash
from chronoscene.bench.jobs import Job, check_job, write_job
from chronoscene.bench.protocol import check_scene, effective_strategy
from chronoscene.bench.run_folders import replace_folder
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.formats import read_scene
from chronoscene.images.store import MAX_WIDTH, ImageStore
from chronoscene.io.files import stoppable
from chronoscene.methods import MethodSpec, load_spec
from chronoscene.metrics.lpips_weights import check_available
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash

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
    max_width: int = MAX_WIDTH
    threads: int | None = None
    device: str = "auto"
    lpips_weights: Path | None = None
    overwrite: bool = False
    """Whether finished runs with other settings may be replaced."""


@dataclass(frozen=True, slots=True)
class BenchOutcome:
    """What a bench did."""

    finished: tuple[Path, ...]
    """Folders of the runs of this bench that have a result, old or new."""
    skipped: int
    """How many of them were there before."""
    failures: tuple[results.Failure, ...]


def run_bench(settings: BenchSettings, say: Say) -> BenchOutcome:
    """Run everything that is asked for and not there yet.

    Finished runs are on disk at once, so a bench that is killed goes on where it stopped.

    Raises:
        ChronoSceneError: If anything asked for is wrong; nothing is trained then.
    """
    plan = plan_jobs(settings, say)
    todo = [(job, spec) for job, spec in plan if not is_finished(job, spec, settings.overwrite)]
    if len(todo) < len(plan):
        say(f"{len(plan) - len(todo)} of {len(plan)} runs are finished and kept")
    failures = []
    try:
        with stoppable():
            for number, (job, _) in enumerate(todo, start=1):
                say(f"[{number}/{len(todo)}] {job.label}")
                if (failure := run_in_process(job)) is not None:
                    failures.append(failure)
                    say(f"failed: {failure.reason}")
    finally:
        results.write_summary(settings.runs)
    finished = [job.folder for job, _ in plan if (job.folder / results.RUN_FILE).is_file()]
    return BenchOutcome(tuple(finished), len(plan) - len(todo), tuple(failures))


def plan_jobs(settings: BenchSettings, say: Say) -> list[tuple[Job, MethodSpec]]:
    """All runs asked for, checked; freezes the ground truth of the scenes."""
    specs = [(name, load_spec(name)) for name in settings.methods]
    split_overrides(settings, [spec for _, spec in specs])
    if settings.lpips_weights is not None:
        check_available(settings.lpips_weights)
    scenes = [read_scene(path) for path in settings.scenes]
    _check_names(scenes)
    commit = code_version()
    plan: dict[Path, tuple[Job, MethodSpec]] = {}
    notices: dict[str, None] = {}
    for scene in scenes:
        check_scene(scene)
        template = _template(settings, scene, commit)
        for job, spec in _scene_jobs(settings, template, specs):
            check_job(job, spec)
            plan.setdefault(job.folder, (job, spec))
            notices.update(dict.fromkeys(job.notices))
        store = ImageStore(scene, max_width=settings.max_width)
        freeze_ground_truth(settings.runs, scene, template.scene_hash, store, settings.max_width)
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
                todo="name a method that is run",
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
                expected="a scene with a name of its own",
                found=f"{scene.name!r}, the name of {other.root} too",
                todo="rename a folder, or run them with different --out",
            )


def _template(settings: BenchSettings, scene: Scene, commit: str) -> Job:
    """What all jobs of a scene have in common."""
    return Job(
        scene_root=str(scene.root.resolve()),
        scene=scene.name,
        scene_hash=scene_hash(scene),
        split_hash=split_hash(scene),
        method="",
        method_name="",
        strategy="",
        preset=settings.preset,
        overrides={},
        iterations=settings.iterations,
        budget_seconds=settings.budget_seconds,
        separate_iterations=settings.separate_iterations,
        seed=0,
        max_width=settings.max_width,
        threads=settings.threads,
        device=settings.device,
        runs=str(settings.runs.resolve()),
        lpips_weights=str(settings.lpips_weights.resolve()) if settings.lpips_weights else None,
        commit=commit,
    )


def _scene_jobs(
    settings: BenchSettings, template: Job, specs: list[tuple[str, MethodSpec]]
) -> Iterator[tuple[Job, MethodSpec]]:
    """Every method, strategy and seed on one scene."""
    overrides = split_overrides(settings, [spec for _, spec in specs])
    for reference, spec in specs:
        for wanted in settings.strategies:
            strategy, notice = effective_strategy(spec, wanted)
            for seed in settings.seeds:
                job = replace(
                    template,
                    method=reference,
                    method_name=spec.name,
                    strategy=strategy,
                    overrides=overrides[spec.name],
                    seed=seed,
                    notices=[notice] if notice else [],
                    plugin_path=str(Path.cwd()) if ":" in reference else None,
                )
                yield job, spec


def is_finished(job: Job, spec: MethodSpec, overwrite: bool = False) -> bool:
    """Whether the result is there already, made with the same settings from the same scene.

    Raises:
        ConfigError: If there is one made with other settings, unless it may be replaced.
    """
    if not (job.folder / results.RUN_FILE).is_file():
        return False
    results.read_run(job.folder)
    path = job.folder / results.CONFIG_FILE
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(
            path, expected="the config of the run", found=str(error), todo="delete the run"
        ) from error
    wanted = job.document(spec)
    if stored == wanted:
        return True
    if overwrite:
        return False
    old, new = first_difference(stored, wanted)
    raise ConfigError(
        job.folder,
        expected=f"a run with {new}",
        found=f"a finished one with {old}",
        todo="choose another folder with --out, or pass --overwrite",
    )


def first_difference(old: Any, new: Any, key: str = "settings") -> tuple[str, str]:
    """Where two documents differ first, as ``key value`` of both."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*new, *(k for k in old if k not in new)]:
            if old.get(name) != new.get(name):
                return first_difference(old.get(name), new.get(name), name)
    return f"{key} {old}", f"{key} {new}"


def run_in_process(job: Job) -> results.Failure | None:
    """Run one job in a new process that shares our terminal; returns why it failed, if it did."""
    job = replace(job, staging=str(_fresh_staging(job.folder)))
    staging = Path(job.staging)
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as folder:
        path = Path(folder) / "job.json"
        write_job(path, job)
        # -P: a file in the current folder must not shadow a module of the standard library.
        command = [sys.executable, "-P", "-m", "chronoscene.bench.worker", str(path)]
        process = subprocess.Popen([*command, str(os.getpid())])
        try:
            status = process.wait()
        except BaseException:
            _end(process)
            shutil.rmtree(staging, ignore_errors=True)
            raise
    _write_crash(job, staging, status)
    replace_folder(staging, job.folder)
    return results.read_failure(job.folder)


def _fresh_staging(folder: Path) -> Path:
    """An empty folder beside the final one; what a killed bench left there is removed.

    The name holds our process id: a worker of a killed bench may still write into its own.
    """
    for stale in folder.parent.glob(f".{folder.name}.*.partial"):
        shutil.rmtree(stale, ignore_errors=True)
    staging = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    staging.mkdir(parents=True)
    return staging


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a worker. It has nothing to clean up; a library's handler might take its time."""
    process.kill()
    process.wait()


def _write_crash(job: Job, staging: Path, status: int) -> None:
    """Write down a process that ended without a word of its own."""
    complete = (staging / results.RUN_FILE).is_file() and status == 0
    if complete or (staging / results.FAILURE_FILE).is_file():
        return
    (staging / results.RUN_FILE).unlink(missing_ok=True)
    reason = f"the process ended with status {status}"
    if status < 0:
        name = signal.Signals(-status).name
        hint = " (out of memory?)" if name == "SIGKILL" else ""
        reason = f"the process was ended by {name}{hint}"
    results.write_failure(staging, job.failure(reason))
