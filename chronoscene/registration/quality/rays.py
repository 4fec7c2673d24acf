"""Tracks as bundles of rays: points placed by some of their images, and seen by others.

`gather` computes once what the figures of a certificate rest on. Residuals are taken on the plane
at depth 1, without distortion, and multiplied by the focal lengths: they are pixels for a pinhole
camera, and pixels at the image centre for any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.registration.result import HeldOutTracks, Registered
from chronoscene.scene import Camera
from chronoscene.scene.cameras import unproject_pixels
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.tracks import MIN_PARALLAX, intersect_rays, seen_by_period, track_owners

MAX_OWN_ERROR = 4.0
"""Root mean square, pixels: tracks that do not even fit the images that place them are mismatched
in their own period."""

MAX_OBSERVATIONS = 200_000
"""Observations by which the cloud of a period is placed, those of tie points by which a pair is
measured, and those whose error is taken: a sample where there are more."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackRays:
    """Observations grouped by track, as rays (O observations)."""

    track: Ints
    """Ascending. [O]"""
    image: Ints
    """[O]"""
    pose: Array
    """cam_from_world of the image. [O, 4, 4]"""
    uv: Array
    """Intersection of the ray with the plane at depth 1 of its camera. [O, 2]"""
    focal: Array
    """Pixels. [O, 2]"""

    def __len__(self) -> int:
        return len(self.track)

    def where(self, mask: Mask | Ints) -> TrackRays:
        """Some of the observations, in their order."""
        return TrackRays(*(getattr(self, name)[mask] for name in self.__slots__))

    def finite(self) -> TrackRays:
        """Without the pixels that COLMAP finds no ray for."""
        return self.where(np.flatnonzero(np.isfinite(self.uv).all(axis=1)))

    @classmethod
    def join(cls, *parts: TrackRays) -> TrackRays:
        """Observations of several, one after the other; tracks keep their numbers."""
        names = cls.__slots__
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPoints:
    """Points placed by rays (K points)."""

    track: Ints
    """Ascending, a part of the tracks of the rays. [K]"""
    xyz: Array
    """[K, 3]"""
    covariance: Array
    """For observations with a standard deviation of one pixel. [K, 3, 3]"""
    error: Array
    """Root mean square residual in pixels. [K]"""

    def find(self, track: Ints) -> tuple[Mask, Ints]:
        """Mask of the given tracks that are placed, and the index of each that is."""
        if not len(self.track):
            return np.zeros(len(track), bool), np.zeros(0, np.int64)
        slot = np.searchsorted(self.track, track).clip(max=len(self.track) - 1)
        found = self.track[slot] == track
        return found, slot[found]

    def of(self, tracks: Mask) -> PlacedPoints:
        """The points of some tracks, by a mask over the numbers of all."""
        return self.select(tracks[self.track])

    def select(self, rows: Mask | Ints) -> PlacedPoints:
        """Some of the points."""
        return PlacedPoints(*(getattr(self, name)[rows] for name in self.__slots__))

    @classmethod
    def join(cls, *parts: PlacedPoints) -> PlacedPoints:
        """Points of several, by track."""
        names = cls.__slots__
        every = cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
        return every.select(np.argsort(every.track, kind="stable"))


def rays_at(model: Registered, track: Ints, image: Ints, xy: Array) -> TrackRays:
    """Rays of observations; NaN where COLMAP finds none. [O], [O], [O, 2]"""
    uv, focal = unproject(model.cameras, image, xy)
    return TrackRays(track, image, model.cam_from_world[image], uv, focal)


def model_rays(model: Registered) -> TrackRays:
    """Rays of the points of a model; a track is the index of a point."""
    track = track_owners(model.track_start)
    return rays_at(model, track, model.track_image, model.track_xy).finite()


def held_out_rays(model: Registered) -> TrackRays:
    """Rays of the observations in `Registered.held_out_tracks`; NaN where COLMAP finds none."""
    tracks = model.held_out_tracks
    return rays_at(model, track_owners(tracks.start), tracks.image, tracks.xy)


def cross_matches(tracks: HeldOutTracks, periods: Ints) -> list[tuple[Ints, Ints]]:
    """Held-out tracks as matches between images of different periods, by pair of images.

    Args:
        tracks: Held-out tracks.
        periods: Of the images. [N]

    Returns:
        Rows of the observations by the image of the earlier period, and by the other. [M], [M]
    """
    track, count = track_owners(tracks.start), np.diff(tracks.start)
    # Each observation with every one of its track.
    a = np.repeat(np.arange(len(track)), count[track])
    ends = np.cumsum(count[track])
    b = np.arange(len(a)) + np.repeat(tracks.start[track] - ends + count[track], count[track])
    across = periods[tracks.image[a]] < periods[tracks.image[b]]
    a, b = a[across], b[across]
    order = np.lexsort((tracks.image[b], tracks.image[a]))
    a, b = a[order], b[order]
    first, second = tracks.image[a], tracks.image[b]
    new = np.flatnonzero((np.diff(first, prepend=-1) != 0) | (np.diff(second, prepend=-1) != 0))
    return list(zip(np.split(a, new)[1:], np.split(b, new)[1:], strict=True))


def unproject(cameras: Sequence[Camera], image: Ints, xy: Array) -> tuple[Array, Array]:
    """Depth-1 coordinates and focal lengths of pixels. [O], [O, 2] -> [O, 2], [O, 2]"""
    uv, focal = np.full((len(image), 2), np.nan), np.ones((len(image), 2))
    number: dict[Camera, int] = {}
    of_image = np.array([number.setdefault(c, len(number)) for c in cameras], np.int64)
    kind = of_image[image]
    order = np.argsort(kind, kind="stable")
    ends = np.searchsorted(kind[order], np.arange(len(number) + 1))
    for camera, k in number.items():
        rows = order[ends[k] : ends[k + 1]]
        if len(rows):
            uv[rows] = unproject_pixels(camera, xy[rows])
            focal[rows] = camera.K[[0, 1], [0, 1]]
    return uv, focal


def project(rays: TrackRays, xyz: Array) -> tuple[Array, Array, Array]:
    """Residuals of points at their rays, in pixels.

    Args:
        rays: [O]
        xyz: Where the point of each ray is. [O, 3]

    Returns:
        residual: Projection minus observation; NaN behind the camera. [O, 2]
        jacobian: Its derivative by the point. [O, 2, 3]
        depth: [O]
    """
    rotation = rays.pose[:, :3, :3]
    local = np.einsum("nij,nj->ni", rotation, xyz) + rays.pose[:, :3, 3]
    depth = local[:, 2]
    safe = np.where(depth > 0, depth, np.nan)
    uv = local[:, :2] / safe[:, None]
    across = rotation[:, :2] - uv[:, :, None] * rotation[:, 2:3]
    jacobian = rays.focal[:, :, None] / safe[:, None, None] * across
    return (uv - rays.uv) * rays.focal, jacobian, depth


def sampson_distance(
    b_from_a: Array, uv_a: Array, uv_b: Array, focal_a: Array | float, focal_b: Array | float
) -> Array:
    """First-order distance of correspondences to the epipolar geometry of two cameras, in pixels.

    Args:
        b_from_a: Pose of the second camera in the frame of the first. [4, 4]
        uv_a: At depth 1, without distortion. [M, 2]
        uv_b: [M, 2]
        focal_a: Pixels. [M, 2], or one number for all
        focal_b: As ``focal_a``.

    Returns:
        NaN where the two cameras stand in one place. [M]
    """
    x, y, z = b_from_a[:3, 3]
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ b_from_a[:3, :3]
    one = np.ones((len(uv_a), 1))
    a, b = np.hstack([uv_a, one]), np.hstack([uv_b, one])
    line_b, line_a = a @ essential.T, b @ essential
    # Gradient by pixels: divided by the focal lengths.
    square = ((line_b[:, :2] / focal_b) ** 2).sum(axis=1)
    square += ((line_a[:, :2] / focal_a) ** 2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.abs((b * line_b).sum(axis=1)) / np.sqrt(square))


def place(rays: TrackRays) -> PlacedPoints:
    """Triangulate tracks, except those of one image, without parallax, or with large residuals.

    First the point nearest to all rays, then three Gauss-Newton steps on the residuals in pixels.
    """
    first = np.flatnonzero(np.diff(rays.track, prepend=-1))
    count = np.diff(np.append(first, len(rays)))
    several = np.repeat(count >= 2, count)
    rays, first, count = rays.where(several), first[count >= 2], count[count >= 2]
    if not len(rays):
        return PlacedPoints(
            np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
        )
    first = np.cumsum(count) - count
    local = np.column_stack([rays.uv, np.ones(len(rays))])
    direction = np.einsum("nji,nj->ni", rays.pose[:, :3, :3], local)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    xyz, parallax = intersect_rays(direction, camera_centre(rays.pose), first)
    for _ in range(3):
        residual, jacobian, _ = project(rays, np.repeat(xyz, count, axis=0))
        normal, gradient = _normal_equations(residual, jacobian, first)
        step = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        xyz = xyz - np.where(np.isfinite(step), step, 0.0)
    residual, jacobian, _ = project(rays, np.repeat(xyz, count, axis=0))
    normal, _ = _normal_equations(residual, jacobian, first)
    mean_square = np.add.reduceat((residual**2).sum(axis=1), first) / count
    good = (parallax > MIN_PARALLAX) & (mean_square < MAX_OWN_ERROR**2)
    return PlacedPoints(
        track=rays.track[first][good],
        xyz=xyz[good],
        covariance=np.asarray(np.linalg.inv(normal[good]), np.float64),
        error=np.sqrt(mean_square[good]),
    )


def _normal_equations(residual: Array, jacobian: Array, first: Ints) -> tuple[Array, Array]:
    residual, jacobian = np.nan_to_num(residual), np.nan_to_num(jacobian)
    normal = np.add.reduceat(np.einsum("nki,nkj->nij", jacobian, jacobian), first)
    gradient = np.add.reduceat(np.einsum("nki,nk->ni", jacobian, residual), first)
    size = np.trace(normal, axis1=1, axis2=2)
    return normal + (1e-9 * size + 1e-30)[:, None, None] * np.eye(3), gradient


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Observations of a registration as rays, and the points that each period places alone.

    A point that several periods place together would fit all of them by construction.
    """

    seen: Mask
    """True if an image of the period sees the point. [P, T]"""
    observed: tuple[TrackRays, ...]
    """A sample of the observations of each period, whatever their points. A track is the index of
    a point here, in `ties` and in `clouds`."""
    clouds: tuple[PlacedPoints, ...]
    """A sample of the points of each period, placed by its images."""
    ties: TrackRays
    """A sample of the points that several periods see."""
    ties_placed: tuple[PlacedPoints, ...]
    """The ties that each period places."""
    held_out: TrackRays
    """Tracks that took no part in the estimation."""
    held_out_placed: tuple[PlacedPoints, ...]
    sightings: TrackRays
    """All observations of these, from `held_out_rays`."""
    matches: tuple[tuple[Ints, Ints], ...]
    """Rows of `sightings`, from `cross_matches`."""


def gather(model: Registered) -> Evidence:
    """Unproject the observations in use, and triangulate every point once for each period."""
    periods = range(model.num_periods)
    point, period = track_owners(model.track_start), model.periods[model.track_image]
    seen = seen_by_period(point, period, (len(model.points), model.num_periods))
    length = np.diff(model.track_start)
    in_clouds = np.zeros_like(seen)
    for p in periods:
        in_clouds[_sample(np.flatnonzero(seen[:, p]), length, MAX_OBSERVATIONS), p] = True
    is_tie = np.zeros(len(seen), bool)
    shared = np.flatnonzero(seen.sum(axis=1) > 1)
    is_tie[_sample(shared, length, MAX_OBSERVATIONS * max(1, len(periods) - 1))] = True
    observed = []
    for p in periods:
        rows = np.flatnonzero(period == p)
        observed.append(rows[:: len(rows) // MAX_OBSERVATIONS + 1])

    needed = in_clouds[point, period] | is_tie[point]
    to_place = needed.copy()
    needed[np.concatenate([np.zeros(0, np.int64), *observed])] = True
    rows = np.flatnonzero(needed)
    rays = rays_at(model, point[rows], model.track_image[rows], model.track_xy[rows])
    whole = rays.where(to_place[rows]).finite()
    own = [place(whole.where(model.periods[whole.image] == p)) for p in periods]
    sightings = held_out_rays(model)
    held_out = sightings.finite()
    return Evidence(
        seen=seen,
        observed=tuple(rays.where(np.searchsorted(rows, mine)) for mine in observed),
        clouds=tuple(placed.of(in_clouds[:, p]) for p, placed in enumerate(own)),
        ties=whole.where(is_tie[whole.track]),
        ties_placed=tuple(placed.of(is_tie) for placed in own),
        held_out=held_out,
        held_out_placed=tuple(
            place(held_out.where(model.periods[held_out.image] == p)) for p in periods
        ),
        sightings=sightings,
        matches=tuple(cross_matches(model.held_out_tracks, model.periods)),
    )


def _sample(points: Ints, length: Ints, max_observations: int) -> Ints:
    """Thin out points until they have about ``max_observations`` observations."""
    return points[:: int(length[points].sum()) // max_observations + 1]
