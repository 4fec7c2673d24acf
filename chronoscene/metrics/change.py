"""Changes between two periods: predicted maps against the truth, and what leaks between periods."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.arrays import Array
from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.images.truth import APPEARANCE, GEOMETRY, UNCHANGED
from chronoscene.metrics.psnr_ssim import checked_mask, unit_float, unit_pair


def change_scores(
    scores: ArrayLike,
    truth: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    threshold: float | None = None,
) -> dict[str, float]:
    """Score how well a map separates changed pixels from unchanged ones.

    ``change_ap`` is the average precision. With a threshold, ``change_f1`` and ``change_iou`` take
    the pixels that reach it for changed. Names that end in ``_geometry`` and ``_appearance`` are of
    one kind of change against what is unchanged: pixels of the other kind do not count.

    Args:
        scores: The higher, the more likely changed. Several maps in one array count as one. [...]
        truth: `UNCHANGED`, `APPEARANCE` or `GEOMETRY`. [...]
        mask: Pixels that count. [...] bool
        threshold: Lowest score of what is predicted to be changed.

    Returns:
        Values by name; those of a kind without a changed pixel are left out.
    """
    scores, truth = np.asarray(scores, np.float64), np.asarray(truth)
    check_shape("scores", scores, truth.shape)
    counted = np.ones(truth.shape, bool) if mask is None else np.asarray(mask, bool)
    values = {}
    for suffix, other in (("", None), ("_geometry", APPEARANCE), ("_appearance", GEOMETRY)):
        part = counted if other is None else counted & (truth != other)
        s, changed = scores[part], truth[part] != UNCHANGED
        if not changed.any():
            continue
        values[f"change_ap{suffix}"] = average_precision(s, changed)
        if threshold is not None:
            hits, either = (s >= threshold) & changed, (s >= threshold) | changed
            values[f"change_iou{suffix}"] = float(hits.sum() / either.sum())
            values[f"change_f1{suffix}"] = float(2 * hits.sum() / (hits.sum() + either.sum()))
    return values


def average_precision(scores: Array, changed: NDArray[np.bool_]) -> float:
    """Sum over thresholds of precision times the gain in recall; equal scores share a threshold.

    Args:
        scores: [n]
        changed: At least one is. [n]
    """
    levels, level = np.unique(-scores, return_inverse=True)
    hits = np.bincount(level, weights=changed, minlength=len(levels))
    precision = np.cumsum(hits) / np.cumsum(np.bincount(level, minlength=len(levels)))
    return float((precision * hits).sum() / hits.sum())


def share_of_other(
    image: ArrayLike, own: ArrayLike, other: ArrayLike, mask: ArrayLike | None = None
) -> float:
    """Position of an image between the truths of two periods: 0 is its own, 1 the other.

    The w that minimises the squared error of (1 - w) own + w other; errors at right angles to the
    change do not count. Of an image that is to show its own period, it is the *ghosting*. What it
    grows by when the other period is rendered is the *sensitivity* to the change: 1 for a model
    that shows both right, 0 for one that cannot distinguish them.

    Args:
        image: [H, W, C]
        own: Truth of the period that the image is to show. [H, W, C]
        other: Truth of the other period, from the same camera. [H, W, C]
        mask: Pixels that count. [H, W] bool

    Raises:
        ShapeError: If the two truths are equal there.
    """
    a, b = unit_pair(own, other)
    c = unit_float(image)
    check_shape("image", c, a.shape)
    counted = np.ones(a.shape[:2], bool) if mask is None else checked_mask(mask, a)
    change = (b - a)[counted]
    energy = float((change**2).sum())
    if energy == 0:
        raise ShapeError(
            "other",
            expected="a change where pixels count",
            found="none",
            todo="leave this pair of periods out",
        )
    return float(((c - a)[counted] * change).sum()) / energy
