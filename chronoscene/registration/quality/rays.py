"""Tracks as bundles of rays: points placed by some of their images, and seen by others.

Residuals are taken on the plane at depth 1, where lenses are gone, and multiplied by the focal
lengths: they are pixels for a pinhole camera, and pixels of the image centre for any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chronoscene.registration.result import Registered
from chronoscene.scene import Camera
from chronoscene.scene.cameras import unproject_pixels
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.tracks import MIN_PARALLAX, meet, track_owners

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_OWN_ERROR = 4.0
"""Root mean square, pixels: tracks that do not even fit the images that place them are mismatched
in their own period."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Observations grouped by track (O observations)."""

    track: Ints
    """Ascending. [O]"""
    image: Ints
    """[O]"""
    pose: Array
    """cam_from_world of the image. [O, 4, 4]"""
    uv: Array
    """Where the ray meets the plane at depth 1 of its camera. [O, 2]"""
    focal: Array
    """Pixels. [O, 2]"""

    def __len__(self) -> int:
        return len(self.track)

    def where(self, mask: Mask | Ints) -> Rays:
        """Some of the observations, in their order."""
        return Rays(
            self.track[mask], self.image[mask], self.pose[mask], self.uv[mask], self.focal[mask]
        )

    def finite(self) -> Rays:
        """Without the pixels that COLMAP finds no ray for."""
        return self.where(np.flatnonzero(np.isfinite(self.uv).all(axis=1)))

    @classmethod
    def join(cls, *parts: Rays) -> Rays:
        """Observations of several, one after the other; tracks keep their numbers."""
        names = ("track", "image", "pose", "uv", "focal")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
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
        """Which tracks are placed, and the index of each that is."""
        if not len(self.track):
            return np.zeros(len(track), bool), np.zeros(0, np.int64)
        slot = np.searchsorted(self.track, track).clip(max=len(self.track) - 1)
        found = self.track[slot] == track
        return found, slot[found]

    def of(self, tracks: Mask) -> Placed:
        """The points of some tracks, by a mask over the numbers of all."""
        keep = tracks[self.track]
        return Placed(self.track[keep], self.xyz[keep], self.covariance[keep], self.error[keep])

    @classmethod
    def join(cls, first: Placed, second: Placed, shift: int) -> Placed:
        """Points of both; the tracks of the second come after those of the first."""
        second = replace(second, track=second.track + shift)
        names = ("track", "xyz", "covariance", "error")
        return cls(*(np.concatenate([getattr(p, name) for p in (first, second)]) for name in names))


def rays_at(model: Registered, track: Ints, image: Ints, xy: Array) -> Rays:
    """Rays of observations; NaN where COLMAP finds none. [O], [O], [O, 2]"""
    uv, focal = unproject(model.cameras, image, xy)
    return Rays(track, image, model.cam_from_world[image], uv, focal)


def model_rays(model: Registered) -> Rays:
    """Rays of the points of a model; a track is the index of a point."""
    track = track_owners(model.track_start)
    return rays_at(model, track, model.track_image, model.track_xy).finite()


def held_out_rays(model: Registered) -> Rays:
    """Rays of the tracks that took no part in the estimation."""
    tracks = model.held_out_tracks
    return rays_at(model, track_owners(tracks.start), tracks.image, tracks.xy).finite()


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


def project(rays: Rays, xyz: Array) -> tuple[Array, Array, Array]:
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


def place(rays: Rays) -> Placed:
    """Points of tracks by their rays: those seen by two images or more, with parallax, that fit.

    First the point nearest to all rays, then three Gauss-Newton steps on the residuals in pixels.
    """
    first = _first_of_groups(rays.track)
    count = np.diff(np.append(first, len(rays)))
    several = np.repeat(count >= 2, count)
    rays, first, count = rays.where(several), first[count >= 2], count[count >= 2]
    if not len(rays):
        return Placed(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    first = np.cumsum(count) - count
    local = np.column_stack([rays.uv, np.ones(len(rays))])
    direction = np.einsum("nji,nj->ni", rays.pose[:, :3, :3], local)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    xyz, parallax = meet(direction, camera_centre(rays.pose), first)
    for _ in range(3):
        residual, jacobian, _ = project(rays, np.repeat(xyz, count, axis=0))
        normal, gradient = _normal_equations(residual, jacobian, first)
        step = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        xyz = xyz - np.where(np.isfinite(step), step, 0.0)
    residual, jacobian, _ = project(rays, np.repeat(xyz, count, axis=0))
    normal, _ = _normal_equations(residual, jacobian, first)
    mean_square = np.add.reduceat((residual**2).sum(axis=1), first) / count
    good = (parallax > MIN_PARALLAX) & (mean_square < MAX_OWN_ERROR**2)
    return Placed(
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


def _first_of_groups(track: Ints) -> Ints:
    """Where each run of equal values begins."""
    if not len(track):
        return np.zeros(0, np.int64)
    return np.flatnonzero(np.concatenate([[True], track[1:] != track[:-1]]))
