"""Runs of methods that are other programs: export, training, images, score.

The program gets a folder with the training set and nothing else: no photo of a test view, and no
point that only test views see. Its model, its images of the test views and its output
(``program.log``) are kept; everything else that it writes there is deleted.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.errors import ImageError, ProgramError
from chronoscene.formats import load_format, read_scene
from chronoscene.formats.shared.ply import count_vertices
from chronoscene.harness.files import records
from chronoscene.harness.files.predictions import ImageWriter, encode_png, to_grey
from chronoscene.harness.files.provenance import method_version, processor_name
from chronoscene.harness.files.source import write_source
from chronoscene.harness.plan.checks import used_values
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.parts import Part, make_parts
from chronoscene.harness.plan.resolve import ResolvedRun
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.score.images import add_images, foreign_record
from chronoscene.harness.score.scoring import score_job
from chronoscene.harness.train.progress import ProgressDisplay
from chronoscene.images.store import ImageStore
from chronoscene.io.processes import Report
from chronoscene.io.programs import Usage, log_lines, run_program
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.wording import shown
from chronoscene.methods import ProgramConfig, Runner, import_object
from chronoscene.scene import Frame, Period, Scene

LOG = "program.log"
WORK = "work"


@dataclass(frozen=True, slots=True)
class Trained:
    """Cost and size of one trained model."""

    seconds: float
    peak_memory_bytes: int
    """0 if the system does not report it."""
    primitives: int | None
    version: str
    notices: list[str]


def run_external(run: ResolvedRun, runner: Runner, report: Report | None) -> None:
    """Train another program, import its images and score them; arguments as for `run_job`."""
    job, spec = run.job, run.spec
    settings, staging = job.settings, Path(job.staging)
    write_text_atomic(staging / records.CONFIG_FILE, json.dumps(run.document, indent=1) + "\n")
    scene = job.read_scene()
    store = ImageStore(scene, max_width=settings.max_width, memory_limit=0, fixed=True)
    parts = make_parts(scene, store, job.strategy)
    write_source(staging, job.origin, parts[0].train.training_from_world)
    writer = ImageWriter(staging / records.PREDICTIONS)
    stops = run.stops(parts)
    trained = []
    with ProgressDisplay(job.label, report=report) as display:
        for part, stop in zip(parts, stops, strict=True):
            model = " ".join(filter(None, ("trains", part.subfolder)))
            display.wait(f"{spec.title} {model}; what it prints goes to {staging / LOG}")
            trained.append(_run_part(run, runner, scene, part, stop, writer))
    versions = method_version(job.origin.method), trained[0].version
    primitives = [model.primitives for model in trained]
    iterations = [stop.iterations for stop in stops]
    record = foreign_record(
        scene,
        f"{spec.title} is another program, which is watched from outside",
        title=spec.title,
        method=spec.name,
        strategy=job.strategy,
        preset=settings.preset_name,
        variant=job.variant,
        protocol=settings.protocol,
        seed=job.seed,
        seconds=sum(model.seconds for model in trained),
        iterations=None if None in iterations else sum(filter(None, iterations)),
        primitives=None if None in primitives else sum(filter(None, primitives)),
        primitive=runner.unit,
        checkpoint_bytes=records.size_of(staging / records.CHECKPOINT),
        peak_memory_bytes=max(model.peak_memory_bytes for model in trained) or None,
        device=f"the program's choice, {processor_name()}",
        commit=job.commit,
        method_version="; ".join(filter(None, versions)),
        config_hash=run.document["config_hash"],
        scene_hash=job.scene_hash,
        max_width=settings.max_width,
        notices=list(dict.fromkeys([*job.notices, *chain(*(m.notices for m in trained))])),
    )
    if job.seed and "seed" not in used_values(runner, ""):
        record.notices.append(f"{record.label}: {spec.title} takes no seed")
    writer.close_run(record)
    with ProgressDisplay(job.label, report=report) as display:
        display.wait("scores")
        score_job(job, record)


def _run_part(
    run: ResolvedRun, runner: Runner, scene: Scene, part: Part, stop: StopRule, writer: ImageWriter
) -> Trained:
    """Train one model and import its images."""
    job, spec, config = run.job, run.spec, run.config
    assert isinstance(config, ProgramConfig)  # planning has checked it
    staging = Path(job.staging)
    work, log = staging / WORK, staging / LOG
    data, output = work / "data", work / "output"
    values = {
        **dataclasses.asdict(config),
        "data": data,
        "output": output,
        "work": work,
        "seed": job.seed,
        "iterations": stop.iterations or config.iterations,
        "seconds": stop.seconds or 0,
    }

    def execute(words: Iterable[str]) -> Usage:
        command = [word.format(**values) for word in (*shlex.split(config.prefix), *words)]
        return run_program(command, folder=output, log=log)

    output.mkdir(parents=True)
    try:
        version = ""
        with suppress(ProgramError):  # an archive of source code has no commit
            if runner.version:
                execute(runner.version)
                version = log_lines(log)[-1]
        names = export_part(scene, part, data, runner.exports)
        notices = []
        if runner.prepare is not None:
            chosen = replace(config, iterations=values["iterations"])
            found = import_object(runner.prepare)(data, output, chosen)
            notices = [f"{spec.title} {notice}" for notice in found]
        usage = execute(runner.train)
        peaks = [usage.peak_memory_bytes, *(execute(c).peak_memory_bytes for c in runner.render)]
        images = _find_images(runner, output, part.test, names, values)
        add_images(writer, part.test, images, job.settings.max_width)
        primitives = _keep_model(job, runner, output, part, values)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    peak = max(filter(None, peaks), default=0)
    return Trained(usage.seconds, peak, primitives, version, notices)


def export_part(scene: Scene, part: Part, out: Path, format: str) -> dict[str, str]:
    """Write the training set of a model as a scene; return the name of each view in it.

    Images have the size of the evaluation, and plain names in the order of the old ones, to which
    some formats add periods: programs cut names at dots, or drop folders. Test views have black
    photos, as commands that render them want files; no point has an observation in them.

    Args:
        scene: The scene, with its points.
        part: Training and test views of the model.
        out: New folder.
        format: Name of the format to write.

    Raises:
        ProgramError: If programs that read the format choose other test views.
    """
    trained = {view.name for view in part.train.views}
    kept = [f for f in scene.frames if f.name in trained or f in part.test]
    names = {f.name: f"{i:05d}.png" for i, f in enumerate(kept)}
    photos = out.with_name("photos")
    masks = _write_photos(kept, trained, part.store, photos)
    place = {frame.name: i for i, frame in enumerate(kept) if frame.name in trained}
    rank = np.array([place.get(frame.name, -1) for frame in scene.frames], np.int32)
    sizes = [(part.store.camera(frame).size, frame.camera.size) for frame in scene.frames]
    scales = np.array([np.divide(*pair) for pair in sizes])
    observed = scene.points.track_frame
    points = replace(scene.points, track_xy=scene.points.track_xy * scales[observed])
    frames = [
        replace(
            f,
            name=names[f.name],
            camera=part.store.camera(f),
            period=0 if part.hides_period else f.period,
        )
        for f in kept
    ]
    exported = replace(
        scene,
        images_root=photos,
        frames=tuple(frames),
        points=points.select_observed(rank[observed] >= 0, rank),
        periods=(Period(0, part.name),) if part.hides_period else scene.periods,
        masks={names[name]: mask for name, mask in masks.items()},
    )
    load_format(format).write(exported, out, image_source="link")
    shutil.rmtree(photos)
    written = read_scene(out, format=format)
    numbered = {Path(f.name).stem.rpartition("_")[2]: f for f in written.frames}
    views = {old: numbered[Path(name).stem] for old, name in names.items()}
    if other := [old for old, view in views.items() if (view.split == "test") == (old in trained)]:
        raise ProgramError(
            f"test views of a training set in the format {format}",
            expected=f"those that programs with this format use: {written.split_rule}",
            found=f"other ones: {shown(other)}",
            todo="make a scene with them: chronoscene split SCENE --scene-out NEW",
        )
    return {old: view.name for old, view in views.items()}


def _write_photos(
    frames: list[Frame], trained: set[str], store: ImageStore, folder: Path
) -> dict[str, Path]:
    """Write numbered photos, black ones for test views; return masks by name of frame.

    All photos have a mask or none has, as some programs want it.
    """
    folder.mkdir()
    files = {frame.name: folder / f"{i:05d}.mask.png" for i, frame in enumerate(frames)}
    masks: dict[str, Path] = {}
    for i, frame in enumerate(frames):
        pixels, mask = np.zeros((*store.camera(frame).size[::-1], 3), np.uint8), None
        if frame.name in trained:
            pixels, mask = store.load(frame), store.load_mask(frame)
        (folder / f"{i:05d}.png").write_bytes(encode_png(pixels))
        if mask is not None:
            masks[frame.name] = files[frame.name]
            files[frame.name].write_bytes(encode_png(to_grey(mask)))
    if not masks:
        return {}
    for frame in frames:
        if frame.name not in masks:
            whole = np.ones(store.camera(frame).size[::-1], bool)
            files[frame.name].write_bytes(encode_png(to_grey(whole)))
    return files


def _find_images(
    runner: Runner,
    output: Path,
    tests: tuple[Frame, ...],
    names: Mapping[str, str],
    values: Mapping[str, Any],
) -> dict[str, Path]:
    """Return the image of each test view in the output of the program."""
    found = {}
    for index, frame in enumerate(sorted(tests, key=lambda frame: names[frame.name])):
        name = Path(names[frame.name]).stem
        found[frame.name] = output / runner.images.format(**values, name=name, index=index)
    if missing := [path for path in found.values() if not path.is_file()]:
        raise ImageError(
            str(missing[0].relative_to(output)),
            expected=f"an image of each of {len(found)} test views in the output of the program",
            found=f"none of {shown(str(path.relative_to(output)) for path in missing)}",
            todo=f"look at its output in {LOG}",
        )
    return found


def _keep_model(
    job: Job, runner: Runner, output: Path, part: Part, values: Mapping[str, Any]
) -> int | None:
    """Move the model to the checkpoints of the run; return the number of primitives."""
    files = [p for p in sorted(output.glob(runner.model.format(**values))) if p.is_file()]
    if not files:
        raise ProgramError(
            runner.model,
            expected="files of a model in the output of the program",
            found="none",
            todo=f"look at its output in {LOG}",
        )
    primitives = None
    if runner.primitives is not None:
        primitives = count_vertices(output / runner.primitives.format(**values))
    checkpoint = Path(job.staging) / records.CHECKPOINT
    for path in files:
        inside = path.relative_to(output)
        target = checkpoint / part.subfolder / inside
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
    return primitives
