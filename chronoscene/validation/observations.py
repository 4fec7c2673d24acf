"""Observations of points in images, with indices looked up and what is broken marked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.validation.raw_model import RawImages, RawPoints


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

    def by_image(self, count: int) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Index of each of ``count`` images that has valid observations, and their rows."""
        image = np.where(self.valid, self.image, -1)
        order = np.argsort(image, kind="stable")
        ends = np.searchsorted(image[order], np.arange(count + 1))
        for i in range(count):
            if ends[i] < ends[i + 1]:
                yield i, order[ends[i] : ends[i + 1]]


def observe(images: RawImages, points: RawPoints) -> Observations:
    """Look up what the tracks refer to."""
    point = np.repeat(np.arange(len(points)), np.diff(points.track_start))
    order = np.argsort(images.ids, kind="stable")
    ids = images.ids[order]
    if not len(ids):
        nothing = np.full(len(point), -1, np.int64)
        return Observations(point, nothing, nothing)
    slot = np.minimum(np.searchsorted(ids, points.track_image), len(ids) - 1)
    image = np.where(ids[slot] == points.track_image, order[slot], -1)
    first = images.keypoint_start[:-1][image]
    length = np.diff(images.keypoint_start)[image]
    inside = (image >= 0) & (points.track_keypoint >= 0) & (points.track_keypoint < length)
    return Observations(point, image, np.where(inside, first + points.track_keypoint, -1))
