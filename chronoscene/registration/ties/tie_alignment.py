"""Alignment of periods by tie points, and of the whole model by ground control.

Each period places the tie points by its own images. Two periods that share three or more points
that are not collinear are aligned by the similarity between them; ground control moves the whole
model, in a local frame without map projection. Check points are only compared. Points that do not
fit are named.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import SceneError
from chronoscene.geodesy import Georeference, ReferenceSystem, median_longitude
from chronoscene.registration.quality.rays import model_rays, place
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.control import (
    CONTRADICTION,
    contradictions,
    control_arguments,
    fit_control,
    keep_positions,
)
from chronoscene.registration.ties.residuals import (
    Clicks,
    PointResidual,
    clicks_of,
    misfit,
    moved,
    place_clicks,
    residuals,
    with_errors,
    with_tie_tracks,
)
from chronoscene.registration.ties.tie_points import TiePoints
from chronoscene.scene.similarity import Sim3, fit_few
from chronoscene.scene.tracks import track_owners

Mode = Literal["auto", "check", "replace"]

Refine = Callable[[Mapping[str, Any]], Registered]
"""Called with poses, cameras and tie points; gives the adjusted registration."""

GOOD_PIXELS = 10.0  # Median residual up to which mode ``auto`` keeps the existing alignment


@dataclass(frozen=True, slots=True, eq=False)
class TieAlignment:
    """Result of checking or aligning a registration by tie points."""

    model: Registered
    replaced: bool
    """True if the alignment of periods was replaced."""
    controlled: bool
    """True if the model was moved to ground control."""
    residuals: tuple[PointResidual, ...]
    remarks: tuple[str, ...]

    @property
    def outliers(self) -> tuple[str, ...]:
        return tuple(r.name for r in self.residuals if r.outlier)


def align_with_tie_points(
    model: Registered,
    tie_points: TiePoints,
    *,
    mode: Mode = "auto",
    output: ReferenceSystem | None = None,
    adjusted: Collection[str] | None = None,
) -> TieAlignment:
    """Check a registration by tie points and, where it fails, align its periods by them.

    Ground control in a reference system georeferences a model that is not.

    Args:
        model: Its periods may be in frames of their own.
        tie_points: With the names of the photos (`tie_points.by_photo`).
        mode: ``check`` only moves the whole model to ground control; ``replace`` also aligns all
            periods again; ``auto`` does so if the points do not fit.
        output: Reference system of the errors; None for the frame of the model.
        adjusted: Control that the model was adjusted with: it is not moved again. None if not.

    Raises:
        SceneError: If periods must be aligned and the points do not suffice.
    """
    every, remarks = clicks_of(model, tie_points)
    clicks = every.without(tie_points.names("check"))
    error = misfit(model, clicks)
    bad = _are_shared(model, clicks) and not error <= GOOD_PIXELS
    replaced = mode == "replace" or (mode == "auto" and bad)
    if replaced:
        remarks.append(f"alignment replaced: tie points were off by {error:.1f} px (median)")
        model, more = _align_periods(model, clicks, tie_points)
        remarks += more
    frame = model.georeference or control_frame(tie_points)
    known = tie_points.located(frame)
    control = {name: known[name] for name in tie_points.names("control") & known.keys()}
    there, used, more = model, set(adjusted or ()), list[str]()
    if adjusted is None:
        there, used, more = _to_control(model, clicks, control, tie_points)
    if used and frame is not None and tie_points.crs is not None:
        # Heights are those of the control from here on, whatever the photos state.
        there = replace(there, georeference=replace(frame, height_kind="as stated"))
        if model.georeference is None:
            there = replace(there, gps_enu=np.full_like(model.gps_enu, np.nan))
    if used and frame is None:
        there = replace(there, local_metres=True)
    if not used and model.georeference is None:
        known = {}  # the place of the model is unknown

    def convert(xyz: Array) -> Array:
        if output is None or there.georeference is None:
            return xyz
        return output.from_local(there.georeference, xyz)

    unit = 1.0 if output is None or there.georeference is None else output.unit

    found = tuple(with_errors(residuals(there, every), tie_points, known, used, convert, unit))
    named = [r.name for r in found if r.outlier]
    remarks += more + ([f"outliers: {', '.join(named)}"] if named else [])
    return TieAlignment(
        there, replaced=replaced, controlled=bool(used), residuals=found, remarks=tuple(remarks)
    )


def _are_shared(model: Registered, clicks: Clicks) -> bool:
    """Return True if any point is clicked in images of several periods."""
    pairs = np.column_stack([clicks.rays.track, model.periods[clicks.rays.image]])
    return bool((np.bincount(np.unique(pairs, axis=0)[:, 0]) > 1).any())


def _align_periods(
    model: Registered, clicks: Clicks, tie_points: TiePoints
) -> tuple[Registered, list[str]]:
    """Align every period to the one that places most points, best shared points first."""
    rays, periods = clicks.rays, model.periods[clicks.rays.image]
    own = [place_clicks(rays.where(periods == p)) for p in range(model.num_periods)]
    there = [p for p in range(model.num_periods) if (model.periods == p).any()]
    reference = max(there, key=lambda p: (len(own[p].track), -p))
    done: dict[int, dict[int, Array]] = {
        reference: dict(zip(own[reference].track.tolist(), own[reference].xyz, strict=True))
    }
    moves = {reference: Sim3.identity()}
    remarks = []
    while left := [p for p in there if p not in moves]:
        target = {t: xyz for points in done.values() for t, xyz in points.items()}
        shared = {p: [t for t in own[p].track.tolist() if t in target] for p in left}
        p = max(left, key=lambda p: len(shared[p]))
        source = own[p].xyz[np.isin(own[p].track, shared[p])]
        goal = np.array([target[t] for t in shared[p]]).reshape(-1, 3)
        found = fit_few(source, goal)
        if found is None:
            raise _too_few(model, tie_points, p, len(shared[p]))
        moves[p], used = found
        rejected = [clicks.names[t] for t, u in zip(shared[p], used, strict=True) if not u]
        note = f"; without {', '.join(rejected)}" if rejected else ""
        remarks.append(f"period {model.labels[p]}: aligned by {int(used.sum())} tie points{note}")
        done[p] = dict(zip(own[p].track.tolist(), moves[p].apply(own[p].xyz), strict=True))
    return move_periods(model, moves), remarks


def _too_few(model: Registered, tie_points: TiePoints, period: int, count: int) -> SceneError:
    missing = sorted(tie_points.images.difference(model.names))
    also = f", and clicks in {len(missing)} photos without a pose: " if missing else ""
    also += ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
    return SceneError(
        tie_points.path,
        expected="three points or more that are not collinear, each clicked in two images of "
        f"period {model.labels[period]} and in two of another period",
        found=f"{count} such {'point' if count == 1 else 'points'}{also}",
        todo="click more points, spread over the scene, each in two images of both periods",
    )


def move_periods(model: Registered, moves: dict[int, Sim3]) -> Registered:
    """Move periods relative to each other; points that several see are split into one for each."""
    poses = model.cam_from_world.copy()
    for p, move in moves.items():
        mine = model.periods == p
        poses[mine] = move.apply_to_pose(poses[mine])
    point = track_owners(model.track_start)
    key = point * model.num_periods + model.periods[model.track_image]
    order = np.lexsort([np.arange(len(key)), key])
    kept, count = np.unique(key[order], return_counts=True)
    # A point that only one image of a period sees is not determined there.
    several = np.repeat(count > 1, count)
    order, kept, count = order[several], kept[count > 1], count[count > 1]
    split = replace(
        model,
        points=model.points[kept // model.num_periods],
        colors=model.colors[kept // model.num_periods],
        track_start=np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
        track_image=model.track_image[order],
        track_xy=model.track_xy[order],
    )
    placed = place(model_rays(split))  # by the old poses of one period each
    xyz = split.points.copy()
    xyz[placed.track] = placed.xyz
    of_point = kept % model.num_periods
    for p, move in moves.items():
        xyz[of_point == p] = move.apply(xyz[of_point == p])
    return replace(split, points=xyz, cam_from_world=poses)


def _to_control(
    model: Registered, clicks: Clicks, control: dict[str, Array], points: TiePoints
) -> tuple[Registered, set[str], list[str]]:
    """Move the whole model to ground control, if there is enough of it; the points used."""
    if not control:
        return model, set(), []
    placed = place_clicks(moved(clicks.rays, model))
    known = [(i, clicks.names[t]) for i, t in enumerate(placed.track) if clicks.names[t] in control]
    source = placed.xyz[[i for i, _ in known]].reshape(-1, 3)
    target = np.array([control[name] for _, name in known]).reshape(-1, 3)
    names, sigma = [name for _, name in known], points.sigmas()
    found = fit_control(source, target, [sigma.get(name) for name in names])
    if found is None:
        remark = (
            f"{len(known)} control points can be placed; three that are not collinear are needed"
        )
        return model, set(), [remark]
    move, used = found
    rejected = [name for (_, name), u in zip(known, used, strict=True) if not u]
    note = f"; without {', '.join(rejected)}" if rejected else ""
    there = replace(
        model,
        points=move.apply(model.points),
        cam_from_world=move.apply_to_pose(model.cam_from_world),
    )
    kept = {name for (_, name), u in zip(known, used, strict=True) if u}
    against = contradictions(names, source, target) if used.all() else []
    remarks = [f"model moved to {len(kept)} control points{note}"]
    return there, kept, remarks + [CONTRADICTION + c for c in against]


def tie(
    model: Registered, points: TiePoints, refine: Refine, output: ReferenceSystem | None = None
) -> TieAlignment:
    """Check a registration by tie points; align and adjust it by them where they do not fit."""
    mode: Mode = "replace" if model.unplaced else "auto"
    first = align_with_tie_points(model, points, mode=mode, output=output)
    if not first.replaced and not first.controlled:
        return first
    used = {r.name for r in first.residuals if r.used}
    arguments = refine_arguments(first.model, points, used)
    adjusted = keep_positions(refine(arguments), first.model)
    last = align_with_tie_points(
        adjusted, points, mode="check", output=output, adjusted=used if used else None
    )
    remarks = (*first.remarks, *last.remarks)
    return replace(last, replaced=first.replaced, remarks=tuple(dict.fromkeys(remarks)))


def control_frame(points: TiePoints) -> Georeference | None:
    """Local frame around the ground control; None without control in a reference system."""
    control = points.names("control")
    if points.crs is None or not control:
        return None
    anywhere = Georeference(latitude=0.0, longitude=0.0, height=0.0, height_kind="as stated")
    known = points.located(anywhere)
    places = anywhere.to_geodetic(np.stack([known[name] for name in sorted(control)]))
    latitude, _, height = np.median(places, axis=0).tolist()
    return Georeference(
        latitude=round(latitude, 7),
        longitude=round(median_longitude(places[:, 1]), 7),
        height=round(height, 2),
        height_kind="as stated",
    )


def refine_arguments(
    model: Registered, points: TiePoints, used: Collection[str] = ()
) -> dict[str, Any]:
    """Poses, cameras and tie points of an aligned model, as arguments of `routes.refine`.

    Args:
        model: The model.
        points: The points.
        used: Names of the control to adjust with.
    """
    ties_alone = tuple(p for p in points.points if p.name not in used)
    tied = with_tie_tracks(model, replace(points, points=ties_alone))
    starts = tied.track_start[len(model.points) :].tolist()
    ties = []
    for xyz, first, last in zip(
        tied.points[len(model.points) :].tolist(), starts[:-1], starts[1:], strict=True
    ):
        rows = range(first, last)
        clicks = [[tied.names[tied.track_image[i]], *tied.track_xy[i].tolist()] for i in rows]
        ties.append({"xyz": xyz, "clicks": clicks})
    named = list(zip(model.names, model.cam_from_world, model.cameras, strict=True))
    return {
        "poses": {name: pose[:3].tolist() for name, pose, _ in named},
        "cameras": {name: [camera.model, list(camera.params)] for name, _, camera in named},
        "ties": ties,
        "control": control_arguments(model, points, sorted(used)),
    }
