"""Matches of two photos that one epipolar geometry allows: a quick test before the verification.

COLMAP's RANSAC draws thousands of samples for a pair with many wrong matches, and for one without
overlap all that its settings allow. USAC gives up a sample at the first matches that contradict it,
and so takes a tenth of the time; of what it leaves, few samples suffice.

Source: Raguram et al. 2013 (USAC); Matas and Chum 2005 (the sequential test), as in OpenCV.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Mask
from chronoscene.registration.features.nearest import Descriptors, mutual_matches

Placed: TypeAlias = tuple[Descriptors, Array]
"""Descriptors of an image, and the pixels of its keypoints. [N, 2]"""

MIN_INLIERS = 15  # COLMAP's, of a pair that is verified
MAX_PIXELS = 4.0  # COLMAP's, from the epipolar line
KEPT_PIXELS = 8.0  # Up to which a match is left to COLMAP, whose geometry differs a little
SAMPLES, CONFIDENCE = 10_000, 0.9999

CERTAIN = 20
"""Matches that must agree: a wrong geometry finds 15 to 18 that do, and hides a right one."""

MANY, CLEAR = 45, 1 / 3
"""Number of matches, and the share that must agree: with fewer, samples may have missed a geometry
that COLMAP would find, as it needs samples of only five matches where focal lengths are known."""


def plausible_matches(first: Placed, second: Placed) -> NDArray[np.uint32]:
    """Match descriptors, without what one epipolar geometry of the pair excludes.

    Args:
        first: One image.
        second: The other.

    Returns:
        Indices, sorted by the first. [M, 2]
    """
    matches = mutual_matches(first[0], second[0])
    a, b = first[1][matches[:, 0]], second[1][matches[:, 1]]
    return matches[near_epipolar_lines(a, b)]


def near_epipolar_lines(a: Array, b: Array) -> Mask:
    """Matches near the epipolar lines of the geometry that most of them agree with.

    Fewer than `MIN_INLIERS`, which COLMAP refuses, where there is none; all of them where it is not
    certain.

    Args:
        a: Pixels in one image. [M, 2]
        b: Pixels in the other. [M, 2]
    """
    import cv2

    everything = np.ones(len(a), bool)
    if len(a) < MIN_INLIERS:
        return everything
    try:
        found, _ = cv2.findFundamentalMat(a, b, cv2.USAC_FAST, MAX_PIXELS, CONFIDENCE, SAMPLES)
    except cv2.error:  # from some planes, OpenCV makes a geometry that it refuses afterwards
        return everything
    if found is None or found.shape != (3, 3):
        return everything
    distance = _sampson(np.asarray(found, np.float64), a, b)
    agreeing = distance < MAX_PIXELS
    count = int(agreeing.sum())
    if count < MIN_INLIERS and len(a) < MANY:
        return np.asarray(agreeing)
    if count < CERTAIN or count < CLEAR * len(a):
        return everything
    return np.asarray(distance < KEPT_PIXELS)


def _sampson(fundamental: Array, a: Array, b: Array) -> Array:
    """Distance to the epipolar lines of both images, to first order, pixels. [M]"""
    one = np.ones((len(a), 1))
    a, b = np.hstack([a, one]), np.hstack([b, one])
    lines_b, lines_a = a @ fundamental.T, b @ fundamental
    size = np.sqrt((lines_a[:, :2] ** 2).sum(axis=1) + (lines_b[:, :2] ** 2).sum(axis=1))
    return np.asarray(np.abs((b * lines_b).sum(axis=1)) / np.maximum(size, 1e-300))
