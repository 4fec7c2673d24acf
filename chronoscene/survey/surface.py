"""Orthophoto and surface model of a period, rendered by a camera far above each part of the area.

A place r cells off the middle of a part of the area, and h above the middle of the heights, appears
``r h / (altitude - h)`` cells too far out. The altitude keeps that to `DISPLACEMENT` in the
corners. Depth in float32 is then precise to ``2^-24 altitude``: ``5e-5 h`` for `TILE` cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Ints
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.plan.sparse_depths import well_observed
from chronoscene.methods import Prediction
from chronoscene.scene import Camera, Scene
from chronoscene.scene.geometry import pose_from_rotation_translation
from chronoscene.scene.similarity import median_and_nmad
from chronoscene.survey.grid import Grid
from chronoscene.survey.map_frame import MapFrame
from chronoscene.survey.views import DepthView, look, solid_depth

TILE = 128  # Cells
DISPLACEMENT = 0.1  # Cells
SEEN = 0.05  # Relative difference of depth up to which a photo sees a cell
MIN_VIEWS = 2  # Photos that must see a cell: elsewhere, a model shows what it never learned

Render = Callable[[Camera, Array], Prediction]
"""Render a camera with a pose, with depth in units of the world."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A period from above."""

    heights: Array
    """Map coordinate; NaN where there is no surface, or where too few photos see it. [H, W]"""
    colors: NDArray[np.uint8]
    """[H, W, 3]"""
    spread: Array
    """Standard deviation of the heights by `look`; NaN where these are. [H, W]"""
    views: Ints
    """Number of photos that see the cell. [H, W]"""


def map_surface(render: Render, views: Sequence[DepthView], frame: MapFrame, grid: Grid) -> Surface:
    """Render a period from above; keep what its training photos see."""
    heights, spread = np.full(grid.shape, np.nan), np.full(grid.shape, np.nan)
    colors, count = np.zeros((*grid.shape, 3), np.uint8), np.zeros(grid.shape, np.int64)
    for rows, columns in grid.tiles(TILE):
        camera, pose, altitude = camera_above(frame, grid, rows, columns)
        shown = render(camera, pose)
        rise = (altitude - solid_depth(shown).astype(np.float64)) * frame.scales[2]
        heights[rows, columns] = (grid.low + grid.high) / 2 + rise
        colors[rows, columns] = to_bytes(shown.rgb)
    known = np.isfinite(heights)
    places = frame.to_world(np.column_stack([grid.centres[known], heights[known]]))
    count[known], spread[known] = look(places, views, SEEN, up=frame.axes[2])
    heights[count < MIN_VIEWS] = spread[count < MIN_VIEWS] = np.nan
    return Surface(heights, colors, spread, count)


def check_heights(
    surface: Surface, scene: Scene, period: int, frame: MapFrame, grid: Grid
) -> dict[str, float | int] | None:
    """Compare heights with the sparse points that training photos of the period see.

    Only points that three images see count; those below trees and on walls count as errors, which
    change a median little.

    Returns:
        ``count`` of the points; ``median`` and ``nmad`` of the height of their cells minus theirs,
        in metres; None without points.
    """
    points = scene.points
    train = np.array([image.split == "train" for image in scene.frames])
    counted = scene.point_periods(train)[:, period] & well_observed(points)
    places = frame.to_map(points.xyz[counted])
    places = places[grid.holds(places)]
    errors = surface.heights[grid.cells(places)] - places[:, 2]
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return None
    median, nmad = median_and_nmad(errors)
    return {"count": len(errors), "median": median, "nmad": nmad}


def camera_above(
    frame: MapFrame, grid: Grid, rows: slice, columns: slice
) -> tuple[Camera, Array, float]:
    """Make a camera whose pixels are cells.

    Returns:
        camera: A pinhole.
        pose: ``cam_from_world``, its x axis east and its y axis south. [4, 4]
        altitude: Above the middle of the heights, in metres of the world.
    """
    width, height = columns.stop - columns.start, rows.stop - rows.start
    altitude = (grid.high - grid.low) / 2 * (np.hypot(width, height) / 2 / DISPLACEMENT + 1)
    east = grid.left + (columns.start + columns.stop) / 2 * grid.resolution
    north = grid.top - (rows.start + rows.stop) / 2 * grid.resolution
    middle = frame.to_world(np.array([[east, north, (grid.low + grid.high) / 2]]))[0]
    rotation = frame.axes * np.array([[1.0], [-1.0], [-1.0]])
    focal = altitude * frame.scales[:2] / grid.resolution
    camera = Camera(1, "PINHOLE", width, height, (*focal.tolist(), width / 2, height / 2))
    centre = middle + altitude * frame.axes[2]
    return camera, pose_from_rotation_translation(rotation, -rotation @ centre), float(altitude)
