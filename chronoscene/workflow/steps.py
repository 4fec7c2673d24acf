"""The steps from photos to products, in their order: `STEPS`.

A step has a folder of its name. A call that was killed leaves nothing there, or what the next one
continues.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.api import bench
from chronoscene.errors import (
    BackendError,
    CheckpointError,
    ConfigError,
    RegistrationError,
    SceneError,
)
from chronoscene.harness.files.predictions import encode_png, to_bytes
from chronoscene.harness.files.records import RUN_FILE
from chronoscene.harness.plan.settings import PHOTO_MEMORY
from chronoscene.harness.use.changes import usual_pairs
from chronoscene.harness.use.export import make_file, period_files, prepare
from chronoscene.harness.use.page import write_page
from chronoscene.harness.use.trained_run import TrainedRun, open_run
from chronoscene.io.documents import read_json_document
from chronoscene.io.log import Log
from chronoscene.io.processes import Report
from chronoscene.io.staging import sha256_of, staged_folder
from chronoscene.registration.context import Options as Registration
from chronoscene.registration.output import CERTIFICATE, LOG, PAGE, Inspection
from chronoscene.registration.photos.captures import find_captures, read_captures
from chronoscene.registration.pipeline import run as register
from chronoscene.registration.work_folder import fingerprint
from chronoscene.scene import Scene
from chronoscene.survey.products import SUMMARY, SurveyOptions, check_packages, write_survey
from chronoscene.validation.report.html import write_html
from chronoscene.validation.run import validate_scene
from chronoscene.workflow.record import Options, Record

METHOD = "chronogs"
PAGE_BYTES = 25e6
"""Limit of the page to walk through: the default of ``chronoscene page``."""


class Skipped(Exception):  # noqa: N818  (no error: the other steps go on)
    """Reason why a step cannot be done with these photos, or with this installation."""


@dataclass(frozen=True, slots=True)
class Project:
    """Photos, options, and the folder in which everything made of them lies."""

    captures: Path
    """Folder of photos, or a table of periods."""
    table: Path | None
    """Table of periods of the photos in a folder."""
    out: Path
    options: Options
    """``preset``, ``budget`` and ``max_width``, as for `chronoscene.api.bench`."""
    record: Record
    say: Log
    progress: Callable[[str], AbstractContextManager[Report]]
    """Show the progress of work that begins with a named part while the block runs."""
    photo_memory: float = PHOTO_MEMORY / 1e9
    """GB, as for `chronoscene.api.bench`; no result depends on it."""

    @property
    def scene(self) -> Path:
        """Folder of the registered scene, which keeps its name if that of all steps changes."""
        made = self.record.steps.get("register")
        if made is not None and made.results:
            return self.out / "register" / Path(made.results[0]).parts[1]
        return self.out / "register" / self.out.resolve().name

    @property
    def runs(self) -> Path:
        """Folder of runs that share their ground truth: of this scene, in this width."""
        results = self.record.steps["register"].results
        scene = fingerprint([sha256_of(self.out / path) for path in results])
        return self.out / "bench" / f"{self.options['max_width']}px-{scene[:8]}"

    @property
    def run(self) -> Path:
        """Folder of the trained model."""
        return self.out / Path(self.record.steps["bench"].results[0]).parent

    @property
    def certificate(self) -> dict[str, Any]:
        """Content of ``registration.json``."""
        found: dict[str, Any] = read_json_document(self.scene / CERTIFICATE)
        return found

    def fresh(self, step: str) -> Path:
        """Remove the folder of a step with what an earlier call made; returns its path."""
        shutil.rmtree(self.out / step, ignore_errors=True)
        return self.out / step

    def opened(self) -> tuple[TrainedRun, Scene]:
        """Open the trained model, and read its scene."""
        run = open_run(self.run)
        return run, run.scene(self.scene)

    def command(self, *words: str | Path, **options: str | int | Path | None) -> str:
        """Write a command as it is typed, without options that are None."""
        given = [(f"--{name.replace('_', '-')}", v) for name, v in options.items() if v is not None]
        return shlex.join(map(str, ["chronoscene", *words, *(w for pair in given for w in pair)]))


@dataclass(frozen=True, slots=True)
class Step:
    """One step."""

    name: str
    """Its name, and that of its folder."""
    what: str
    """Its result, for people."""
    make: Callable[[Project], Sequence[Path]]
    """Make the result; returns the files by which it is known, the first one to be opened."""
    command: Callable[[Project], str]
    """Command that does the same by hand."""
    after: str | None = None
    """Step whose result it takes; None for the photos."""
    options: tuple[str, ...] = ()
    """Options that its result depends on."""


def _register(project: Project) -> Sequence[Path]:
    scene = project.scene
    judged: list[Inspection] = []
    with project.progress(f"read {project.captures}") as report:
        folder, table = find_captures(project.captures, project.table)
        captures = read_captures(folder, table=table)
        options = Registration(page=True, overwrite=True, **_control(scene))
        register(captures, scene, options, report=report, inspected=judged.append)
    for line in (*captures.notes, *judged[0].summary.splitlines()):
        project.say(line)
    return [scene / PAGE, scene / CERTIFICATE, scene / "sparse/0/images.bin"]


def _control(scene: Path) -> dict[str, Any]:
    """Options for the tie points and ground control of the scene there is, which stay in use."""
    if not (scene / LOG).is_file():
        return {}
    given = read_json_document(scene / LOG)["options"]
    if "tie_points" not in given:
        return {}
    also = {name: given[name] for name in ("tie_scale", "crs") if given.get(name, 1.0) != 1.0}
    return {"tie_points": Path(given["tie_points"]), **also}


def _register_command(project: Project, **options: str) -> str:
    words = "register", project.captures, project.scene, "--overwrite", "--report"
    return project.command(*words, table=project.table, **_control(project.scene) | options)


def _validate(project: Project) -> Sequence[Path]:
    report, out = validate_scene(project.scene), project.fresh("validate")
    with staged_folder(out) as staged:
        (staged / "index.html").write_text(write_html([report]), encoding="utf-8", newline="\n")
    if not report.is_valid:
        raise SceneError(
            project.scene,
            expected="a scene without errors",
            found="errors",
            todo=f"see {out / 'index.html'}",
        )
    return [out / "index.html"]


def _bench(project: Project) -> Sequence[Path]:
    _check_alignment(project)
    options: dict[str, Any] = {**project.options, "log": project.say, "overwrite": True}
    options["photo_memory"] = project.photo_memory
    result = bench(project.scene, METHOD, out=project.runs, **options)
    if result.failures:
        raise CheckpointError(
            project.runs,
            expected="a finished training",
            found=result.failures[0].reason,
            todo="mend that, and run the same command again",
        )
    return [result.runs[0] / RUN_FILE]


def _bench_command(project: Project) -> str:
    words = "bench", project.scene, "--method", METHOD
    return project.command(*words, **project.options, out=project.runs)


def _check_alignment(project: Project) -> None:
    """Refuse to train on periods that are not aligned with each other."""
    alignment = project.certificate["alignment"]
    if alignment["verdict"] == "fail":
        page = project.command("page", "RUN", out=project.out / "page")
        raise RegistrationError(
            project.scene,
            expected="periods that are aligned with each other",
            found=f"the verdict fail: {alignment['text'].rstrip('.')}",
            todo=f"look at {project.scene / PAGE}, click tie points as it suggests, run\n"
            f"  {_register_command(project, tie_points='clicks.csv')}\n"
            "and then this command again; or train on the scene as it is:\n"
            f"  {_bench_command(project)}\n  {page}",
        )


def _page(project: Project) -> Sequence[Path]:
    (run, scene), out = project.opened(), project.fresh("page")
    with project.progress("") as report:
        periods = range(run.num_periods)
        write_page([run], out, scene, periods, max_bytes=PAGE_BYTES, report=report)
    pictures = [out / f"period-{period}.png" for period in periods]
    seen = np.bincount(scene.points.track_frame, minlength=len(scene.frames))
    tests = [i for i, frame in enumerate(scene.frames) if frame.split == "test"]
    frame = scene.frames[max(tests or range(len(scene.frames)), key=lambda i: seen[i])]
    camera = run.photos(scene).camera(frame)
    for period, path in enumerate(pictures):
        rgb = run.render(camera, frame.cam_from_world, period).rgb
        path.write_bytes(encode_png(to_bytes(rgb)))
    return [out / "index.html", *pictures]


def _export(project: Project) -> Sequence[Path]:
    (run, scene), out = project.opened(), project.fresh("export")
    files = period_files(run.record.period_labels, "ply")
    with staged_folder(out) as staged, project.progress("") as report:
        for period, name in files.items():
            report("periods", period, len(files))
            made = make_file(run, scene, period, prepare(run, scene, period), "ply")
            (staged / name).write_bytes(made.data)
    return [out / name for name in files.values()]


def _survey(project: Project) -> Sequence[Path]:
    (run, scene), out = project.opened(), project.fresh("survey")
    if scene.world.unit != "metre":
        raise Skipped("the scene has no scale: neither GPS nor ground control places it")
    options = SurveyOptions(tuple(usual_pairs(run.num_periods)))
    try:
        check_packages()
        with staged_folder(out) as staged, project.progress("") as report:
            write_survey(run, scene, staged, options, report)
    except (BackendError, ConfigError, SceneError) as error:
        raise Skipped(str(error)) from error
    return [out / SUMMARY, *sorted(path for path in out.iterdir() if path.name != SUMMARY)]


def _on_run(*words: str, **options: str) -> Callable[[Project], str]:
    name, *more = words
    return lambda p: p.command(name, p.run, *more, **options, out=p.out / name)


STEPS = (
    Step("register", "scene and certificate", _register, _register_command),
    Step(
        "validate", "check of the scene", _validate,
        lambda p: p.command("validate", p.scene, html=p.out / "validate/index.html"), "register",
    ),
    Step(
        "bench", "trained model and its scores", _bench, _bench_command, "register",
        ("preset", "budget", "max_width"),
    ),
    Step("page", "page to walk through", _page, _on_run("page"), "bench"),
    Step("export", "Gaussians of each date", _export, _on_run("export", period="all"), "bench"),
    Step("survey", "maps, surfaces and changes", _survey, _on_run("survey"), "bench"),
)  # fmt: skip
"""All steps: one that is added here is run, recorded, and on the summary page."""
