"""From captures to a registered scene: the stages in order, each done once."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from chronoscene.colmap.model import copy_poses
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.geodesy import ReferenceSystem, read_projected
from chronoscene.io.processes import Report
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.wording import printable
from chronoscene.registration import output
from chronoscene.registration.context import Context, Options
from chronoscene.registration.control.route import check_options, resect_photos
from chronoscene.registration.features.correspondences import find_matches
from chronoscene.registration.features.given.source import find_sources
from chronoscene.registration.output import Inspection, inspect_registration
from chronoscene.registration.photos.captures import Captures
from chronoscene.registration.photos.inputs import PhotoInputs, gather
from chronoscene.registration.reconstruct.estimation import estimate, refined
from chronoscene.registration.reconstruct.extension import add_period
from chronoscene.registration.report.coordinates import write_coordinates
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_alignment import TieAlignment, tie
from chronoscene.registration.ties.tie_points import TiePoints, by_photo, read_tie_points
from chronoscene.registration.work_folder import Stages, work_folder
from chronoscene.scene import Scene
from chronoscene.undistort import undistort

SCHEMA_VERSION = 1  # Version of the log

Inspected = Callable[[Inspection], None]


def run(
    captures: Captures,
    out: Path,
    options: Options | None = None,
    *,
    into: Scene | None = None,
    report: Report | None = None,
    inspected: Inspected | None = None,
) -> Registered:
    """Register all periods and write a scene.

    Args:
        captures: From `chronoscene.registration.photos.captures.read_captures`.
        out: Folder that does not exist or is empty.
        options: Settings; None for the defaults.
        into: Scene to which the captures are added as one new period; its poses do not change.
        report: Called with the progress.
        inspected: Called with the certificate and the verdicts.

    Raises:
        RegistrationError: If there is no model, or none of the photos can be placed; what was
            computed is kept in the work folder.
        SceneError: If ``out`` is in use, tie points do not suffice, have no clicks or do not say
            in which photos, or ``into`` has distortion.
        ConfigError: If tie points are given together with ``into``, the reference system is
            unsuitable, or given features are not there.
    """
    options = options or Options()
    out = Path(out)
    if into is not None and options.tie_points is not None:
        raise ConfigError(
            "--tie-points",
            expected="a registration of all periods",
            found="--into, which does not move existing poses",
            todo="omit one of the two",
        )
    check_options(options)
    find_sources(options.features, options.matches)  # errors in these come before any work
    output.check_free(out, overwrite=options.overwrite)
    work = options.work_folder(out)
    crs = None if options.crs is None else read_projected("--crs", options.crs)
    points = None
    if options.tie_points is not None:
        points = read_tie_points(options.tie_points, scale=options.tie_scale, crs=crs)
        if not any(point.clicks for point in points.points):
            raise SceneError(
                options.tie_points,
                expected="points that are clicked in photos",
                found="coordinates without a click",
                todo="mark the points: chronoscene mark CAPTURES PAGE --tie-points FILE",
            )
        if crs is None and points.crs is not None and points.crs.is_projected:
            crs = read_projected(str(options.tie_points), points.crs.text)
    with work_folder(work) as lock:
        context = Context(work, Stages(work), options, report, lock)
        inputs = gather(captures, into, context)
        if points is not None:
            points = by_photo(points, inputs.sizes())
        matched = find_matches(inputs, context)
        ties: TieAlignment | None
        if options.route == "resection" and points is not None:
            registered, ties = resect_photos(inputs, matched, points, crs, context)
            context.stages.remark("tie points", *ties.remarks)
        else:
            found_model = estimate(inputs, matched, context)
            registered, ties = _tie(found_model, points, crs, inputs, context)
        registered = replace(registered, features=matched.made_by)
        scene = _stage_scene(registered, inputs, out.resolve().name, context)
        staged = scene.root
        if ties is not None and (ties.replaced or ties.controlled):
            points = None  # they are points of the model already
        found = inspect_registration(
            registered,
            staged,
            page=options.page,
            ties=ties,
            tie_points=points,
            title=f"Registration of {printable(out.resolve().name)}",
        )
        for name, judged in (("alignment", found.verdict), ("absolute position", found.position)):
            context.stages.remark(name, f"{judged.level}: {judged.text}")
        write_coordinates(staged, scene, registered.georeference, crs)
        write_text_atomic(staged / output.LOG, log_text(_log(registered, inputs, context)))
        output.check_free(out, overwrite=options.overwrite)
        output.publish(staged, out)
    if inspected is not None:
        inspected(found)
    return registered


def _tie(
    registered: Registered,
    points: TiePoints | None,
    crs: ReferenceSystem | None,
    inputs: PhotoInputs,
    context: Context,
) -> tuple[Registered, TieAlignment | None]:
    """Check and align with tie points, if there are any."""
    if points is None:
        return registered, None

    def refine(arguments: Mapping[str, Any]) -> Registered:
        return refined(registered, arguments, inputs, context)

    result = tie(registered, points, refine, crs)
    context.stages.remark("tie points", *result.remarks)
    return result.model, result


def _stage_scene(registered: Registered, inputs: PhotoInputs, name: str, context: Context) -> Scene:
    """Write the scene into the work folder; return it."""
    staged = context.work / "scene"
    old = inputs.scene
    scene = output.as_scene(registered, name)
    if old is not None:
        scene = add_period(old, scene, registered)
    shutil.rmtree(staged, ignore_errors=True)
    progress = None if context.report is None else partial(context.report, "images")
    done = undistort(scene, staged, progress=progress)
    remarks = [
        f"{len(done.scene.frames)} images, {len(done.scene.points)} points, "
        f"{done.observations_lost} observations lost, {done.points_lost} points lost"
    ]
    if old is not None:
        model = our_format.MODEL  # a scene in another format may lack it, or have other poses there
        if copy_poses(old.root / model, staged / model, old.frames):
            remarks.append(f"poses of {len(old.frames)} images copied unchanged")
    context.stages.remark("scene", *remarks)
    return done.scene


def _log(registered: Registered, inputs: PhotoInputs, context: Context) -> dict[str, Any]:
    """Collect all decisions, as JSON."""
    return {
        "schema_version": SCHEMA_VERSION,
        "captures": str(inputs.captures.root),
        "into": None if inputs.scene is None else str(inputs.scene.root),
        "work": str(context.work),
        "options": context.options.record(),
        "route": registered.route,
        "unit": registered.unit,
        "periods": registered.counts(),
        "unregistered": [
            {"image": name, "period": registered.unregistered_periods[name], "reason": reason}
            for name, reason in sorted(registered.unregistered.items())
        ],
        "stages": context.stages.log,
    }


def log_text(log: Mapping[str, Any]) -> str:
    """JSON of a log; bytes in names of folders that are not UTF-8 are escaped."""
    text = json.dumps(log, indent=1, ensure_ascii=False) + "\n"
    return text.encode("utf-8", "backslashreplace").decode()
