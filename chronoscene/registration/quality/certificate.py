"""Measured quality of a registration: every figure, or the reason why it cannot be computed.

`certify` measures; `chronoscene.registration.quality.verdict` judges.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from chronoscene.arrays import Array, Mask
from chronoscene.registration.features import METHOD
from chronoscene.registration.quality.disagreement import Disagreement, disagreement
from chronoscene.registration.quality.gps_fit import PeriodGpsFit, displaced_parts, fit_gps
from chronoscene.registration.quality.localisation import Localisation, localise
from chronoscene.registration.quality.misalignment import (
    MAX_SEEN,
    Interval,
    Misalignment,
    Motion,
    Transfers,
    measure,
    transfer_errors,
    transfers,
)
from chronoscene.registration.quality.overlap import TieSpread, ground_plan, tie_spread
from chronoscene.registration.quality.rays import (
    MAX_OBSERVATIONS,
    Evidence,
    PlacedPoints,
    TrackRays,
    gather,
    project,
    sampson_distance,
)
from chronoscene.registration.quality.surface_distance import SurfaceDistance, surface_distance
from chronoscene.registration.result import Registered, Resection
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.tracks import track_owners

BADLY_PLACED = 4.0  # Pixels; transfers whose point is less certain than this are ignored
ONE_LENS = 0.05  # Focal lengths that differ by a larger share are taken for those of two lenses
AGREES = 3.0  # Pixels within which a held-out observation agrees with the registration


@dataclass(frozen=True, slots=True, eq=False)
class PeriodFigures:
    """Figures of one period."""

    period: int
    label: str
    registered: int
    photos: int
    """Registered or not."""
    reasons: Mapping[str, int]
    """Number of missing photos by reason."""
    error: float | None
    """Median reprojection error of its observations in the model, pixels."""
    observations: int
    gps: PeriodGpsFit | str
    in_three: float | None = None
    """Share of the points that its images see that three images or more see, of whatever date."""
    loose: tuple[str, ...] = ()
    """Images in parts of the model that most matches with the rest contradict, sorted."""
    elsewhere: tuple[str, ...] = ()
    """Images in parts of the model that GPS places elsewhere (`displaced_parts`), sorted."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Cross-period residuals of tracks that took no part in the estimation."""

    tracks: int
    observations: int
    median: float
    """Pixels."""
    p90: float
    noise: float
    """Median in units of what the placing of the point leaves open: pixels of one observation. Of
    those that agree, if any do."""
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
    disagreement: Disagreement = field(default_factory=Disagreement)
    """Order in the other observations."""


@dataclass(frozen=True, slots=True, eq=False)
class PairFigures:
    """Figures of two periods."""

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
    surfaces: SurfaceDistance | str
    by_ties_and_surfaces: tuple[Interval, Interval] | None = None
    """Rotation and displacement by `by_all` and the surfaces together."""
    independent: tuple[Interval, Interval] | None = None
    """By held-out tracks and the surfaces together."""
    by_surfaces: tuple[Interval, Interval] | None = None
    """By the surfaces alone."""
    focal_gap: float | None = None
    """Percent by which their focal lengths differ, if photos of one size have one lens."""


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """All measurements of a registration."""

    route: str
    unit: str
    """``metre``, or ``unknown``: then distances mean something as shares of the extent only."""
    extent: float
    """World units, see `scene_extent`."""
    focal: float
    """Median focal length, pixels."""
    labels: tuple[str, ...]
    periods: tuple[PeriodFigures, ...]
    pairs: tuple[PairFigures, ...]
    """All pairs of periods, earlier first."""
    evidence: Evidence
    """Observations on which the figures are measured."""
    facing: bool = False
    """True if the extent is a depth: cameras look one way from nearly one place."""
    features: str = METHOD
    """Name of the features and matches that it was made with."""
    resection: Resection | None = None
    """Precision of poses that surveyed points fix."""


def certify(model: Registered) -> Certificate:
    """Measure how well the periods of a registration fit each other.

    Everything is deterministic: equal models give equal certificates.
    """
    extent = scene_extent(model)
    evidence = gather(model)
    cells = ground_plan(model.points)
    focals = [np.sqrt(c.K[0, 0] * c.K[1, 1]) for c in model.cameras]
    elsewhere = np.zeros(len(model.names), bool)
    if model.georeference is not None:
        elsewhere = displaced_parts(camera_centre(model.cam_from_world), model.gps_enu)
    return Certificate(
        route=model.route,
        features=model.features,
        resection=model.resection,
        unit=model.unit,
        extent=extent,
        facing=_span(model) < extent,
        focal=float(np.median(focals)) if focals else float("nan"),
        labels=tuple(model.labels),
        periods=tuple(_period(model, evidence, p, elsewhere) for p in range(model.num_periods)),
        pairs=tuple(
            _pair(model, evidence, (a, b), tie_spread(model, evidence.seen, a, b, cells))
            for a, b in combinations(range(model.num_periods), 2)
        ),
        evidence=evidence,
    )


def scene_extent(model: Registered) -> float:
    """Diagonal of the box around the cameras; at least the median depth of what they see.

    It is also at least a tenth of the diagonal of the points.

    Cameras that look one way from nearly one place move what they see by that share of its depth,
    in the images and along the view, however close to each other they are.
    """
    size = 0.0
    if len(model.points):
        low, high = np.percentile(model.points, [5, 95], axis=0)
        size = 0.1 * float(np.linalg.norm(high - low))
    rows = slice(None, None, len(model.track_image) // MAX_OBSERVATIONS + 1)
    along = model.cam_from_world[model.track_image[rows], 2]
    points = model.points[track_owners(model.track_start)[rows]]
    if len(points):
        depth = (along[:, :3] * points).sum(axis=1) + along[:, 3]
        size = max(size, float(np.median(depth)))
    return max(size, _span(model))


def _span(model: Registered) -> float:
    """Diagonal of the box around the cameras."""
    if not len(model.names):
        return 0.0
    return float(np.linalg.norm(np.ptp(camera_centre(model.cam_from_world), axis=0)))


def _period(model: Registered, evidence: Evidence, period: int, elsewhere: Mask) -> PeriodFigures:
    mine = model.periods == period
    missing = [n for n, p in model.unregistered_periods.items() if p == period]
    reasons = Counter(model.unregistered.get(name, "unknown") for name in missing)
    rays = evidence.observed[period]
    error = np.linalg.norm(project(rays, model.points[rays.track])[0], axis=1)
    error = error[np.isfinite(error)]
    gps: PeriodGpsFit | str = "the frame is not georeferenced"
    if model.georeference is not None:
        gps = fit_gps(camera_centre(model.cam_from_world[mine]), model.gps_enu[mine])
    return PeriodFigures(
        period=period,
        label=model.labels[period],
        registered=int(mine.sum()),
        photos=int(mine.sum()) + len(missing),
        reasons=reasons,
        error=float(np.median(error)) if len(error) else None,
        observations=len(rays),
        gps=gps,
        in_three=_in_three(model, evidence.seen[:, period]),
        loose=tuple(n for n, i in zip(model.names, mine, strict=True) if i and n in model.loose),
        elsewhere=tuple(model.names[i] for i in np.flatnonzero(mine & elsewhere)),
    )


def _in_three(model: Registered, seen: Mask) -> float | None:
    """Share of some points that three images or more see."""
    images = np.diff(model.track_start)[seen]
    return float((images >= 3).mean()) if len(images) else None


def _pair(
    model: Registered, evidence: Evidence, periods: tuple[int, int], spread: TieSpread
) -> PairFigures:
    a, b = periods
    centres = camera_centre(model.cam_from_world[np.isin(model.periods, (a, b))])
    own = evidence.held_out_placed
    moved, placed_a, placed_b = transfers(evidence.held_out, model.periods, a, b, (own[a], own[b]))
    good = transfer_errors(moved)[1] < BADLY_PLACED if len(moved) else np.zeros(0, bool)
    nothing = "no held-out track is placed by one period and seen by the other"
    figures: HeldOut | str = nothing
    misalignment: Misalignment | str = nothing
    if good.any():
        figures = _held_out(moved, good, (placed_a, placed_b), _epipolar(model, evidence, periods))
        measured = measure(moved, placed_a, placed_b, centres)
        misalignment = measured or "held-out tracks are too few, or too close together"
    by_all = measure(*_all_transfers(model, evidence, a, b), centres)
    of_a, of_b = (evidence.ties.where(model.periods[evidence.ties.image] == p) for p in periods)
    sigma = by_all.shift.high / 1.96 if by_all is not None else 0.0
    middle = np.median(camera_centre(model.cam_from_world), axis=0)
    surfaces = surface_distance(
        evidence.clouds[a],
        evidence.clouds[b],
        middle,
        sigma,
        _motionless(model, evidence, a, centres) if by_all is None else by_all.motion,
    )
    by_surfaces = None
    if not isinstance(surfaces, str) and surfaces.motion is not None:
        by_surfaces = surfaces.motion.intervals()
    return PairFigures(
        by_ties_and_surfaces=_with_surfaces(by_all, surfaces),
        independent=_with_surfaces(misalignment, surfaces),
        by_surfaces=by_surfaces,
        a=a,
        b=b,
        ties=spread,
        held_out=figures,
        misalignment=misalignment,
        by_all=by_all
        or "tracks seen by two images of one period are too few, or too close together",
        localised_b=localise(of_b, evidence.ties_placed[a]),
        localised_a=localise(of_a, evidence.ties_placed[b]),
        surfaces=surfaces,
        focal_gap=_focal_gap(model, a, b),
    )


def _focal_gap(model: Registered, a: int, b: int) -> float | None:
    """Largest difference of the focal lengths of two periods over sizes of photos, percent."""
    focals: dict[tuple[int, int], tuple[list[float], list[float]]] = {}
    for camera, period in zip(model.cameras, model.periods, strict=True):
        if period in (a, b):
            size = focals.setdefault((camera.width, camera.height), ([], []))
            size[int(period == b)].append(camera.K[0, 0])
    gaps = [abs(np.log(np.median(x) / np.median(y))) for x, y in focals.values() if x and y]
    gaps = [gap for gap in gaps if gap < ONE_LENS]
    return 100 * float(max(gaps)) if gaps else None


def _motionless(
    model: Registered, evidence: Evidence, period: int, centres: Array
) -> Motion | None:
    """Points of a period and its cameras, by which surfaces measure a motion where ties do not."""
    rays = evidence.observed[period]
    rays = rays.where(np.arange(0, len(rays), len(rays) // MAX_SEEN + 1))
    if not len(rays):
        return None
    return Motion.none(model.points[rays.track], camera_centre(rays.pose), centres)


def _with_surfaces(
    found: Misalignment | str | None, surfaces: SurfaceDistance | str
) -> tuple[Interval, Interval] | None:
    """Rotation and displacement by tracks and surfaces together."""
    if not isinstance(found, Misalignment) or isinstance(surfaces, str) or surfaces.motion is None:
        return None
    both = surfaces.motion.joined(found.motion)
    return None if both is None else both.intervals()


def _all_transfers(
    model: Registered, evidence: Evidence, a: int, b: int
) -> tuple[Transfers, PlacedPoints, PlacedPoints]:
    """Transfers of held-out tracks and of a sample of the ties, with distinct track numbers."""
    held_out, ties = evidence.held_out, evidence.ties
    ties = ties.where(np.isin(model.periods[ties.image], (a, b)))
    tracks, number = np.unique(ties.track, return_inverse=True)
    step = len(ties) // MAX_OBSERVATIONS + 1
    ties = ties.where(number % step == 0)
    sampled = np.zeros(len(model.points), bool)
    sampled[tracks[::step]] = True
    shift = held_out.track.max(initial=-1) + 1
    rays = TrackRays.join(held_out, replace(ties, track=ties.track + shift))

    def placed(p: int) -> PlacedPoints:
        tied = evidence.ties_placed[p].of(sampled)
        return PlacedPoints.join(
            evidence.held_out_placed[p], replace(tied, track=tied.track + shift)
        )

    return transfers(rays, model.periods, a, b, (placed(a), placed(b)))


def _held_out(
    moved: Transfers, good: Mask, placed: tuple[PlacedPoints, PlacedPoints], epipolar: Array
) -> HeldOut:
    placed_a, placed_b = placed
    error, expected, distance = (x[good] for x in transfer_errors(moved))
    found, slot = placed_b.find(placed_a.track)
    gaps = np.linalg.norm(placed_a.xyz[found] - placed_b.xyz[slot], axis=1)
    agrees = error < AGREES * np.maximum(1.0, expected)
    noise = float(np.median((error / expected)[agrees if agrees.any() else ...]))
    return HeldOut(
        tracks=len(np.unique(moved.rays.track[good])),
        observations=int(good.sum()),
        median=float(np.median(error)),
        p90=float(np.percentile(error, 90)),
        noise=noise,
        agreeing=float(np.mean(agrees)),
        distance=float(np.median(distance)),
        gap=float(np.median(gaps)) if len(gaps) else None,
        gap_tracks=len(gaps),
        epipolar=float(np.median(epipolar)) if len(epipolar) else None,
        matches=len(epipolar),
        disagreement=disagreement(moved.where(good), ~agrees, placed, noise),
    )


def _epipolar(model: Registered, evidence: Evidence, periods: tuple[int, int]) -> Array:
    """Epipolar distances of all held-out matches between two periods, pixels."""
    errors, rays = [], evidence.sightings
    for a, b in evidence.matches:
        between = model.periods[rays.image[[a[0], b[0]]]].tolist()
        if set(between) == set(periods):
            first, second = rays.where(a), rays.where(b)
            relative = second.pose[0] @ np.linalg.inv(first.pose[0])
            focals = first.focal, second.focal
            errors.append(sampson_distance(relative, first.uv, second.uv, *focals))
    found = np.concatenate([np.zeros(0), *errors])
    return np.asarray(found[np.isfinite(found)])
