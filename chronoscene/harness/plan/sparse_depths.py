"""Depths of the sparse points in the training views, for `TrainingSet.load_depths`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from chronoscene.arrays import Ints, Mask
from chronoscene.images.store import ImageStore
from chronoscene.methods import SparseDepths
from chronoscene.scene import Frame, Points, Scene
from chronoscene.scene.cameras import project_points
from chronoscene.scene.tracks import by_image, track_owners

MIN_IMAGES = 3
"""Images that must see a point: two rays that are nearly parallel meet anywhere along them."""


def well_observed(points: Points) -> Mask:
    """Return True for finite points that at least `MIN_IMAGES` images see. [P]"""
    return points.finite & (np.diff(points.track_start) >= MIN_IMAGES)


def depth_loader(
    scene: Scene, frames: Sequence[Frame], store: ImageStore, scale: float
) -> Callable[[int], SparseDepths]:
    """Make the function that gives the sparse depths of a frame, by its place in ``frames``.

    They are those of the points that its image observes, so what hides a point, or was built or
    removed between the dates, is in no one's way. Of several points in a pixel, the nearest counts.

    Args:
        scene: Has the points.
        frames: Training images of the scene.
        store: Has their size and masks.
        scale: Units of the training frame per unit of the world.
    """
    points = scene.points

    @cache
    def observed() -> list[Ints]:
        """List the usable points of each of the frames."""
        usable, owners = well_observed(points), track_owners(points.track_start)
        numbers = {frame.name: number for number, frame in enumerate(scene.frames)}
        rows = by_image(points.track_frame, len(scene.frames))
        seen = (owners[rows[numbers[frame.name]]] for frame in frames)
        return [point[usable[point]] for point in seen]

    def load(index: int) -> SparseDepths:
        frame = frames[index]
        pose, camera = frame.cam_from_world, store.camera(frame)
        local = points.xyz[observed()[index]] @ pose[:3, :3].T + pose[:3, 3]
        local = local[np.argsort(local[:, 2], kind="stable")]
        with np.errstate(invalid="ignore"):
            xy = np.floor(project_points(camera, local))
            inside = ((xy >= 0) & (xy < camera.size)).all(axis=1) & (local[:, 2] > 0)
        column, row = xy[inside].astype(np.int64).T
        pixels, nearest = np.unique(row * camera.width + column, return_index=True)
        depths = scale * local[inside, 2][nearest]
        mask = store.load_mask(frame)
        counted = np.ones(len(pixels), bool) if mask is None else mask.ravel()[pixels]
        return SparseDepths(pixels[counted], depths[counted].astype(np.float32))

    return load
