"""Features of one photo as sources give them, and the checks that all of them pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import RegistrationError

MAX_KEYPOINTS = 1_000_000  # Of a photo; more are a damaged or hostile file
MAX_VALUES = 2**28  # Numbers in the descriptors of a photo
MAX_RATIO = 0.8  # Of the distances to the nearest descriptor and to the second nearest
CHUNK = 1024  # Keypoints that are compared with those of another photo at a time
BORDER = 2.0  # Pixels by which a keypoint may lie outside of its photo


@dataclass(frozen=True, slots=True, eq=False)
class ImageFeatures:
    """Features of one photo."""

    keypoints: NDArray[np.float32]
    """Pixels; the corner of the photo is (0, 0). Up to four more columns as COLMAP has them.
    [K, 2 to 6]"""
    descriptors: NDArray[np.uint8] | NDArray[np.float32] | None
    """Bytes are SIFT in COLMAP's form. [K, D]"""
    size: tuple[int, int] | None
    """Width and height of the photo, if known."""


def checked(place: str, found: ImageFeatures, size: tuple[int, int]) -> ImageFeatures:
    """Features of a photo of ``size``, if they can be those of it.

    Raises:
        RegistrationError: If shapes differ, numbers are not finite, or they are of another photo.
    """
    xy, descriptors = found.keypoints, found.descriptors
    if xy.ndim != 2 or xy.shape[1] not in (2, 4, 6):
        raise wrong(place, "keypoints with 2, 4 or 6 columns", f"shape {xy.shape}")
    if descriptors is not None and (descriptors.ndim != 2 or len(descriptors) != len(xy)):
        raise wrong(place, f"descriptors of {len(xy)} keypoints", f"shape {descriptors.shape}")
    if not np.isfinite(xy).all() or not (
        descriptors is None or np.isfinite(descriptors.sum(dtype=np.float64))
    ):
        raise wrong(place, "finite numbers", "NaN or infinity")
    todo = "extract them from the photos that are registered, as stored: without rotating them by "
    todo += "their orientation tag"
    if found.size is not None and tuple(found.size) != size:
        raise wrong(place, f"features of {size[0]} x {size[1]} pixels",
                    f"{found.size[0]} x {found.size[1]}", todo)  # fmt: skip
    if len(xy) and ((xy[:, :2] < -BORDER) | (xy[:, :2] > np.add(size, BORDER))).any():
        x, y = xy[:, :2].max(axis=0)
        raise wrong(place, f"keypoints within {size[0]} x {size[1]} pixels",
                    f"up to {x:.0f}, {y:.0f}", todo)  # fmt: skip
    return found


def checked_matches(place: str, rows: NDArray[np.int64], counts: tuple[int, int]) -> np.ndarray:
    """Matches as COLMAP stores them, sorted, without repetition, if their indices exist. [M, 2]"""
    rows = np.asarray(rows)
    if rows.ndim != 2 or rows.shape[1] != 2 or rows.dtype.kind not in "iu":
        raise wrong(place, "pairs of indices", f"{rows.dtype} of shape {rows.shape}")
    if len(rows) and ((rows < 0) | (rows >= np.array(counts))).any():
        found = f"indices up to {rows[:, 0].max()} and {rows[:, 1].max()}"
        raise wrong(place, f"indices into {counts[0]} and {counts[1]} keypoints", found,
                    "give matches and features of the same run")  # fmt: skip
    return np.unique(rows, axis=0).astype(np.uint32)


def wrong(
    place: str, expected: str, found: str, todo: str = "compute the file again"
) -> RegistrationError:
    """Make the error for a file that cannot be used."""
    return RegistrationError(place, expected=expected, found=found, todo=todo)


def check_size(place: str, shape: tuple[int, ...]) -> None:
    """Refuse sizes that no photo has, before memory is taken for them."""
    if len(shape) > 2 or any(n > MAX_KEYPOINTS for n in shape) or np.prod(shape) > MAX_VALUES:
        raise wrong(place, "the features or matches of a photo", f"an array of shape {shape}")


def nearest(first: ImageFeatures, second: ImageFeatures) -> NDArray[np.uint32]:
    """Match mutual nearest neighbours that pass the ratio test of Lowe (2004). [M, 2]"""
    if not len(first.keypoints) or len(second.keypoints) < 2:
        return np.zeros((0, 2), np.uint32)
    assert first.descriptors is not None and second.descriptors is not None
    a, b = (
        d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)
        for d in (first.descriptors.astype(np.float32), second.descriptors.astype(np.float32))
    )
    best, back = np.zeros(len(a), np.int64), np.zeros(len(b), np.int64)
    clear, most = np.zeros(len(a), bool), np.full(len(b), -np.inf, np.float32)
    for start in range(0, len(a), CHUNK):
        rows = slice(start, start + CHUNK)
        similarity = a[rows] @ b.T
        best[rows] = similarity.argmax(axis=1)
        second_most, first_most = np.sort(np.partition(similarity, -2, axis=1)[:, -2:], axis=1).T
        clear[rows] = 1 - first_most < MAX_RATIO**2 * (1 - second_most)  # squared distances
        nearer = similarity.max(axis=0) > most
        back[nearer] = start + similarity.argmax(axis=0)[nearer]
        most = np.maximum(most, similarity.max(axis=0))
    mutual = np.flatnonzero(clear & (back[best] == np.arange(len(best))))
    return np.column_stack([mutual, best[mutual]]).astype(np.uint32)
