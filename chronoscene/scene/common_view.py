"""Common view: which of the points of one group the cameras of another have in view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.cameras import Camera, project_points

Array = NDArray[np.float64]

DIRECTIONS, MAX_TANGENT, STEPS = 8, 4.0, 400
"""Where lenses are tried: so many directions, up to this hypot(x, y) / z, in so many steps."""


def common_view(
    xyz: Array,
    owner: NDArray[np.int64],
    views: Sequence[Sequence[tuple[Camera, Array]]],
    reach: Array,
) -> Array:
    """Share of the points of each group that the cameras of each group have in view.

    A point is in view if it lies in front of a camera, inside its image, and within reach. Whether
    something hides it is not known.

    Args:
        xyz: Points in the world. [N, 3]
        owner: Group of each point. [N]
        views: Camera and cam_from_world of the images of each group. [T]
        reach: Largest depth at which a group sees something; NaN where that is unknown. [T]

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


def _viewed(views: Sequence[tuple[Camera, Array]], xyz: Array, reach: float) -> NDArray[np.bool_]:
    """Which points any of the images has in view. [n, 3] -> [n]"""
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
    """Largest hypot(x, y) / z up to which pixels move outward as points do.

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


def _inside(camera: Camera, local: Array, limit: float) -> NDArray[np.bool_]:
    """Which points in front of a camera are in its image. [n, 3] -> [n]"""
    u, v = project_points(camera, local).T
    inside = (u >= 0) & (v >= 0) & (u <= camera.width) & (v <= camera.height)
    if np.isfinite(limit):
        inside &= np.hypot(local[:, 0], local[:, 1]) <= limit * local[:, 2]
    return np.asarray(inside)
