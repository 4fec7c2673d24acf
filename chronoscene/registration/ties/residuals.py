"""Clicks as observations: where they place tie points, and how well each point fits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import SceneError
from chronoscene.registration.quality.rays import PlacedPoints, TrackRays, place, project, rays_at
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_points import TiePoints, match_images

OUTLIER_PIXELS = 12.0
"""A click with a smaller error is no outlier: people click to within a few pixels."""


@dataclass(frozen=True, slots=True)
class PointResidual:
    """Residuals of one tie point."""

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
    """Problem of the point, or ``""``."""


@dataclass(frozen=True, slots=True, eq=False)
class Clicks:
    """Clicks in registered images (C clicks)."""

    names: tuple[str, ...]
    """Points."""
    rays: TrackRays
    """A track is an index into ``names``."""
    xy: Array


def clicks_of(model: Registered, tie_points: TiePoints) -> tuple[Clicks, list[str]]:
    images = match_images(tie_points, model.names)
    missing = sorted(name for name, i in images.items() if i is None)
    remarks = [f"{name}: has clicks, but is not registered" for name in missing]
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
                    todo="correct the line; if it was clicked in photos of another size, give the "
                    "ratio (--tie-scale)",
                )
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

    Points that cannot be placed, and outliers, are left out.
    """
    clicks, _ = clicks_of(model, tie_points)
    rays = moved(clicks.rays, model)
    placed = place_clicks(rays)
    bad = {r.name for r in residuals(model, clicks, {}) if r.outlier}
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


def residuals(
    model: Registered, clicks: Clicks, control: dict[str, Array]
) -> Iterator[PointResidual]:
    rays = moved(clicks.rays, model)
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
            disagree = len(mine) > 2
            note = "not registered"
            if len(mine):
                note = (
                    "its clicks do not meet in one point"
                    if disagree
                    else "clicked in only one image, or without parallax"
                )
            yield PointResidual(
                name, len(mine), labels, pixels=None, distance=None, outlier=disagree, note=note
            )
            continue
        residual = project(mine, np.tile(xyz, (len(mine), 1)))[0]
        error = np.nan_to_num(np.linalg.norm(residual, axis=1), nan=np.inf)
        gaps = np.linalg.norm(alone - control[name], axis=1) if name in control else None
        if gaps is None and len(alone) > 1:
            gaps = np.linalg.norm(alone[:, None] - alone[None], axis=2).ravel()
        yield _of_point(model, name, mine, labels, error, gaps)


def _of_point(
    model: Registered, name: str, rays: TrackRays, labels: tuple[str, ...], error: Array,
    gaps: Array | None,
) -> PointResidual:  # fmt: skip
    worst = int(np.argmax(error))
    outlier = bool(error[worst] > OUTLIER_PIXELS)
    note = ""
    if outlier:
        note = f"{error[worst]:.0f} px off in {model.names[rays.image[worst]]}"
    return PointResidual(
        name,
        len(rays),
        labels,
        pixels=float(np.sqrt(np.mean(error**2))),
        distance=float(gaps.max()) if gaps is not None and len(gaps) else None,
        outlier=outlier,
        note=note,
    )
