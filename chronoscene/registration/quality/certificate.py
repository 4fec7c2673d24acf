"""How good a registration is: every figure with its unit and number, or why there is none.

`certify` measures; `chronoscene.registration.quality.verdict` judges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from chronoscene.registration.quality.gps_fit import GpsFit, fit_gps
from chronoscene.registration.quality.localisation import Localisation, localise
from chronoscene.registration.quality.misalignment import (
    FEWEST_TRACKS,
    Misalignment,
    Transfers,
    measure,
    sampson_errors,
    transfer_errors,
    transfers,
)
from chronoscene.registration.quality.overlap import (
    TieSpread,
    ground_plan,
    seen_by_period,
    tie_spread,
)
from chronoscene.registration.quality.rays import (
    Array,
    Ints,
    Mask,
    Placed,
    Rays,
    held_out_rays,
    model_rays,
    place,
    project,
    unproject,
)
from chronoscene.registration.quality.surface_distance import CloudDistance, cloud_distance
from chronoscene.registration.result import Registered
from chronoscene.scene.geometry import camera_centre

MOST_OBSERVATIONS = 200_000
"""Observations by which the cloud of a period is placed, and those of tie points by which a pair is
measured: a sample of the points where there are more."""

BADLY_PLACED = 4.0
"""Transfers whose point is less certain than this many pixels tell nothing."""

AGREES = 3.0
"""Pixels within which a held-out observation agrees with the registration."""


@dataclass(frozen=True, slots=True, eq=False)
class PeriodFigures:
    """One period."""

    period: int
    label: str
    registered: int
    photos: int
    """Registered or not."""
    reasons: Mapping[str, int]
    """Why photos are missing, and how many for each reason."""
    error: float | None
    """Median reprojection error of its observations in the model, pixels."""
    observations: int
    gps: GpsFit | str


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Cross-period residuals of tracks that took no part in the estimation."""

    tracks: int
    observations: int
    median: float
    """Pixels."""
    p90: float
    noise: float
    """Median in units of what the placing of the point leaves open: pixels of one observation."""
    agreeing: float
    """Share within `AGREES` pixels, or three times what the placing of the point leaves open."""
    distance: float
    """Median, in world units, at the depth of the points."""
    gap: float | None
    """Median distance between the points as both periods place them, world units."""
    gap_tracks: int
    epipolar: float | None
    """Median distance to the epipolar lines, pixels."""
    matches: int


@dataclass(frozen=True, slots=True, eq=False)
class PairFigures:
    """Two periods."""

    a: int
    b: int
    ties: TieSpread
    held_out: HeldOut | str
    misalignment: Misalignment | str
    """By held-out tracks alone: independent of the estimation, but less precise."""
    by_all: Misalignment | str
    """By held-out tracks and tie points together: how precisely the ties fix the alignment."""
    localised_b: Localisation | str
    """Images of b by the points of a."""
    localised_a: Localisation | str
    clouds: CloudDistance | str


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """All that was measured."""

    route: str
    unit: str
    """``metre``, or ``unknown``: then distances mean something as shares of the extent only."""
    extent: float
    """World units: diagonal of the box around all cameras; at least a tenth of the points'."""
    focal: float
    """Median focal length, pixels."""
    labels: tuple[str, ...]
    periods: tuple[PeriodFigures, ...]
    pairs: tuple[PairFigures, ...]
    """All pairs of periods, earlier first."""


def certify(model: Registered) -> Certificate:
    """Measure how well the periods of a registration fit each other.

    Everything is deterministic: equal models give equal certificates.
    """
    extent = scene_extent(model)
    seen = seen_by_period(model)
    clouds = [_cloud(model, seen, p) for p in range(model.num_periods)]
    cells = ground_plan(model.points)
    shared = np.flatnonzero(seen.sum(axis=1) > 1)
    sample = np.zeros(len(seen), bool)
    lengths = np.diff(model.track_start)
    most = MOST_OBSERVATIONS * max(1, model.num_periods - 1)
    sample[shared[:: int(lengths[shared].sum()) // most + 1]] = True
    held_out, ties = held_out_rays(model), model_rays(model, sample)
    focals = [np.sqrt(c.K[0, 0] * c.K[1, 1]) for c in model.cameras]
    return Certificate(
        route=model.route,
        unit=model.unit,
        extent=extent,
        focal=float(np.median(focals)) if focals else float("nan"),
        labels=tuple(model.labels),
        periods=tuple(_period(model, p) for p in range(model.num_periods)),
        pairs=tuple(
            _pair(model, (a, b), tie_spread(model, seen, a, b, cells), clouds, held_out, ties)
            for a, b in combinations(range(model.num_periods), 2)
        ),
    )


def scene_extent(model: Registered) -> float:
    """Diagonal of the box around the cameras; a tenth of that of the points if that is more."""
    size = 0.0
    if len(model.points):
        low, high = np.percentile(model.points, [5, 95], axis=0)
        size = 0.1 * float(np.linalg.norm(high - low))
    if len(model.names):
        centres = camera_centre(model.cam_from_world)
        size = max(size, float(np.linalg.norm(np.ptp(centres, axis=0))))
    return size


def _cloud(model: Registered, seen: Mask, period: int) -> Placed:
    """Points of a period, placed by its images alone: a shared point would fit by construction."""
    points = np.flatnonzero(seen[:, period])
    chosen = np.zeros(len(seen), bool)
    observations = int(np.diff(model.track_start)[points].sum())
    chosen[points[:: observations // MOST_OBSERVATIONS + 1]] = True
    rays = model_rays(model, chosen)
    return place(rays.where(model.periods[rays.image] == period))


def _period(model: Registered, period: int) -> PeriodFigures:
    mine = model.periods == period
    missing = [n for n, p in model.unregistered_periods.items() if p == period]
    reasons: dict[str, int] = {}
    for name in missing:
        reason = model.unregistered.get(name, "unknown")
        reasons[reason] = reasons.get(reason, 0) + 1
    rows = np.flatnonzero(mine[model.track_image])
    rows = rows[:: len(rows) // 200_000 + 1]
    point = np.repeat(np.arange(len(model.points)), np.diff(model.track_start))[rows]
    uv, focal = unproject(model.cameras, model.track_image[rows], model.track_xy[rows])
    pose = model.cam_from_world[model.track_image[rows]]
    rays = Rays(point, model.track_image[rows], pose, uv, focal)
    error = np.linalg.norm(project(rays, model.points[point])[0], axis=1)
    error = error[np.isfinite(error)]
    gps: GpsFit | str = "the frame is not georeferenced"
    if model.georeference is not None:
        gps = fit_gps(camera_centre(model.cam_from_world[mine]), model.gps_enu[mine])
    return PeriodFigures(
        period=period,
        label=model.labels[period],
        registered=int(mine.sum()),
        photos=int(mine.sum()) + len(missing),
        reasons=reasons,
        error=float(np.median(error)) if len(error) else None,
        observations=len(rows),
        gps=gps,
    )


def _pair(
    model: Registered,
    periods: tuple[int, int],
    spread: TieSpread,
    clouds: list[Placed],
    held_out: Rays,
    ties: Rays,
) -> PairFigures:
    a, b = periods
    centres = camera_centre(model.cam_from_world[np.isin(model.periods, (a, b))])
    moved, placed_a, placed_b = transfers(held_out, model.periods, a, b)
    good = transfer_errors(moved)[1] < BADLY_PLACED if len(moved) else np.zeros(0, bool)
    nothing = "no held-out track is placed by one period and seen by the other"
    figures: HeldOut | str = nothing
    misalignment: Misalignment | str = nothing
    if good.any():
        figures = _held_out(model, moved, good, placed_a, placed_b, (a, b))
        measured = measure(moved, placed_a, placed_b, centres)
        misalignment = measured or (
            f"{figures.tracks} held-out tracks: fewer than {FEWEST_TRACKS}, or all in one spot"
        )
    by_all = measure(*transfers(_joined(held_out, ties, a, b, model), model.periods, a, b), centres)
    rays_a = ties.where(model.periods[ties.image] == a)
    rays_b = ties.where(model.periods[ties.image] == b)
    sigma = by_all.shift.high / 1.96 if by_all is not None else 0.0
    middle = np.median(camera_centre(model.cam_from_world), axis=0)
    return PairFigures(
        a=a,
        b=b,
        ties=spread,
        held_out=figures,
        misalignment=misalignment,
        by_all=by_all or "too few tracks are seen by two images of one period, or all in one spot",
        localised_b=localise(rays_b, place(rays_a)),
        localised_a=localise(rays_a, place(rays_b)),
        clouds=cloud_distance(clouds[a], clouds[b], middle, sigma),
    )


def _joined(held_out: Rays, ties: Rays, a: int, b: int, model: Registered) -> Rays:
    """Held-out tracks and a sample of the tie points of two periods, under numbers of their own."""
    ties = ties.where(np.isin(model.periods[ties.image], (a, b)))
    _, number = np.unique(ties.track, return_inverse=True)
    ties = ties.where(number % (len(ties) // MOST_OBSERVATIONS + 1) == 0)
    parts = held_out, replace(ties, track=ties.track + held_out.track.max(initial=-1) + 1)
    names = ("track", "image", "pose", "uv", "focal")
    return Rays(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _held_out(
    model: Registered,
    moved: Transfers,
    good: Mask,
    placed_a: Placed,
    placed_b: Placed,
    periods: tuple[int, int],
) -> HeldOut:
    error, expected, distance = (x[good] for x in transfer_errors(moved))
    found, slot = placed_b.find(placed_a.track)
    gaps = np.linalg.norm(placed_a.xyz[found] - placed_b.xyz[slot], axis=1)
    epipolar = _epipolar(model, periods)
    return HeldOut(
        tracks=len(np.unique(moved.rays.track[good])),
        observations=int(good.sum()),
        median=float(np.median(error)),
        p90=float(np.percentile(error, 90)),
        noise=float(np.median(error / expected)),
        agreeing=float(np.mean(error < AGREES * np.maximum(1.0, expected))),
        distance=float(np.median(distance)),
        gap=float(np.median(gaps)) if len(gaps) else None,
        gap_tracks=len(gaps),
        epipolar=float(np.median(epipolar)) if len(epipolar) else None,
        matches=len(epipolar),
    )


def _epipolar(model: Registered, periods: tuple[int, int]) -> Array:
    """Epipolar distances of all held-out matches between two periods, pixels."""
    chosen = [
        m
        for m in model.held_out
        if {int(model.periods[m.image_a]), int(model.periods[m.image_b])} == set(periods)
    ]
    if not chosen:
        return np.zeros(0)
    counts = [len(m.xy_a) for m in chosen]
    first = _rays(model, np.repeat([m.image_a for m in chosen], counts), [m.xy_a for m in chosen])
    second = _rays(model, np.repeat([m.image_b for m in chosen], counts), [m.xy_b for m in chosen])
    ends = np.cumsum(counts)
    errors = [
        sampson_errors(first.pose[i], second.pose[i], first.where(rows), second.where(rows))
        for i, j in zip(ends - counts, ends, strict=True)
        if len(rows := np.arange(i, j))
    ]
    found = np.concatenate([np.zeros(0), *errors])
    return np.asarray(found[np.isfinite(found)])


def _rays(model: Registered, image: Ints, xy: list[Array]) -> Rays:
    uv, focal = unproject(model.cameras, image, np.concatenate(xy))
    return Rays(image, image, model.cam_from_world[image], uv, focal)
