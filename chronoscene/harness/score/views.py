"""Test views of a run beside the frozen ground truth, for metrics of one's own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Mask
from chronoscene.harness.files.predictions import load_image, read_manifest
from chronoscene.harness.score.regions import scored_mask
from chronoscene.harness.score.scoring import match_views


@dataclass(frozen=True, slots=True, eq=False)
class PredictedView:
    """A test view: prediction and photo of equal size, RGB in 0..1, read from 8-bit files."""

    name: str
    """Name of the frame in the scene."""
    period: int
    prediction: NDArray[np.float32]
    """[H, W, 3]"""
    truth: NDArray[np.float32]
    """[H, W, 3]"""
    mask: Mask | None
    """True where the photo is scored; None if all of it is. [H, W]"""


def read_views(
    predictions: Path, ground_truth: Path, *, fitted: str = "", stage: bool = False
) -> Iterator[PredictedView]:
    """Yield the predicted views that show the period of their photo.

    Args:
        predictions: Predictions of a run, or of one of its stages.
        ground_truth: The frozen photos.
        fitted: As `RunRecord.fitted`.
        stage: As for `score_folder`.

    Raises:
        CheckpointError: If a manifest or an image is damaged, or the two do not belong together.
    """
    predicted, truth = read_manifest(predictions), read_manifest(ground_truth)
    for entry, target in match_views(predictions, predicted, truth, stage=stage):
        if entry.rendered_period == entry.camera_period:
            prediction = load_image(predictions, entry).astype(np.float32) / np.float32(255)
            photo = load_image(ground_truth, target).astype(np.float32) / np.float32(255)
            mask = scored_mask(ground_truth, target, fitted)
            yield PredictedView(entry.view, entry.camera_period, prediction, photo, mask)
