"""Aligning periods by tie points, and residuals of every point.

Each period places the tie points by its own images. Two periods that share three or more points,
not on one line, are brought together by the similarity between them; ground control moves the whole
model. What does not fit is named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from chronoscene.errors import SceneError
from chronoscene.registration.quality.rays import (
    Array,
    Mask,
    Placed,
    Rays,
    model_rays,
    place,
    project,
    rays_at,
)
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_points import TiePoints, match_images
from chronoscene.scene.geometry import Sim3
from chronoscene.scene.similarity import SIGMA, fit
from chronoscene.scene.tracks import track_owners

Mode = Literal["auto", "check", "replace"]

OUTLIER_PIXELS = 12.0
"""A click is not called an outlier below this: people click to within a few pixels."""

CLICK_PIXELS = 2.0
"""Expected standard deviation of a click."""

GOOD_PIXELS = 10.0
"""Median residual up to which the alignment that is there is kept, in mode ``auto``."""


@dataclass(frozen=True, slots=True)
class PointResidual:
    """How well one tie point fits."""

    name: str
    clicks: int
    periods: tuple[str, ...]
    """Labels of the periods whose images it is clicked in."""
    pixels: float | None
    """Root mean square over its clicks; None where it is clicked in one image only."""
    distance: float | None
    """World units: largest distance between its places by single periods, or to its control."""
    outlier: bool
    note: str
    """What is wrong with it, or ``""``."""


@dataclass(frozen=True, slots=True, eq=False)
class TieAlignment:
    """A registration after tie points."""

    model: Registered
    replaced: bool
    """Whether the alignment of periods was replaced."""
    controlled: bool
    """Whether the model was moved to ground control."""
    residuals: tuple[PointResidual, ...]
    remarks: tuple[str, ...]

    @property
    def outliers(self) -> tuple[str, ...]:
        return tuple(r.name for r in self.residuals if r.outlier)


@dataclass(frozen=True, slots=True, eq=False)
class _Clicks:
    """Clicks in registered images (C clicks)."""

    names: tuple[str, ...]
    """Points."""
    rays: Rays
    """A track is an index into ``names``."""
    xy: Array


def align_with_tie_points(
    model: Registered, tie_points: TiePoints, *, mode: Mode = "auto"
) -> TieAlignment:
    """Check a registration by tie points and, where it fails, align its periods by them.

    Args:
        model: Its periods may lie anywhere.
        tie_points: From `chronoscene.registration.ties.tie_points.read_tie_points`.
        mode: ``check`` moves nothing but the whole model to ground control; ``replace`` aligns all
            periods anew; ``auto`` does so where the points do not fit.

    Raises:
        SceneError: If periods must be aligned and the points do not suffice.
    """
    clicks, remarks = _clicks(model, tie_points)
    control = tie_points.located(model.georeference)
    misfit = _misfit(model, clicks)
    replaced = mode == "replace" or (mode == "auto" and not misfit <= GOOD_PIXELS)
    if replaced:
        remarks.append(f"alignment replaced: tie points were off by {misfit:.1f} px (median)")
        model, more = _align_periods(model, clicks, tie_points)
        remarks += more
    model, controlled, more = _to_control(model, clicks, control, tie_points)
    residuals = tuple(_residuals(model, clicks, control if controlled else {}))
    named = [r.name for r in residuals if r.outlier]
    remarks += more + ([f"outliers: {', '.join(named)}"] if named else [])
    return TieAlignment(model, replaced, controlled, residuals, tuple(remarks))


def with_tie_tracks(model: Registered, tie_points: TiePoints) -> Registered:
    """The same model with the tie points as points, so that a bundle adjustment heeds them.

    Points that cannot be placed, and outliers, are left out.
    """
    clicks, _ = _clicks(model, tie_points)
    rays = _moved(clicks.rays, model)
    placed = place_clicks(rays)
    bad = {r.name for r in _residuals(model, clicks, {}) if r.outlier}
    rows, points = [], []
    for track, xyz in zip(placed.track, placed.xyz, strict=True):
        if clicks.names[track] not in bad:
            rows.append(np.flatnonzero(clicks.rays.track == track))
            points.append(xyz)
    if not rows:
        return model
    ends = model.track_start[-1] + np.cumsum([len(r) for r in rows])
    chosen = np.concatenate(rows)
    return replace(
        model,
        points=np.concatenate([model.points, points]),
        colors=np.concatenate([model.colors, np.full((len(points), 3), 255, np.uint8)]),
        track_start=np.concatenate([model.track_start, ends]),
        track_image=np.concatenate([model.track_image, clicks.rays.image[chosen]]),
        track_xy=np.concatenate([model.track_xy, clicks.xy[chosen]]),
    )


def _clicks(model: Registered, tie_points: TiePoints) -> tuple[_Clicks, list[str]]:
    images = match_images(tie_points, model.names)
    missing = sorted(name for name, i in images.items() if i is None)
    remarks = [f"{name}: clicked in, but not registered" for name in missing]
    track, image, xy = [], [], []
    for number, point in enumerate(tie_points.points):
        for click in point.clicks:
            index = images[click.image]
            if index is None:
                continue
            camera = model.cameras[index]
            if not (0 <= click.x <= camera.width and 0 <= click.y <= camera.height):
                raise SceneError(
                    f"{tie_points.path}:{click.line}",
                    expected=f"a pixel of {click.image} ({camera.width} x {camera.height})",
                    found=f"{click.x:g}, {click.y:g}",
                    todo="correct the line; where the photos are smaller than those that were "
                    "clicked in, give the ratio as scale",
                )
            track.append(number)
            image.append(index)
            xy.append((click.x, click.y))
    images_of, places = np.array(image, np.int64), np.array(xy, np.float64).reshape(-1, 2)
    rays = rays_at(model, np.array(track, np.int64), images_of, places)
    return _Clicks(tuple(p.name for p in tie_points.points), rays, places), remarks


def _moved(rays: Rays, model: Registered) -> Rays:
    return replace(rays, pose=model.cam_from_world[rays.image])


def place_clicks(rays: Rays) -> Placed:
    """Points of clicks. One bad click of a point with three or more is found and left out."""
    placed = place(rays)
    missing = np.setdiff1d(rays.track, placed.track)
    rescued = [p for t in missing if (p := _without_one(rays.where(rays.track == t)))]
    parts = [placed, *rescued]
    whole = [np.concatenate([getattr(p, n) for p in parts]) for n in _PLACED]
    order = np.argsort(whole[0], kind="stable")
    return Placed(*(a[order] for a in whole))


_PLACED = ("track", "xyz", "covariance", "error")


def _without_one(rays: Rays) -> Placed | None:
    """The best placing of a point with one of its clicks left out."""
    if len(rays) < 4:
        return None
    trials = [place(rays.where(np.delete(np.arange(len(rays)), i))) for i in range(len(rays))]
    good = [t for t in trials if len(t.track)]
    return min(good, key=lambda t: float(t.error[0]), default=None)


def _misfit(model: Registered, clicks: _Clicks) -> float:
    """Median residual in pixels of points placed by one period in the images of the others."""
    rays = _moved(clicks.rays, model)
    periods = model.periods[rays.image]
    errors = [np.zeros(0)]
    for p in np.unique(periods):
        placed = place_clicks(rays.where(periods == p))
        others = rays.where(periods != p)
        found, slot = placed.find(others.track)
        residual = project(others.where(found), placed.xyz[slot])[0]
        errors.append(np.nan_to_num(np.linalg.norm(residual, axis=1), nan=np.inf))
    every = np.concatenate(errors)
    return float(np.median(every)) if len(every) else np.inf


def _align_periods(
    model: Registered, clicks: _Clicks, tie_points: TiePoints
) -> tuple[Registered, list[str]]:
    """Bring every period to the one that places most points, along the best shared points."""
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
        found = robust_similarity(source, goal)
        if found is None:
            raise _too_few(model, tie_points, p, len(shared[p]))
        moves[p], used = found
        rejected = [clicks.names[t] for t, u in zip(shared[p], used, strict=True) if not u]
        note = f"; without {', '.join(rejected)}" if rejected else ""
        remarks.append(f"period {model.labels[p]}: by {int(used.sum())} tie points{note}")
        done[p] = dict(zip(own[p].track.tolist(), moves[p].apply(own[p].xyz), strict=True))
    return move_periods(model, moves), remarks


def _too_few(model: Registered, tie_points: TiePoints, period: int, count: int) -> SceneError:
    images = match_images(tie_points, model.names)
    missing = sorted(name for name, i in images.items() if i is None)
    also = f", and clicks in {len(missing)} photos without a pose: " if missing else ""
    also += ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
    return SceneError(
        tie_points.path,
        expected=f"three points or more, not on one line, each clicked in two images of period "
        f"{model.labels[period]} and in two of another period",
        found=f"{count} such points{also}",
        todo="click more points, spread over the scene; a point needs two images of each period",
    )


def robust_similarity(source: Array, target: Array) -> tuple[Sim3, Mask] | None:
    """Similarity of a few points, and which of them it rests on; None where they do not fix one.

    With five points or more, wrong ones are left out: of the similarities of all triples the one
    with the smallest median distance is taken, then all points within three deviations of it.
    """
    from itertools import combinations, islice

    count = len(source)
    if count < 3 or _thickness(source) < 0.02 or _thickness(target) < 0.02:
        return None
    used = np.ones(count, bool)
    if count >= 5:
        best, least = None, np.inf
        for triple in islice(combinations(range(count), 3), 5000):
            rows = list(triple)
            if _thickness(source[rows]) < 0.02:
                continue
            if (trial := fit(source[rows], target[rows])) is not None:
                distance = np.linalg.norm(trial.apply(source) - target, axis=1)
                # The three points of the trial fit by construction.
                middle = float(np.sort(distance)[(count + 3) // 2])
                if middle < least:
                    best, least = trial, middle
        if best is not None:
            distance = np.linalg.norm(best.apply(source) - target, axis=1)
            spread = 3 * SIGMA * max(least, 1e-4 * float(np.ptp(target, axis=0).max()))
            if (distance <= spread).sum() >= 3:
                used = distance <= spread
    whole = fit(source[used], target[used])
    if whole is None:
        return None
    scale = whole.scale
    return Sim3(scale, whole.matrix / scale, whole.translation), np.asarray(used)


def _thickness(points: Array) -> float:
    """Second singular value over the first: 0 on a line."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(values[1] / values[0]) if values[0] > 0 else 0.0


def move_periods(model: Registered, moves: dict[int, Sim3]) -> Registered:
    """Move periods against each other; points that several see are split into one for each."""
    poses = model.cam_from_world.copy()
    for p, move in moves.items():
        mine = model.periods == p
        poses[mine] = move.apply_to_pose(poses[mine])
    point = track_owners(model.track_start)
    key = point * model.num_periods + model.periods[model.track_image]
    order = np.lexsort([np.arange(len(key)), key])
    kept, count = np.unique(key[order], return_counts=True)
    # A point that is seen by one image of a period only has no place there.
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
    model: Registered, clicks: _Clicks, control: dict[str, Array], tie_points: TiePoints
) -> tuple[Registered, bool, list[str]]:
    """Move the whole model to ground control, if there is enough of it."""
    if not control:
        return model, False, []
    placed = place_clicks(_moved(clicks.rays, model))
    known = [(i, clicks.names[t]) for i, t in enumerate(placed.track) if clicks.names[t] in control]
    source = placed.xyz[[i for i, _ in known]].reshape(-1, 3)
    target = np.array([control[name] for _, name in known]).reshape(-1, 3)
    found = robust_similarity(source, target)
    if found is None:
        remark = f"{len(known)} control points can be placed: three not on one line are needed"
        return model, False, [remark]
    move, used = found
    rejected = [name for (_, name), u in zip(known, used, strict=True) if not u]
    note = f"; without {', '.join(rejected)}" if rejected else ""
    moved = replace(
        model,
        points=move.apply(model.points),
        cam_from_world=move.apply_to_pose(model.cam_from_world),
    )
    return moved, True, [f"moved to {int(used.sum())} control points{note}"]


def _residuals(
    model: Registered, clicks: _Clicks, control: dict[str, Array]
) -> Iterator[PointResidual]:
    rays = _moved(clicks.rays, model)
    placed = place_clicks(rays)
    by_all = dict(zip(placed.track.tolist(), placed.xyz, strict=True))
    own = [
        place_clicks(rays.where(model.periods[rays.image] == p)) for p in range(model.num_periods)
    ]
    for track, name in enumerate(clicks.names):
        mine = rays.where(rays.track == track)
        labels = tuple(model.labels[p] for p in np.unique(model.periods[mine.image]))
        places = [p.xyz[p.track == track] for p in own]
        alone = np.concatenate(places)
        xyz = by_all.get(track, control.get(name, alone.mean(axis=0) if len(alone) else None))
        if xyz is None or not len(mine):
            note = "clicked in one image, or without parallax" if len(mine) else "not registered"
            if len(mine) > 2:
                note = "its clicks do not meet in one point"
            yield PointResidual(name, len(mine), labels, None, None, len(mine) > 2, note)
            continue
        residual = project(mine, np.tile(xyz, (len(mine), 1)))[0]
        error = np.nan_to_num(np.linalg.norm(residual, axis=1), nan=np.inf)
        gaps = np.linalg.norm(alone - control[name], axis=1) if name in control else None
        if gaps is None and len(alone) > 1:
            gaps = np.linalg.norm(alone[:, None] - alone[None], axis=2).ravel()
        yield _residual(model, name, mine, labels, error, gaps)


def _residual(
    model: Registered, name: str, rays: Rays, labels: tuple[str, ...], error: Array,
    gaps: Array | None,
) -> PointResidual:  # fmt: skip
    worst = int(np.argmax(error))
    outlier = bool(error[worst] > OUTLIER_PIXELS)
    note = ""
    if outlier:
        note = f"{error[worst]:.0f} px off in {model.names[rays.image[worst]]}"
    distance = float(gaps.max()) if gaps is not None and len(gaps) else None
    pixels = float(np.sqrt(np.mean(error**2)))
    return PointResidual(name, len(rays), labels, pixels, distance, outlier, note)
