"""One run: train, save, render, score. Its own process keeps a crash away from the other runs.

The peak memory is then that of this run alone, too. `execute` is what the process calls;
`chronoscene.io.processes` starts the process and watches it.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields, replace
from datetime import UTC, datetime
from json import dumps
from pathlib import Path
from typing import Any

from chronoscene.errors import BackendError, ChronoSceneError, DiskFullError
from chronoscene.harness.files import records
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import ImageWriter, load_image, load_mask, read_manifest
from chronoscene.harness.files.provenance import (
    code_version,
    describe_device,
    library_versions,
    method_version,
    peak_memory_bytes,
)
from chronoscene.harness.files.records import CurvePoint
from chronoscene.harness.files.source import write_source
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.memory import open_store
from chronoscene.harness.plan.parts import Part, make_parts
from chronoscene.harness.plan.resolve import ResolvedRun, resolve
from chronoscene.harness.plan.sparse_depths import MIN_IMAGES
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.score.regions import left_half
from chronoscene.harness.score.scoring import NO_TESTS, score_job
from chronoscene.harness.train.checkpoints import Checkpoints, LoopState
from chronoscene.harness.train.checks import check_sharing
from chronoscene.harness.train.external import run_external
from chronoscene.harness.train.loop import (
    DivergedError,
    Truth,
    checked_bytes,
    probe_frames,
    seed_everything,
    train,
)
from chronoscene.harness.train.progress import ProgressDisplay
from chronoscene.harness.train.warm_up import forget_peak_memory, warm_up
from chronoscene.io.processes import Report
from chronoscene.io.staging import needing_space, write_text_atomic
from chronoscene.io.tables import csv_text
from chronoscene.kernels.runtime import check_device, keep_freed_memory, set_threads
from chronoscene.methods import Method, MethodSize, MethodSpec, PeriodSharing, make_method
from chronoscene.scene import Frame, Scene

NOTHING_SHARED = "nothing in the model that periods have of their own and could share"


@dataclass(frozen=True, slots=True)
class PartOutcome:
    """Result of training and rendering one model, or one stage of it."""

    trained: LoopState
    folder: Path
    """Folder of the saved model."""
    size: MethodSize
    render_seconds: float
    """Time for all its test views together, by the model as it was saved and loaded again."""
    sharing: PeriodSharing | None
    drawn: int | None
    """Gaussians drawn, sum over its test views; None if the method does not report them."""


@dataclass(frozen=True, slots=True)
class Machine:
    """Device and threads of the run."""

    device: str
    threads: int

    def __str__(self) -> str:
        return describe_device(self.device, self.threads)


def run_job(job: Job, report: Report | None = None) -> None:
    """Train, save, render and score; writes into ``job.staging`` only.

    Args:
        job: What to run.
        report: Called with the progress, which is not shown then.
    """
    started = datetime.now(UTC).isoformat(timespec="seconds")
    run, staging = resolve(job), Path(job.staging)
    if run.spec.runner is not None:
        run_external(run, run.spec.runner, report)
        return
    keep_freed_memory()
    settings = job.settings
    machine = Machine(pick_device(settings.device, run.spec), set_threads(settings.threads))
    write_text_atomic(staging / records.CONFIG_FILE, dumps(run.document, indent=1) + "\n")
    scene = job.read_scene()
    takes_period = run.spec.period_input != "none"
    store = open_store(scene, settings)
    parts = make_parts(scene, store, job.strategy, takes_period=takes_period)
    write_source(staging, job.origin, parts[0].train.training_from_world)
    # All stages but the last have folders of their own, as they predict the same views.
    stages = [part.name for part in parts[:-1]] if STRATEGIES[job.strategy].in_order else []
    writers = {name: ImageWriter(staging / records.STAGES / name) for name in stages}
    final = ImageWriter(staging / records.PREDICTIONS)
    method, outcomes = make_method(run.spec, run.config), []
    with ProgressDisplay(job.label, report=report, models=len(parts)) as display:
        display.wait("warm-up: seconds, or minutes where kernels are not compiled yet")
        before = time.perf_counter()
        periods = parts[0].train.num_periods
        notice = warm_up(run.spec, run.config, num_periods=periods, device=machine.device)
        forget_peak_memory()
        warmup_seconds = time.perf_counter() - before
        if stages:
            writers[records.UNTRAINED] = ImageWriter(staging / records.STAGES / records.UNTRAINED)
            _render_untrained(run, parts, machine, writers[records.UNTRAINED])
        for part, stop in zip(parts, run.stops(parts), strict=True):
            display.begin(part.name, stop)
            if not part.extends:
                method = make_method(run.spec, run.config)
            checkpoints = None
            if run.spec.resumable:
                checkpoints = _checkpoints(run, part, len(parts), machine, display)
            writer = writers.get(part.name, final)
            outcomes.append(
                _run_part(run, method, part, stop, machine, writer, display, checkpoints)
            )
    found = (peak_memory_bytes() or 0, *(o.trained.peak_memory_bytes for o in outcomes))
    peaks = max(found) or None, _peak_device_memory(machine.device)
    columns = [f.name for f in fields(CurvePoint)]
    points = [astuple(point) for outcome in outcomes for point in outcome.trained.curve]
    write_text_atomic(staging / records.CURVE_FILE, csv_text(columns, points))
    with ProgressDisplay(job.label, report=report) as display:
        display.wait("scores")
        record = _record(run, scene, machine, outcomes, peaks, started)
        record.warmup_seconds = warmup_seconds
        record.notices = [
            *job.notices,
            *([notice] if notice else []),
            *_unheld(run, parts),
            *_skips(job, record),
        ]
        for writer in (*writers.values(), final):
            writer.close_run(record)
        score_job(job, record)


def pick_device(wanted: str, spec: MethodSpec) -> str:
    """``cuda`` where asked for, or where it is usable and nothing was asked for; else ``cpu``.

    Raises:
        BackendError: If a GPU is asked for that is not there.
    """
    check_device(wanted, gsplat=spec.draws_gaussians)
    if wanted != "auto":
        return wanted
    if "cuda" not in spec.devices or "cpu" not in spec.devices:
        return spec.devices[0]
    with suppress(BackendError):
        check_device("cuda", gsplat=spec.draws_gaussians)
        return "cuda"
    return "cpu"


def _render_untrained(
    run: ResolvedRun, parts: Sequence[Part], machine: Machine, writer: ImageWriter
) -> None:
    """Render what the first stage does not learn, with the model that it begins with."""
    method, first = make_method(run.spec, run.config), parts[0]
    seed_everything(run.job.seed)
    method.setup(first.train, seed=run.job.seed, device=machine.device)
    for part in parts:
        for frame in part.ahead:
            _render_view(method, first, frame, writer)


def _render_view(
    method: Method, part: Part, frame: Frame, writer: ImageWriter
) -> tuple[float, int | None]:
    """Render a test view and write it; returns the seconds of the rendering, and what it drew."""
    before = time.perf_counter()
    prediction = method.render(part.view(frame), part.method_period(frame))
    seconds = time.perf_counter() - before
    image, shown = checked_bytes(prediction, part, frame), part.shown_period(frame)
    writer.add(frame.name, image, camera_period=frame.period, rendered_period=shown)
    return seconds, prediction.drawn


def _shown(method: Method, job: Job, part: Part) -> Iterator[tuple[Frame, Method]]:
    """Yield the test views of a part, and the model that renders each.

    That is the trained one, or with `RunSettings.fit_half` one whose appearance is fitted to the
    left half of the photo.
    """
    if not job.settings.fit_half:
        yield from ((frame, method) for frame in part.test)
        return
    folder = ground_truth_folder(job.settings.runs, job.scene)
    entries = {entry.view: entry for entry in read_manifest(folder).images}
    for frame in part.test:
        entry = entries[frame.name]
        known, mask = left_half(entry.height, entry.width), load_mask(folder, entry)
        known = known if mask is None else known & mask
        photo, period = load_image(folder, entry), part.method_period(frame)
        yield frame, method.fitted_to(part.view(frame), period, photo, known)


def _run_part(
    run: ResolvedRun,
    method: Method,
    part: Part,
    stop: StopRule,
    machine: Machine,
    writer: ImageWriter,
    display: ProgressDisplay,
    checkpoints: Checkpoints | None,
) -> PartOutcome:
    """Train a method, save its model, and render the test views that it answers for."""
    checkpoint = Path(run.job.staging) / records.CHECKPOINT
    try:
        trained = train(
            method,
            part,
            stop,
            _probe_truth(run.job, part),
            seed=run.job.seed,
            device=machine.device,
            observer=display.update,
            checkpoints=checkpoints,
        )
    except DivergedError:
        _save(method, checkpoint, part)  # as the last good step left it
        raise
    display.wait(f"{len(part.test)} test views")
    saved = _save(method, checkpoint, part)
    # What is scored is what the checkpoint holds, and nothing that only the training knows.
    loaded = make_method(run.spec, run.config)
    loaded.load(saved, device=machine.device)
    for frame in part.test[:1]:
        loaded.render(part.view(frame), part.method_period(frame))  # the first time takes longer
    seconds = 0.0
    drawn: list[Any] = []
    for frame, shown in _shown(loaded, run.job, part):
        spent, touching = _render_view(shown, part, frame, writer)
        seconds += spent
        drawn.append(touching)
    for frame in part.ahead:
        _render_view(loaded, part, frame, writer)
    total = None if None in drawn else sum(drawn)
    size, sharing = loaded.size(), loaded.sharing() if hasattr(loaded, "sharing") else None
    if sharing is not None:
        check_sharing(sharing, size, f"model {part.name}")
    return PartOutcome(trained, saved, size, seconds, sharing, total)


def _checkpoints(
    run: ResolvedRun, part: Part, parts: int, machine: Machine, display: ProgressDisplay
) -> Checkpoints:
    """Return the checkpoints of one model of the run."""
    job = run.job
    return Checkpoints(
        folder=job.training / part.name,
        settings=run.document,
        commit=job.commit,
        device=str(machine),
        every=job.settings.checkpoint_seconds,
        # With several models, those that are done must not be trained again.
        keep_last=job.settings.keep_training or parts > 1,
        start=Path(job.continues) / records.TRAINING / part.name if job.continues else None,
        log=display.log,
    )


def _probe_truth(job: Job, part: Part) -> Truth:
    """Ground truth of the probe views, from the frozen images."""
    folder = ground_truth_folder(job.settings.runs, job.scene)
    names = {frame.name for frame in probe_frames(part)}
    entries = [e for e in read_manifest(folder).images if e.view in names]
    found = {e.view: (load_image(folder, e), load_mask(folder, e)) for e in entries}
    return {
        view: (photo, mask) for view, (photo, mask) in found.items() if mask is None or mask.any()
    }


def _save(method: Method, checkpoint: Path, part: Part) -> Path:
    """Save into ``checkpoint``, or a folder below it for each of several models."""
    target = checkpoint / part.subfolder
    partial = target.with_name(f"{target.name}.partial")
    partial.mkdir(parents=True)
    method.save(partial)
    os.replace(partial, target)
    return target


def _peak_device_memory(device: str) -> int | None:
    if device != "cuda":
        return None
    import torch

    return int(torch.cuda.max_memory_allocated())


def _record(
    run: ResolvedRun,
    scene: Scene,
    machine: Machine,
    outcomes: list[PartOutcome],
    peaks: tuple[int | None, int | None],
    started: str,
) -> records.RunRecord:
    """The record of the run, without its scores."""
    job, spec, tests = run.job, run.spec, len(scene.select(split="test"))
    code = [commit for outcome in outcomes for commit in outcome.trained.commits]
    devices = [device for outcome in outcomes for device in outcome.trained.devices]
    # The stages of a training leave one model.
    models = outcomes[-1:] if STRATEGIES[job.strategy].in_order else outcomes
    drawn = [model.drawn for model in models]
    absent = {} if tests else dict.fromkeys(("drawn", "render_seconds"), NO_TESTS)
    if len(models) > 1 or models[0].sharing is None:
        absent["sharing"] = NOTHING_SHARED
    return records.RunRecord(
        method=spec.name,
        strategy=job.strategy,
        scene=scene.name,
        seed=job.seed,
        aggregates={},
        periods={},
        seconds=sum(o.trained.seconds for o in outcomes),
        iterations=sum(o.trained.iterations for o in outcomes),
        empty_steps=sum(o.trained.empty_steps for o in outcomes),
        skipped_steps=sum(o.trained.skipped_steps for o in outcomes),
        resumed=max(o.trained.resumed for o in outcomes),
        primitives=sum(model.size.primitives for model in models),
        primitive=outcomes[0].size.unit,
        sharing=models[0].sharing if len(models) == 1 else None,
        drawn=None if None in drawn or not tests else sum(filter(None, drawn)) / tests,
        checkpoint_bytes=sum(records.size_of(model.folder) for model in models),
        peak_memory_bytes=peaks[0],
        device="; ".join(dict.fromkeys([*devices, str(machine)])),
        commit="; ".join(dict.fromkeys([*code, job.commit])),
        skipped={},
        absent=absent,
        title=spec.title_of(job.settings.preset_name),
        preset=job.settings.preset_name,
        variant=job.variant,
        protocol=job.settings.protocol,
        fitted="left half" if job.settings.fit_half else "",
        method_version=method_version(job.origin.method),
        config_hash=run.document["config_hash"],
        scene_hash=job.scene_hash,
        split_hash=job.split_hash,
        period_labels={str(p.id): p.label for p in scene.periods},
        parameters=sum(model.size.parameters for model in models),
        warmup_seconds=0.0,
        waited_seconds=sum(o.trained.waited_seconds for o in outcomes),
        setup_seconds=sum(o.trained.setup_seconds for o in outcomes),
        render_seconds=sum(m.render_seconds for m in models) / tests if tests else None,
        peak_device_memory_bytes=peaks[1],
        threads=machine.threads,
        max_width=job.settings.max_width,
        libraries=library_versions(),
        started=started,
        notices=[],
    )


def _unheld(run: ResolvedRun, parts: Sequence[Part]) -> list[str]:
    """Return a notice if surfaces are to be held to sparse points, of which there are none."""
    sets = [part.train for part in parts] if getattr(run.config, "depth_weight", 0.0) else []
    if not sets or any(len(s.load_depths(i).pixels) for s in sets for i in range(len(s.views))):
        return []
    return [
        f"{run.job.label}: depth_weight had no effect, as no training image observes a point that "
        f"{MIN_IMAGES} images do (chronoscene triangulate makes points)"
    ]


def _skips(job: Job, record: records.RunRecord) -> list[str]:
    """Return notices on steps that changed nothing."""
    reasons = {
        "empty: their photos show nothing of the model": record.empty_steps,
        "skipped: their loss or gradients were not finite": record.skipped_steps,
    }
    steps = record.iterations
    return [f"{job.label}: {n} of {steps} steps {why}" for why, n in reasons.items() if n]


def execute(document: dict[str, Any], report: Report) -> None:
    """Run the job in ``document``; every failure ends in ``failed.json``."""
    job = replace(Job.from_document(document), commit=code_version())
    staging = Path(job.staging)
    place = job.origin.plugin_path
    if place is not None and place not in sys.path:
        sys.path.append(place)
    try:
        with needing_space(job.folder):
            run_job(job, report if job.reports else None)
    except DiskFullError:  # nothing can be recorded, and the other runs would fail as well
        raise
    except ChronoSceneError as error:
        records.write_failure(staging, job.failure(str(error)))
    except Exception as error:  # a fault in a method must not end the other runs
        write_text_atomic(staging / records.ERROR_LOG, traceback.format_exc())
        reason = f"{type(error).__name__}: {error} (see {records.ERROR_LOG})"
        records.write_failure(staging, job.failure(reason))
