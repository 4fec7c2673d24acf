"""Visibility of points: tracks in flat form, reprojection, intersection of rays, common view.

Observations of point i are ``start[i]:start[i + 1]`` (P points, M observations), as in
`chronoscene.scene.Points`. All functions take arrays, so that scenes, raw models and registrations
can use them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.scene.cameras import Camera, project_points

MIN_PARALLAX = 3e-4
"""Smallest eigenvalue of the mean of ``I - d d^T`` over the rays of a point that still has a depth.
Two rays at an angle of 2a give sin(a)^2: this is a = 1 degree, where noise of one pixel at a focal
length of 1000 pixels moves the point by 3 % of its distance."""

DIRECTIONS, MAX_TANGENT, STEPS = 8, 4.0, 400
"""Directions in which lenses are tried, largest hypot(x, y) / z, and steps up to it."""


def track_owners(track_start: Ints) -> Ints:
    """Return the index of the point of each observation. [P + 1] -> [M]"""
    return np.repeat(np.arange(len(track_start) - 1), np.diff(track_start))


def select_tracks(track_start: Ints, keep: Mask) -> tuple[Ints, Mask]:
    """Return the track starts of the kept points [P] [kept + 1], and their observations. [M]"""
    lengths = np.diff(track_start)
    return np.concatenate([[0], np.cumsum(lengths[keep])]), np.repeat(keep, lengths)


def count_views(point: Ints, period: Ints, shape: tuple[int, int]) -> Ints:
    """Count the observations that each period has of each point. [P, T]

    Args:
        point: Of each observation, see `track_owners`. [M]
        period: Of each observation. [M]
        shape: Numbers of points and of periods.
    """
    cells = point * shape[1] + period
    return np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)


def seen_by_period(point: Ints, period: Ints, shape: tuple[int, int]) -> Mask:
    """Find the periods with images that see a point; arguments as in `count_views`. [P, T]"""
    seen = np.zeros(shape, bool)
    seen[point, period] = True
    return seen


def by_image(track_image: NDArray[np.integer], images: int) -> list[Ints]:
    """List the observations of each image, in the order of the tracks. [M] -> one [m] per image"""
    # Keys of 16 bits are sorted several times faster.
    keys = track_image.astype(np.uint16) if images <= 2**16 else track_image
    ends = np.cumsum(np.bincount(track_image, minlength=images))
    return np.split(np.argsort(keys, kind="stable"), ends[:-1]) if images else []


def reproject(
    views: Sequence[tuple[Camera, Array]],
    xyz: Array,
    track_start: Ints,
    track_image: NDArray[np.integer],
    track_xy: Array,
) -> Iterator[tuple[Ints, Array, Array]]:
    """Project every point into the images that see it, distortion included; image by image.

    Args:
        views: Camera and cam_from_world of each image.
        xyz: In the world. [P, 3]
        track_start: Where the observations of each point begin. [P + 1]
        track_image: Image of each observation. [M]
        track_xy: Pixels of the observations. [M, 2]

    Yields:
        rows: Observations of the image, in the order of the tracks. [m]
        error: Distance of each from the projection in pixels. [m]
        depth: Of each point in world units. [m]
        Both are NaN where the point is not in front of the camera.
    """
    point = track_owners(track_start).astype(np.int32)  # half the memory to read, once per view
    with np.errstate(all="ignore"):  # absurd poses and points give NaN or infinity
        for rows, (camera, cam_from_world) in zip(
            by_image(track_image, len(views)), views, strict=True
        ):
            local = xyz.take(point.take(rows), axis=0) @ cam_from_world[:3, :3].T
            local += cam_from_world[:3, 3]
            u, v = project_points(camera, local).T
            x, y = track_xy.take(rows, axis=0).T
            yield rows, np.hypot(u - x, v - y), np.where(local[:, 2] > 0, local[:, 2], np.nan)


def intersect_rays(direction: Array, centre: Array, first: Ints) -> tuple[Array, Array]:
    """Find the points nearest to bundles of rays: ``sum(I - d d^T) x = sum((I - d d^T) c)``.

    Args:
        direction: Unit vectors d in the world, bundle after bundle. [R, 3]
        centre: Where the rays start, c. [R, 3]
        first: First ray of each bundle. [B]

    Returns:
        xyz: The points; meaningless without parallax. [B, 3]
        parallax: Smallest eigenvalue of the mean of ``I - d d^T``, see `MIN_PARALLAX`. [B]
    """
    count = np.diff(np.append(first, len(direction)))
    # I - d d^T projects onto the plane across a ray.
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    left = np.add.reduceat(across, first)
    right = np.add.reduceat(np.einsum("nij,nj->ni", across, centre), first)
    parallax = np.linalg.eigvalsh(left / count[:, None, None])[:, 0]
    left += 1e-12 * np.eye(3)  # parallel rays have no single nearest point
    return np.linalg.solve(left, right[:, :, None])[:, :, 0], np.asarray(parallax, np.float64)


def common_view(
    xyz: Array, owner: Ints, views: Sequence[Sequence[tuple[Camera, Array]]], reach: Array
) -> Array:
    """Compute the share of the points of each group that the cameras of each have in view.

    A point is in view if it lies in front of a camera, inside its image, and within reach. Whether
    something hides it is not known.

    Args:
        xyz: Points in the world. [N, 3]
        owner: Group of each point. [N]
        views: Camera and cam_from_world of the images of each group. [T]
        reach: Largest depth at which a group sees something; NaN if unknown. [T]

    Returns:
        Row a, column b: share of the points of a that b has in view; NaN if a has no points or the
        reach of b is unknown. [T, T]
    """
    groups = len(views)
    counts = np.bincount(owner, minlength=groups)
    shares = np.full((groups, groups), np.nan)
    for group in np.flatnonzero(np.isfinite(reach)).tolist():
        viewed = _viewed(views[group], xyz, reach[group])
        shares[:, group] = np.bincount(owner[viewed], minlength=groups) / np.maximum(counts, 1)
    shares[counts == 0] = np.nan
    return shares


def _viewed(views: Sequence[tuple[Camera, Array]], xyz: Array, reach: float) -> Mask:
    """Find the points that any of the images has in view. [n, 3] -> [n]"""
    viewed = np.zeros(len(xyz), bool)
    limits = {camera: _limit(camera) for camera in {camera for camera, _ in views}}
    with np.errstate(all="ignore"):  # absurd poses and points are in no view
        for camera, cam_from_world in views:
            left = np.flatnonzero(~viewed)
            local = xyz[left] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
            ahead = np.flatnonzero((local[:, 2] > 0) & (local[:, 2] <= reach))
            inside = _inside(camera, local[ahead], limits[camera])
            viewed[left[ahead[inside]]] = True
    return viewed


def _limit(camera: Camera) -> float:
    """Find the largest hypot(x, y) / z up to which pixels move outward as points do.

    Beyond it, the polynomials of lenses turn back and map points far outside into the image.
    """
    if camera.is_pinhole:
        return np.inf
    angle = np.arange(DIRECTIONS)[:, None] * (2 * np.pi / DIRECTIONS)
    tangent = np.linspace(0, MAX_TANGENT, STEPS)
    x, y = np.cos(angle) * tangent, np.sin(angle) * tangent
    u, v = project_points(camera, np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)).T
    u, v = u.reshape(x.shape), v.reshape(x.shape)
    outward = np.diff(np.hypot(u - u[:, :1], v - v[:, :1]), axis=1) > 0
    return float(tangent[outward.all(axis=0).argmin()]) if not outward.all() else np.inf


def _inside(camera: Camera, local: Array, limit: float) -> Mask:
    """Find the points in front of a camera that are in its image. [n, 3] -> [n]"""
    u, v = project_points(camera, local).T
    inside = (u >= 0) & (v >= 0) & (u <= camera.width) & (v <= camera.height)
    if np.isfinite(limit):
        inside &= np.hypot(local[:, 0], local[:, 1]) <= limit * local[:, 2]
    return np.asarray(inside)
