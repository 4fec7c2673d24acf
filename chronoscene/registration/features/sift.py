"""SIFT features of a photo by OpenCV, in the form in which COLMAP stores them. Worker process only.

Detector and descriptor are those of Lowe (2004), on the image at twice its size. Descriptors are
RootSIFT (Arandjelovic and Zisserman 2012): each is normalised to a sum of 1, then the square root
is taken, so that its length is 1; COLMAP stores 512 times that in bytes.

The conventions differ: the top left pixel is centred at (0, 0) for OpenCV and at (0.5, 0.5) for
COLMAP, and the size of a keypoint is a diameter for OpenCV and a scale for COLMAP.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.images.decoding import load_mask
from chronoscene.images.masks import resize_mask
from chronoscene.registration.features.database import Features

CONTRAST_THRESHOLD = 0.004
"""A fifth of COLMAP's: what dark photos have in common with others lies below that."""

STRONG = 0.0133
"""Contrast from which a feature goes before all fainter ones, however large those are. Two thirds
of COLMAP's threshold, by which OpenCV finds as many features as COLMAP does."""

EDGE_THRESHOLD = 10.0  # COLMAP's
LENGTH = 512.0  # Of a descriptor, as COLMAP stores it

PYRAMID_BYTES = 240
"""Memory for a pixel of the photo: four pixels after enlarging, 6 + 5 images of four bytes in each
octave, and a third more for the smaller octaves."""

MEMORY = 8 << 30  # Bytes that photos may take at the same time; a single one may take more


def photos_at_once(max_image_size: int, threads: int) -> int:
    """Number of photos that threads and memory allow at a time."""
    return max(1, min(threads, MEMORY // (PYRAMID_BYTES * max_image_size**2)))


def sift_features(
    path: Path, mask_path: Path | None = None, *, max_image_size: int, max_features: int
) -> Features:
    """Detect and describe features: strong ones before faint ones, each by decreasing size.

    Args:
        path: Photo. Orientation tags are not applied.
        mask_path: Mask of the photo, if there is one: no features are found where it is 0.
        max_image_size: Pixels; a photo with a longer side is scaled down to it.
        max_features: Number of features to keep, in this order.
    """
    with Image.open(path) as image:
        image.draft("L", image.size)  # of a JPEG, colours need not be decoded
        grey = np.asarray(image.convert("L"))
    height, width = grey.shape
    mask = None if mask_path is None else load_mask(mask_path, (width, height))
    factor = min(1.0, max_image_size / max(width, height))
    if factor < 1:
        size = max(1, round(factor * width)), max(1, round(factor * height))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        mask = None if mask is None else resize_mask(mask, size)
    sift = cv2.SIFT.create(
        contrastThreshold=CONTRAST_THRESHOLD,
        edgeThreshold=EDGE_THRESHOLD,
        enable_precise_upscale=True,  # otherwise, positions are off by a quarter of a pixel
    )
    found = sift.detect(grey, None if mask is None else mask.astype(np.uint8))
    # OpenCV divides thresholds, and so responses, by the layers of an octave.
    faint = np.array([k.response for k in found]) < STRONG / sift.getNOctaveLayers()
    kept = np.lexsort((np.array([-k.size for k in found]), faint))[:max_features]
    if not len(kept):
        return np.zeros((0, 6), np.float32), np.zeros((0, 128), np.uint8)
    # Another pyramid takes less time than descriptors of all that detailed photos have.
    found, histograms = sift.compute(grey, [found[i] for i in kept])
    zoom = width / grey.shape[1], height / grey.shape[0]
    return _in_colmap(found, zoom), root_sift(np.asarray(histograms, np.float32))


def _in_colmap(found: Sequence[cv2.KeyPoint], zoom: tuple[float, float]) -> NDArray[np.float32]:
    """Convert keypoints to COLMAP's form, in a photo larger by ``zoom`` (x, y). [K, 6]"""
    x, y = ((np.array([k.pt for k in found]) + 0.5) * zoom).T
    scale = np.array([k.size for k in found]) / 2 * sum(zoom) / 2
    angle = np.radians([k.angle for k in found])
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    return np.column_stack([x, y, cosine, -sine, sine, cosine]).astype(np.float32)


def root_sift(histograms: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Convert SIFT descriptors of any length to RootSIFT in bytes. [K, 128]"""
    sums = histograms.sum(axis=1, keepdims=True, dtype=np.float64)
    roots = np.rint(LENGTH * np.sqrt(histograms / np.maximum(sums, 1e-12)))
    return np.minimum(roots, 255).astype(np.uint8)
