"""Depth of a model in the training photos of a period: who sees a place, how well it is defined.

The spread of a place is ``sqrt(pi / 2) mean |d|`` over the photos that see it, where d is the
distance along the ray from the place to the surface that the model shows in that photo: the
standard deviation, if d is normal. On maps, d is the vertical part of that distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Ints
from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.harness.use.changes import surface_depth, where_counted
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.methods import Prediction
from chronoscene.scene import Scene
from chronoscene.scene.cameras import project_points
from chronoscene.scene.geometry import camera_centre

MAX_WIDTH = 640  # Pixels of a view: depth is smooth, and the views of a period stay in memory
MIN_ALPHA = 0.5  # Opacity from which there is a surface


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """A training photo as the model shows it."""

    viewpoint: Viewpoint
    depth: NDArray[np.float32]
    """Infinite where there is no surface. [H, W]"""
    rgb: NDArray[np.uint8]
    """[H, W, 3]"""


def solid_depth(prediction: Prediction) -> NDArray[np.float32]:
    """Return the depth in units of the world, infinite where there is no surface. [H, W]

    Raises:
        ConfigError: If the method renders no depth.
    """
    if prediction.depth is None:
        raise ConfigError(
            "survey",
            expected="a run of a method that renders depth",
            found="one that does not",
            todo="open a run of another method",
        )
    depth = surface_depth(prediction)
    if prediction.alpha is not None:
        depth[~(prediction.alpha >= MIN_ALPHA)] = np.inf
    return depth.astype(np.float32)


def depth_views(run: TrainedRun, scene: Scene, period: int) -> Iterator[DepthView]:
    """Render the training photos of a period, at most `MAX_WIDTH` wide.

    There is no surface where a photo does not count.
    """
    width = min(MAX_WIDTH, run.record.max_width)
    store = ImageStore(scene, max_width=width, memory_limit=0)
    for frame in scene.select(split="train", period=period):
        camera = store.camera(frame)
        shown = run.render(camera, frame.cam_from_world, period)
        shown = where_counted(shown, store.load_mask(frame))
        viewpoint = Viewpoint(frame.name, camera, frame.cam_from_world, period)
        yield DepthView(viewpoint, solid_depth(shown), to_bytes(shown.rgb))


def look(
    world: Array, views: Sequence[DepthView], tolerance: float, *, up: Array | None = None
) -> tuple[Ints, Array]:
    """Count the photos that see places in the world [N, 3]; compute the spread of the places.

    Args:
        world: The places.
        views: Photos of one period.
        tolerance: Relative difference of depth up to which a photo sees a place.
        up: Direction in which the spread is measured; None for that of the rays. [3]

    Returns:
        count: [N]
        spread: NaN where no photo sees the place. [N]
    """
    from scipy.ndimage import map_coordinates

    count, total = np.zeros(len(world), np.int64), np.zeros(len(world))
    for view in views:
        camera, pose = view.viewpoint.camera, view.viewpoint.cam_from_world
        local = world @ pose[:3, :3].T + pose[:3, 3]
        xy = project_points(camera, local)
        with np.errstate(invalid="ignore"):
            places = np.flatnonzero(((xy >= 0) & (xy < camera.size)).all(axis=1))
        near = map_coordinates(1 / view.depth, xy[places, ::-1].T - 0.5, order=1, mode="nearest")
        with np.errstate(divide="ignore"):  # on a plane, 1 / depth is linear in the image
            relative = 1 / (near * local[places, 2]) - 1
        seen = np.abs(relative) < tolerance
        places, relative = places[seen], relative[seen]
        rays = world[places] - camera_centre(pose)
        length = np.linalg.norm(rays, axis=1) if up is None else rays @ up
        count[places] += 1
        total[places] += np.abs(relative * length)
    with np.errstate(invalid="ignore"):
        return count, np.sqrt(np.pi / 2) * total / np.where(count, count, np.nan)
