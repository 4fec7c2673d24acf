"""The routes from matches to one model, as tasks of the worker process.

``joint`` maps the photos of all periods together, ``separate`` each period alone, and
``add_period`` registers new photos in a scene whose poses and cameras stay. ``refine`` adjusts a
model again after tie points have moved its periods.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from chronoscene.errors import RegistrationError
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.control.adjustment import add_point, adjust_with_control
from chronoscene.registration.features.database import copy_with_cameras, verified_matches
from chronoscene.registration.reconstruct.consistency import (
    MIN_LINK,
    Matches,
    agreement,
    deregister_misplaced,
    loosest_part,
    pair_agreements,
    point_agreements,
    share_across,
)
from chronoscene.registration.reconstruct.focal import hold_focals
from chronoscene.registration.reconstruct.gps_alignment import Priors, to_gps_frame
from chronoscene.registration.reconstruct.lens import with_full_lens
from chronoscene.registration.reconstruct.mapping import (
    Task,
    adjust,
    drop_bad,
    map_images,
    register_rest,
    triangulate,
)
from chronoscene.registration.reconstruct.models import known_images, only, set_poses, summary
from chronoscene.registration.reconstruct.submodels import Combined, Submodel, combine

MIN_POINTS = 50
"""With fewer points from the photos of the scene, no new photos are registered against them."""

MIN_AGREEMENT = 0.5
"""Share of the matches among the photos of the scene that must agree with its poses."""

ROUNDS = 2  # Of triangulation with all matches and bundle adjustment, after merging
ATTEMPTS = 2
"""To register an image, as at the second more of the others have poses; to place loose parts."""


def joint(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Map all images together; submodels that did not connect are merged afterwards.

    Arguments: ``database``, ``photos``, ``periods`` (by name), ``priors`` (``enu`` and ``sigma`` by
    name, or null), ``focals`` (see `focal.Focals`), ``full_lens`` (see `lens`), ``keep_unplaced``
    (see `submodels.combine`), ``out`` (model folder), ``scratch``, ``threads``.
    """
    task = Task.start(arguments, report)
    models = _mapped(task, sorted(arguments["periods"]), arguments)
    submodels = [Submodel(f"submodel {i}", model) for i, model in enumerate(models)]
    return _merged(submodels, arguments, task)


def _mapped(
    task: Task, names: Sequence[str], arguments: Mapping[str, Any], label: str = ""
) -> list[pycolmap.Reconstruction]:
    """Models of images, with the focal lengths that photos state where images leave them open."""

    def again(held: Task) -> list[pycolmap.Reconstruction]:
        return map_images(held, names, label=f"{label}-held".strip("-"))

    models = map_images(task, names, label=label)
    return hold_focals(task, models, arguments.get("focals", {}), again)


def separate(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Map each period alone, then align, merge and adjust the models.

    Args:
        arguments: As in `joint`, and ``labels`` of the periods.
        report: Receives progress.
    """
    task = Task.start(arguments, report)
    periods: Mapping[str, int] = arguments["periods"]
    submodels = []
    for period in sorted(set(periods.values())):
        names = sorted(n for n, p in periods.items() if p == period)
        models = _mapped(task, names, arguments, f"period-{period}")
        for i, model in enumerate(models):
            adjust(model, task)
            label = f"period {arguments['labels'][period]}"
            label += f" submodel {i}" if len(models) > 1 else ""
            submodels.append(Submodel(label, model, period, is_largest=i == 0))
    return _merged(submodels, arguments, task)


def _merged(
    submodels: Sequence[Submodel], arguments: Mapping[str, Any], task: Task
) -> dict[str, Any]:
    """Align, merge, adjust and write submodels, and return the result of the task."""
    if not submodels:
        also = "; tie points align models, they do not create them"
        raise RegistrationError(
            "structure from motion",
            expected=f"a model of {len(arguments['periods'])} photos",
            found="no pair of photos to start it from",
            todo="add photos that overlap by more than half, taken from different positions"
            f"{also if arguments['keep_unplaced'] else ''}",
        )
    _, matches = verified_matches(task.database)
    priors = Priors.of(arguments["priors"])
    if len(submodels) == 1:
        combined = Combined(submodels[0].model, (), (), ())
        model = combined.model
        adjust(model, task)
    else:
        task.report("aligning", 0, 1)
        for submodel in submodels:  # whose labels the remarks below have
            names = sorted(submodel.names)
            task.remarks.append(f"{submodel.label}: {len(names)} images, {names[0]} to {names[-1]}")
        keep = arguments["keep_unplaced"]
        combined = combine(submodels, matches, priors, task.database, keep_unplaced=keep)
        task.remarks.extend(combined.remarks)
        model = _adjusted_in_rounds(combined.model, task)
    if not combined.unplaced:  # periods that wait for tie points would contradict the others
        model = _settled(model, matches, len(arguments["periods"]), task)
        model = rejoined(model, matches, priors, task)
    if arguments.get("full_lens", False):
        model = with_full_lens(model, task, arguments.get("focals", {}))
    task.report("adjusting", 0, 1)
    placed, used = to_gps_frame(model, priors, task.remarks)
    if placed:
        before = summary(model)["reprojection_error_px"]
        ended = adjust(model, task, priors=used)
        after = summary(model)["reprojection_error_px"]
        task.remarks.append(
            f"bundle adjustment with {len(used.enu)} position priors: {ended.lower()}, "
            f"reprojection error {before} -> {after} px"
        )
    return task.finish(
        model,
        is_georeferenced=placed,
        positions_used=sorted(used.enu),
        left=[list(group) for group in combined.left],
        unplaced=list(combined.unplaced),
    )


def _adjusted_in_rounds(model: pycolmap.Reconstruction, task: Task) -> pycolmap.Reconstruction:
    for i in range(ROUNDS):
        task.report("adjusting", i, ROUNDS)
        model = triangulate(model, task, "points")
        adjust(model, task)
    return model


def rejoined(
    model: pycolmap.Reconstruction, matches: Matches, priors: Priors, task: Task
) -> pycolmap.Reconstruction:
    """Place parts that most matches contradict again, by matches or GPS, if that helps."""
    agreements = point_agreements(model, matches)
    for _ in range(ATTEMPTS):
        ids = sorted(model.reg_image_ids())
        part = loosest_part(agreements, ids)
        if not part:
            break
        names = sorted(str(model.images[i].name) for i in part)
        place = f"part of {len(part)} images, {names[0]} to {names[-1]}"
        halves = [
            Submodel(label, triangulate(only(model, some), task, "part"))
            for label, some in (("the rest", set(ids) - part), (place, part))
        ]
        combined = combine(halves, matches, priors, task.database)
        before = share_across(agreements, part)
        remark = f"{place}: {before:.0%} of the matches with the others agree with it"
        if combined.left:
            task.remarks.append(f"{remark}; neither matches nor GPS place it elsewhere")
            break
        found = _adjusted_in_rounds(combined.model, task)
        again = point_agreements(found, matches)
        after = share_across(again, part)
        if after < max(before, MIN_LINK):
            task.remarks.append(f"{remark}, and {after:.0%} where it was placed again: left")
            break
        model, agreements = found, again
        task.remarks.extend([*combined.remarks, f"{remark}, and {after:.0%} where it is now"])
    return model


def _settled(
    model: pycolmap.Reconstruction, matches: Matches, total: int, task: Task
) -> pycolmap.Reconstruction:
    """Register missing images, deregister those that the others contradict, and try these again."""
    for _ in range(ATTEMPTS):
        model = _complete(model, total, task)
        if not deregister_misplaced(model, matches, task.remarks):
            break
        adjust(model, task)
    return model


def _complete(model: pycolmap.Reconstruction, total: int, task: Task) -> pycolmap.Reconstruction:
    """Register images that their own period could not: other periods may have points for them."""
    before = int(model.num_reg_images())
    if before == total or not model.num_points3D():
        return model
    fuller = register_rest(model, task, total, "rest")
    added = int(fuller.num_reg_images()) - before
    if added <= 0:
        return model
    adjust(fuller, task)
    task.remarks.append(f"{added} more images registered with the merged model")
    return fuller


def add_period(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Register new photos in the frame of a scene.

    The photos of the scene get new features, and points are triangulated from them at the poses of
    the scene. New photos are then registered against these points one after the other, and a last
    bundle adjustment moves only what is new.

    Arguments: ``database``, ``photos``, ``poses`` (``cam_from_world``, 3 x 4, by name, of the
    scene's images), ``periods`` (by name, of all), ``out``, ``scratch``, ``threads``.
    """
    task = Task.start(arguments, report)
    poses = arguments["poses"]
    model = known_images(task.database)
    old = set_poses(model, poses)
    _, matches = verified_matches(task.database)
    agreeing = agreement(pair_agreements(model, matches), old)
    if agreeing < MIN_AGREEMENT:
        raise RegistrationError(
            "the scene",
            expected=f"poses that agree with {MIN_AGREEMENT:.0%} of the matches of its images",
            found=f"{agreeing:.0%}",
            todo="check that its poses belong to its images: chronoscene validate",
        )
    report("triangulating", 0, 1)
    model = triangulate(model, task, "base")
    points = int(model.num_points3D())
    task.remarks.extend(
        [
            f"{agreeing:.0%} of the matches within the scene agree with its poses",
            f"{len(old)} images of the scene give {points} points; their poses are unchanged",
        ]
    )
    if points < MIN_POINTS:
        raise RegistrationError(
            "the scene",
            expected=f"at least {MIN_POINTS} points triangulated from its images at their poses",
            found=f"{points}",
            todo="check that its poses belong to its images: chronoscene validate",
        )
    model = register_rest(model, task, len(arguments["periods"]), "continued")
    deregister_misplaced(model, matches, task.remarks, sorted(old))
    new = [i for i in model.reg_image_ids() if i not in old]
    if not new:
        raise RegistrationError(
            "the new period",
            expected="photos that match those of the scene",
            found="none that could be registered",
            todo="add photos with viewpoints like those of the scene, or register all periods "
            "together",
        )
    report("adjusting", 0, 1)
    ended = adjust(model, task, constant=old)
    moved = _max_change(model, poses)
    task.remarks.append(f"{len(new)} new images registered")
    task.remarks.append(
        f"bundle adjustment of the new images: {ended.lower()}; old poses changed by {moved:.1e}"
    )
    return task.finish(model)


def refine(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Triangulate at given poses, add tie points, adjust, and write the model.

    Arguments: ``database``, ``photos``, ``poses`` (3 x 4 by name), ``cameras`` (model and
    parameters by name), ``ties`` (each with ``xyz`` and ``clicks``: name, x, y), ``control`` (see
    `adjustment.adjust_with_control`), ``out``, ``scratch``, ``threads``, ``short`` and ``held`` (of
    the model before).
    """
    task = Task.start(arguments, report)
    cameras: Mapping[str, tuple[str, list[float]]] = arguments["cameras"]
    images = known_images(task.database).images.values()
    found = {i.camera_id: cameras[str(i.name)] for i in images if str(i.name) in cameras}
    database = task.scratch / "refined.db"
    copy_with_cameras(task.database, database, found)
    task.database = str(database)
    model = known_images(task.database)
    set_poses(model, arguments["poses"])
    for i in range(2):
        report("adjusting", i, 2)
        model = triangulate(model, task, "")
        for tie in arguments["ties"]:
            add_point(model, tie)
        if arguments["control"]:
            adjust_with_control(
                model, arguments["control"], hold_focal=task.held, threads=task.threads
            )
            drop_bad(model, task.min_angle)
        else:
            adjust(model, task)
    counts = f"{len(arguments['ties'])} tie points and {len(arguments['control'])} control points"
    task.remarks.append(f"adjusted with {counts}")
    return task.finish(model)


def _max_change(model: pycolmap.Reconstruction, poses: Mapping[str, Any]) -> float:
    """Largest change of any entry of the poses of the scene's images, to check the solver."""
    changes = [
        np.abs(image.cam_from_world().matrix() - np.array(poses[str(image.name)])).max()
        for i in model.reg_image_ids()
        if str((image := model.images[i]).name) in poses
    ]
    return float(max(changes, default=0.0))
