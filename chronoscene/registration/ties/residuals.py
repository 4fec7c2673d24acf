"""Clicks as observations: where they place points, and how well each point fits.

A point has two kinds of residuals. The click consistency, in pixels, measures how well clicks and
poses agree with each other: a model that is kilometres off in the world can have none. The
error, in metres, is the distance from surveyed coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array
from chronoscene.registration.quality.rays import PlacedPoints, TrackRays, place, project, rays_at
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_points import Place, Role, TiePoints

OUTLIER_PIXELS = 12.0
"""A click with a smaller error is no outlier: people click to within a few pixels."""


@dataclass(frozen=True, slots=True)
class PointResidual:
    """Residuals of one point."""

    name: str
    clicks: int
    periods: tuple[str, ...]
    """Labels of the periods whose images it is clicked in."""
    click_consistency: float | None
    """Pixels: root mean square distance of its clicks from the projections of the place that they
    determine together. None where they determine none."""
    between_periods: float | None
    """World units: largest distance between its places by single periods."""
    ground_pixel: float | None
    """World units that a pixel covers at the point."""
    place: Place | None
    """World coordinates, by all of its clicks."""
    outlier: bool
    """True if clicks contradict each other."""
    note: str
    """Problem of the point, or ``""``."""
    role: Role = "tie"
    used: bool = False
    """True for control that the model was moved to."""
    surveyed: Place | None = None
    """Coordinates that it should have: of the output reference system, else of the model."""
    error: Place | None = None
    """Metres east, north and up: its place minus what was surveyed, likewise."""


@dataclass(frozen=True, slots=True, eq=False)
class Clicks:
    """Clicks in registered images (C clicks)."""

    names: tuple[str, ...]
    """Points."""
    rays: TrackRays
    """A track is an index into ``names``."""
    xy: Array

    def without(self, names: set[str]) -> Clicks:
        """Clicks of other points; points keep their numbers."""
        kept = ~np.isin(self.rays.track, [i for i, n in enumerate(self.names) if n in names])
        return replace(self, rays=self.rays.where(kept), xy=self.xy[kept])


def clicks_of(model: Registered, tie_points: TiePoints) -> tuple[Clicks, list[str]]:
    images = {name: i for i, name in enumerate(model.names)}
    remarks = [
        f"{name}: has clicks, but "
        + ("is not registered" if name in model.unregistered else "there is no such photo")
        for name in sorted(tie_points.images - images.keys())
    ]
    track, image, xy = [], [], []
    for number, point in enumerate(tie_points.points):
        for click in point.clicks:
            index = images.get(click.image)
            if index is None:
                continue
            track.append(number)
            image.append(index)
            xy.append((click.x, click.y))
    images_of, places = np.array(image, np.int64), np.array(xy, np.float64).reshape(-1, 2)
    rays = rays_at(model, np.array(track, np.int64), images_of, places)
    return Clicks(tuple(p.name for p in tie_points.points), rays, places), remarks


def moved(rays: TrackRays, model: Registered) -> TrackRays:
    return replace(rays, pose=model.cam_from_world[rays.image])


def place_clicks(rays: TrackRays) -> PlacedPoints:
    """Triangulate clicks; a single bad click is left out if the point fits without it."""
    placed = place(rays)
    missing = np.setdiff1d(rays.track, placed.track)
    rescued = [p for t in missing if (p := _without_one(rays.where(rays.track == t)))]
    return PlacedPoints.join(placed, *rescued)


def _without_one(rays: TrackRays) -> PlacedPoints | None:
    """Triangulate a point without the click that fits worst; None if nothing fits."""
    if len(rays) < 4:
        return None
    trials = [place(rays.where(np.delete(np.arange(len(rays)), i))) for i in range(len(rays))]
    good = [t for t in trials if len(t.track)]
    return min(good, key=lambda t: float(t.error[0]), default=None)


def misfit(model: Registered, clicks: Clicks) -> float:
    """Median residual in pixels of points placed by one period in the images of the others."""
    rays = moved(clicks.rays, model)
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


def with_tie_tracks(model: Registered, tie_points: TiePoints) -> Registered:
    """Add the tie points to the points of a model, so that bundle adjustment uses them.

    Points that cannot be placed, outliers and check points are left out.
    """
    clicks = clicks_of(model, tie_points)[0].without(tie_points.names("check"))
    placed = place_clicks(clicks.rays)
    bad = {r.name for r in residuals(model, clicks) if r.outlier}
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


def residuals(model: Registered, clicks: Clicks) -> Iterator[PointResidual]:
    """Measure how well the clicks of each point agree with each other."""
    rays = moved(clicks.rays, model)
    placed = place_clicks(rays)
    by_all = dict(zip(placed.track.tolist(), placed.xyz, strict=True))
    own = [
        place_clicks(rays.where(model.periods[rays.image] == p)) for p in range(model.num_periods)
    ]
    for track, name in enumerate(clicks.names):
        mine = rays.where(rays.track == track)
        labels = tuple(model.labels[p] for p in np.unique(model.periods[mine.image]))
        alone = np.concatenate([p.xyz[p.track == track] for p in own])
        xyz = by_all.get(track, alone.mean(axis=0) if len(alone) else None)
        if xyz is None:
            yield _unplaced(name, len(mine), labels)
        else:
            gaps = np.linalg.norm(alone[:, None] - alone[None], axis=2)
            yield _of_point(model, name, mine, labels, xyz, gaps)


def _unplaced(name: str, clicks: int, labels: tuple[str, ...]) -> PointResidual:
    disagree = clicks > 2
    note = "clicked in only one image, or without parallax"
    if not clicks:
        note = "not registered"
    elif disagree:
        note = "its clicks do not meet in one point"
    return PointResidual(
        name, clicks, labels, click_consistency=None, between_periods=None, ground_pixel=None,
        place=None, outlier=disagree, note=note,
    )  # fmt: skip


def _of_point(
    model: Registered, name: str, rays: TrackRays, labels: tuple[str, ...], xyz: Array,
    gaps: Array,
) -> PointResidual:  # fmt: skip
    residual, _, depth = project(rays, np.tile(xyz, (len(rays), 1)))
    error = np.nan_to_num(np.linalg.norm(residual, axis=1), nan=np.inf)
    worst = int(np.argmax(error))
    outlier = bool(error[worst] > OUTLIER_PIXELS)
    note = f"{error[worst]:.0f} px off in {model.names[rays.image[worst]]}" if outlier else ""
    return PointResidual(
        name,
        len(rays),
        labels,
        click_consistency=float(np.sqrt(np.mean(error**2))),
        between_periods=float(gaps.max()) if len(gaps) > 1 else None,
        ground_pixel=float(np.median(np.abs(depth) / rays.focal.mean(axis=1))),
        place=_place(xyz),
        outlier=outlier,
        note=note,
    )


def with_errors(
    found: Iterator[PointResidual],
    tie_points: TiePoints,
    known: Mapping[str, Array],
    used: set[str],
    convert: Callable[[Array], Array],
    unit: float = 1.0,
) -> Iterator[PointResidual]:
    """Residuals with roles, and with the errors of surveyed points.

    Args:
        found: From `residuals`.
        tie_points: The points.
        known: Surveyed coordinates in the frame of the model.
        used: Names of the control that the model was moved to.
        convert: Coordinates of the model to those of the output. [N, 3] -> [N, 3]
        unit: Metres in a unit of the output.
    """
    roles = {p.name: p.role for p in tie_points.points}
    for one in found:
        role = replace(one, role=roles[one.name], used=one.name in used)
        if one.name in known:
            surveyed = convert(known[one.name][None])[0]
            role = replace(role, surveyed=_place(surveyed))
            if one.place is not None:
                error = unit * (convert(np.array([one.place]))[0] - surveyed)
                role = replace(role, error=_place(error))
        yield role


def _place(xyz: Array) -> Place:
    x, y, z = xyz.tolist()
    return x, y, z
