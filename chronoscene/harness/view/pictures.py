"""Pictures of finished runs for the viewer: periods that fade, two sides, depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Pixels
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.use.changes import surface_depth
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.harness.view.paths import KeyView
from chronoscene.methods import Prediction
from chronoscene.scene import Camera

ENDS = (2, 98)  # Percentiles of the inverse depth that get the ends of the colours


@dataclass(frozen=True, slots=True)
class Side:
    """One side of a picture."""

    run: TrainedRun
    period: float
    appearance: float | None = None
    """Period of the colours; None for that of the geometry."""


def draw_picture(
    view: KeyView, size: tuple[int, int], sides: Sequence[Side], pixels: int, wipe: float = 0.5
) -> tuple[NDArray[np.float32], Array]:
    """Draw a picture.

    Args:
        view: The camera; its period does not count.
        size: Width and height of the complete picture.
        sides: One, or the left and the right one.
        pixels: Number of pixels that it may have now.
        wipe: Share of the width that the left side has.

    Returns:
        rgb: 0..1; a white line between the sides. [H, W, 3]
        depth: In world units, infinite where there is no surface. [H, W]

    Raises:
        ChronoSceneError: If a model is missing or damaged.
    """
    scale = min(1.0, math.sqrt(pixels / math.prod(size)))
    width, height = (max(1, round(scale * side)) for side in size)
    focal = height / 2 / math.tan(view.fov / 2)
    cut = round(width * wipe) if len(sides) > 1 else width
    shown = []
    for side, start, end in zip(sides, (0, cut), (cut, width), strict=False):
        if end > start:
            params = (focal, width / 2 - start, height / 2)
            camera = Camera(1, "SIMPLE_PINHOLE", end - start, height, params)
            shown.append(_draw_side(side, camera, view.pose))
    rgb = np.concatenate([each.rgb for each in shown], axis=1)
    if 0 < cut < width:
        rgb[:, cut - max(1, width // 500) : cut] = 1
    return rgb, np.concatenate([surface_depth(each) for each in shown], axis=1)


def color_depth(depth: Array) -> Pixels:
    """Colour a depth map, near places light; black where there is no surface. [H, W, 3]"""
    inverse = 1 / depth
    surface = inverse > 0
    far, near = np.percentile(inverse[surface], ENDS) if surface.any() else (0, 1)
    level = np.clip((inverse - far) / max(near - far, 1e-9), 0, 1)
    bgr = cv2.applyColorMap(to_bytes(level), cv2.COLORMAP_VIRIDIS)
    return np.where(surface[..., None], bgr[..., ::-1], 0).astype(np.uint8)


def neighbours(run: TrainedRun, period: float) -> list[tuple[float, float]]:
    """Return a period, or the two around it if a method has nothing between, with weights."""
    low = math.floor(period)
    if run.is_continuous or period == low:
        return [(period, 1.0)]
    if not run.distinguishes_periods:
        return [(low, 1.0)]
    return [(low, 1 - (period - low)), (low + 1, period - low)]


def _draw_side(side: Side, camera: Camera, pose: Array) -> Prediction:
    """Fade between finished pictures; the depth is that of the one with the most weight."""
    colors = [(None, 1.0)] if side.appearance is None else neighbours(side.run, side.appearance)
    rgb = np.zeros((camera.height, camera.width, 3), np.float32)
    depth, most = np.zeros(rgb.shape[:2], np.float32), 0.0
    for period, share in neighbours(side.run, side.period):
        for appearance, other in colors:
            shown = side.run.render(camera, pose, period, appearance_period=appearance)
            rgb += share * other * shown.rgb
            if shown.depth is not None and share * other > most:
                depth, most = shown.depth, share * other
    return Prediction(rgb=rgb, depth=depth)
