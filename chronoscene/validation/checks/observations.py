"""Observations of points in images, with indices looked up and what is broken marked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.arrays import RawImages, RawPoints
from chronoscene.scene.tracks import track_owners

DENSE = 1_000_000
"""Ids over a range of about so many numbers are looked up in a table."""


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
        """Whether both image and keypoint exist. [M]"""
        return self.keypoint >= 0

    def by_image(self, images: RawImages) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Index of each image that has valid observations, and their rows.

        Rows come in the order of the keypoints, which lie image by image: no sorting. Of several
        observations at one keypoint, which is an error of its own, one is taken.
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
    # `take` that clips is twice as quick as brackets; what is no image is marked afterwards.
    first = images.keypoint_start.take(image, mode="clip")
    length = np.diff(images.keypoint_start).take(image, mode="clip")
    keypoint = first + points.track_keypoint
    outside = (points.track_keypoint < 0) | (points.track_keypoint >= length) | (image < 0)
    keypoint[outside] = -1
    return Observations(point, image, keypoint)


def _look_up(ids: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of each wanted id, -1 for none. Of equal ids the first counts."""
    low, high = int(ids.min()), int(ids.max())
    if high - low < 2 * DENSE + 4 * len(ids):  # a table is ten times quicker than a search
        table = np.full(high - low + 3, -1, np.int64)  # both ends stand for what is beyond
        table[ids[::-1] - (low - 1)] = np.arange(len(ids))[::-1]
        return table.take(wanted - (low - 1), mode="clip")
    order = np.argsort(ids, kind="stable")
    slot = np.minimum(np.searchsorted(ids[order], wanted), len(ids) - 1)
    return np.where(ids[order[slot]] == wanted, order[slot], -1)
