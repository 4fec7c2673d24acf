"""Observations of points in images: indices looked up, broken ones marked, points reprojected."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.colmap.raw_model import RawImages, RawPoints
from chronoscene.scene.cameras import Camera, project_points
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.scene.tracks import track_owners

MAX_TABLE = 1_000_000  # Ids within a range of about this many numbers are looked up in a table


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Flat arrays over all elements of all tracks (M observations)."""

    point: NDArray[np.int64]
    """Index into the points. [M]"""
    image: NDArray[np.int64]
    """Index into the images; -1 if there is no such image. [M]"""
    keypoint: NDArray[np.int64]
    """Index into the keypoints of all images; -1 if there is no such keypoint. [M]"""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True if both image and keypoint exist. [M]"""
        return self.keypoint >= 0

    def by_image(self, images: RawImages) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Index of each image that has valid observations, and their rows.

        Rows are in the order of the keypoints, which are stored image by image, so nothing is
        sorted. Of several observations of one keypoint, which has its own rule, one is taken.
        """
        row = np.full(len(images.keypoint_point), -1, np.int64)
        rows = np.flatnonzero(self.valid)
        row[self.keypoint[rows]] = rows
        used = row >= 0
        before = np.concatenate([[0], np.cumsum(used)])
        row, ends = row[used], before[images.keypoint_start]
        for i in range(len(images)):
            if ends[i] < ends[i + 1]:
                yield i, row[ends[i] : ends[i + 1]]


def observe(images: RawImages, points: RawPoints) -> Observations:
    """Look up what the tracks refer to."""
    point = track_owners(points.track_start)
    if not len(images):
        nothing = np.full(len(point), -1, np.int64)
        return Observations(point, nothing, nothing)
    image = _look_up(images.ids, points.track_image)
    # `take` with clipping is twice as fast as indexing; missing images are marked afterwards.
    first = images.keypoint_start.take(image, mode="clip")
    length = np.diff(images.keypoint_start).take(image, mode="clip")
    keypoint = first + points.track_keypoint
    outside = (points.track_keypoint < 0) | (points.track_keypoint >= length) | (image < 0)
    keypoint[outside] = -1
    return Observations(point, image, keypoint)


def _look_up(ids: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of each wanted id, -1 for none. Of equal ids the first counts."""
    low, high = int(ids.min()), int(ids.max())
    if high - low < 2 * MAX_TABLE + 4 * len(ids):  # ten times faster than a search
        table = np.full(high - low + 3, -1, np.int64)  # both ends stand for ids out of range
        table[ids[::-1] - (low - 1)] = np.arange(len(ids))[::-1]
        return table.take(wanted - (low - 1), mode="clip")
    order = np.argsort(ids, kind="stable")
    slot = np.minimum(np.searchsorted(ids[order], wanted), len(ids) - 1)
    return np.where(ids[order[slot]] == wanted, order[slot], -1)


class Reprojection(NamedTuple):
    """Reprojection of the m finite observations of one image."""

    image: int
    """Index into the images."""
    rows: NDArray[np.int64]
    """Indices into the observations. [m]"""
    depth: NDArray[np.float64]
    """World units along the optical axis. [m]"""
    error: NDArray[np.float64]
    """Distance in pixels between projection and observation; NaN behind the camera. [m]"""


def good_poses(images: RawImages) -> NDArray[np.bool_]:
    """Return True for finite poses with a non-zero quaternion. [I]"""
    norm = np.linalg.norm(images.quaternions, axis=1)
    return np.isfinite(norm) & (norm > 0) & np.isfinite(images.translations).all(axis=1)


def reproject(
    cameras: Mapping[int, Camera], images: RawImages, points: RawPoints, seen: Observations
) -> Iterator[Reprojection]:
    """Project the points of every image with a valid pose, a camera and observations."""
    good = good_poses(images)
    rotations = rotation_from_quaternion(images.quaternions)
    # One array per coordinate: numpy is several times slower along a short last axis. And `take` is
    # three times faster than indexing.
    xyz = np.ascontiguousarray(points.xyz.T)
    uv = np.ascontiguousarray(images.keypoint_xy.T)
    for image, rows in seen.by_image(images):
        camera = cameras.get(int(images.camera_ids[image]))
        if camera is None or not good[image]:
            continue
        place = xyz.take(seen.point.take(rows), axis=1)
        u, v = uv.take(seen.keypoint.take(rows), axis=1)
        local = _transform(rotations[image], images.translations[image], *place)
        x, y = project_points(camera, local.T).T  # NaN behind the camera
        depth, error = local[2], np.sqrt((x - u) ** 2 + (y - v) ** 2)  # infinite for absurd poses
        # Points and keypoints that are not finite have their own rules.
        known = np.isfinite(place).all(axis=0) & np.isfinite(u) & np.isfinite(v)
        if not known.all():
            rows, depth, error = rows[known], depth[known], error[known]
        yield Reprojection(image, rows, depth, error)


def _transform(rotation: Array, translation: Array, x: Array, y: Array, z: Array) -> Array:
    """Transform points at ``x, y, z`` [m] from the world to the frame of a camera. [3, m]"""
    local = np.empty((3, len(x)))
    for i, (row, shift) in enumerate(zip(rotation.tolist(), translation.tolist(), strict=True)):
        local[i] = row[0] * x + row[1] * y + row[2] * z + shift
    return local
