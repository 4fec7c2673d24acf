"""Spots seen on two dates, and pairs of images, for the page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.registration.quality.certificate import PairFigures
from chronoscene.registration.quality.rays import Evidence, project
from chronoscene.registration.result import Registered
from chronoscene.scene.cameras import project_points
from chronoscene.scene.geometry import camera_centre

MARGIN = 0.06  # Share of the image size; spots nearer to the edge are not shown
MIN_MATCHES = 5  # Matches of a pair of images that is drawn


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """A place, and the best image of it of each of two periods."""

    xyz: Array
    normal: Array
    """Normal of the surface, towards the cameras."""
    a: int
    """Image of the earlier period."""
    b: int
    xy_a: Array
    """Projection of the spot, pixels."""
    xy_b: Array
    more_a: tuple[int, Array] | None
    """A second image of the same period and the spot in it: a click needs two of each."""
    more_b: tuple[int, Array] | None
    tied: bool
    """True if the spot is a tie point, False if there is none near it."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnPair:
    """Two images of different periods with their held-out matches."""

    a: int
    b: int
    xy_a: Array
    xy_b: Array
    error: Array
    """Pixels: the point of one period in the image of the other, or the epipolar distance."""

    @property
    def median(self) -> float:
        return float(np.median(self.error))


def spots(
    model: Registered, seen: Mask, pair: PairFigures, count: int, *, gaps: bool, twice: bool = False
) -> list[Spot]:
    """Places that two periods see, spread over the scene.

    Args:
        model: The registration.
        seen: True if an image of the period sees the point. [P, T]
        pair: Figures of the two periods.
        count: Maximum number of places.
        gaps: True for places without tie points, False for tie points.
        twice: True if two images of each period must show a place.
    """
    if gaps:
        places = pair.ties.gaps
    else:
        places = model.points[seen[:, pair.a] & seen[:, pair.b]]
        low, high = np.percentile(places, [2, 98], axis=0) if len(places) else (0.0, 0.0)
        places = places[((places >= low) & (places <= high)).all(axis=1)]
    mine = model.points[seen[:, pair.a] | seen[:, pair.b]]
    found: list[Spot] = []
    for xyz in places[_spread(places, 3 * count)]:
        spot = _spot(model, pair, xyz, mine, tied=not gaps)
        if spot is not None and not (twice and (spot.more_a is None or spot.more_b is None)):
            found.append(spot)
        if len(found) == count:
            break
    return found


def _spread(points: Array, count: int) -> list[int]:
    """Choose points that lie far from each other, by farthest point sampling; their indices."""
    if not len(points):
        return []
    chosen = [int(np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def _spot(
    model: Registered, pair: PairFigures, xyz: Array, points: Array, *, tied: bool
) -> Spot | None:
    views = {p: _views(model, p, xyz) for p in (pair.a, pair.b)}
    if not all(len(v[0]) for v in views.values()):
        return None
    (in_a, xy_a, to_a), (in_b, xy_b, to_b) = views[pair.a], views[pair.b]
    # Similar direction and scale: cosine minus the difference of the logarithms of distances.
    far_a, far_b = np.linalg.norm(to_a, axis=1), np.linalg.norm(to_b, axis=1)
    cosine = (to_a / far_a[:, None]) @ (to_b / far_b[:, None]).T
    alike = cosine - 0.3 * np.abs(np.log(far_a)[:, None] - np.log(far_b)[None])
    i, j = np.unravel_index(int(np.argmax(alike)), alike.shape)
    towards = to_a[i] / far_a[i] + to_b[j] / far_b[j]
    return Spot(
        xyz=xyz,
        normal=_normal(points, xyz, towards),
        a=int(in_a[i]),
        b=int(in_b[j]),
        xy_a=xy_a[i],
        xy_b=xy_b[j],
        more_a=_another(in_a, xy_a, to_a, int(i)),
        more_b=_another(in_b, xy_b, to_b, int(j)),
        tied=tied,
    )


def _views(model: Registered, period: int, xyz: Array) -> tuple[Ints, Array, Array]:
    """Images of a period that see a place well inside, its pixels, and vectors to the cameras."""
    images, pixels = [], []
    for i in np.flatnonzero(model.periods == period):
        camera, pose = model.cameras[i], model.cam_from_world[i]
        local = pose[:3, :3] @ xyz + pose[:3, 3]
        if local[2] <= 0:
            continue
        xy = project_points(camera, local[None])[0]
        size = np.array([camera.width, camera.height])
        if np.isfinite(xy).all() and ((xy > MARGIN * size) & (xy < (1 - MARGIN) * size)).all():
            images.append(int(i))
            pixels.append(xy)
    found = np.array(images, np.int64)
    towards = camera_centre(model.cam_from_world[found]) - xyz
    return found, np.array(pixels).reshape(-1, 2), towards.reshape(-1, 3)


def _another(images: Ints, xy: Array, to: Array, first: int) -> tuple[int, Array] | None:
    """A second image from a direction that differs by about 15 degrees."""
    if len(images) < 2:
        return None
    unit = to / np.linalg.norm(to, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(unit @ unit[first], -1, 1)))
    angle[first] = np.inf
    k = int(np.argmin(np.abs(angle - 15)))
    return int(images[k]), xy[k]


def _normal(points: Array, xyz: Array, towards: Array) -> Array:
    """Normal of the surface at a place by its 24 nearest points, towards the cameras."""
    near = points[np.argsort(np.linalg.norm(points - xyz, axis=1))[:24]]
    towards = towards / np.linalg.norm(towards)
    if len(near) < 6:
        return np.asarray(towards)
    values, vectors = np.linalg.eigh(np.cov(near.T))
    normal = vectors[:, 0] * np.sign(vectors[:, 0] @ towards or 1.0)
    # A bush is not planar, and a plane seen edge-on shows nothing.
    flat = values[0] < 0.05 * values[1] and normal @ towards > 0.4
    return np.asarray(normal if flat else towards)


def drawn_pairs(model: Registered, evidence: Evidence) -> list[DrawnPair]:
    """All pairs of images with enough held-out matches, the best first."""
    pairs, tracks = [], model.held_out_tracks
    for a, b in evidence.matches:
        if len(a) >= MIN_MATCHES:
            error = _match_errors(model, evidence, a, b)
            good = np.isfinite(error)
            if good.sum() >= MIN_MATCHES:
                images = int(tracks.image[a[0]]), int(tracks.image[b[0]])
                xy = tracks.xy[a[good]], tracks.xy[b[good]]
                pairs.append(DrawnPair(*images, *xy, error[good]))
    return sorted(pairs, key=lambda p: p.median)


def _match_errors(model: Registered, evidence: Evidence, a: Ints, b: Ints) -> Array:
    """Distance of each match to where the other period puts its point; NaN where none does."""
    rays, errors = evidence.sightings, np.full((2, len(a)), np.nan)
    for k, (source, target) in enumerate(((a, b), (b, a))):
        points = evidence.held_out_placed[int(model.periods[rays.image[source[0]]])]
        found, slot = points.find(rays.track[target])
        residual, *_ = project(rays.where(target[found]), points.xyz[slot])
        errors[k, found] = np.linalg.norm(residual, axis=1)
    return np.asarray(np.where(np.isfinite(errors[0]), errors[0], errors[1]))
