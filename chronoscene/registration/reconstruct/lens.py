"""A full model of the lens where the photos can carry it. Worker process only.

Photos are mapped with one coefficient of distortion, which few photos determine. What it leaves of
the distortion of a lens bends a scene and shifts focal length and height, so a model of many photos
is adjusted again with all coefficients.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.camera_groups import MANY, MIN_PHOTOS
from chronoscene.registration.features.database import copy_with_cameras
from chronoscene.registration.photos.stated import contradicts
from chronoscene.registration.reconstruct.focal import Focals, stated_focals
from chronoscene.registration.reconstruct.mapping import Task, adjust, triangulate

MIN_GAIN = 0.02  # Share by which the median reprojection error must shrink
SAMPLE = 5_000  # Points that show at little cost whether it can shrink that far


def with_full_lens(
    model: pycolmap.Reconstruction, task: Task, focals: Focals
) -> pycolmap.Reconstruction:
    """Adjust a model with all coefficients of cameras that took many photos.

    Args:
        model: Not changed.
        task: Focal lengths that it holds are free from then on if the images determine them.
        focals: What photos state.

    Returns:
        The adjusted model; the same one if no camera has enough photos, or nothing is gained.
    """
    cameras = [model.images[i].camera_id for i in model.reg_image_ids()]
    many = [c for c in sorted(set(cameras)) if cameras.count(c) >= MIN_PHOTOS]
    many = [c for c in many if model.cameras[c].model_name == "SIMPLE_RADIAL"]
    if not many or task.short:
        return model
    task.report("adjusting the lens", 0, 1)
    before = _error(model)
    free = replace(task, held=False)
    for attempt in (free, task) if task.held else (free,):
        found = _adjusted(model, attempt, many) if _may_gain(model, attempt, many) else None
        if found is None or _error(found) > (1 - MIN_GAIN) * before:
            task.remarks.append("more coefficients of the lens gain nothing")
            return model
        stated = stated_focals(found, focals)
        if attempt.held or not any(
            contradicts(float(found.cameras[c].mean_focal_length()), *stated[c])
            for c in many
            if c in stated
        ):
            focal = ", ".join(f"{found.cameras[c].mean_focal_length():.0f}" for c in many)
            task.remarks.append(
                f"all coefficients of the lens: focal length {focal} px, median reprojection "
                f"error {before:.3f} -> {_error(found):.3f} px"
            )
            task.held = attempt.held
            return found
    return model


def _may_gain(model: pycolmap.Reconstruction, task: Task, cameras: list[int]) -> bool:
    """Return False if an even selection of the points gains less than half of what it must."""
    ids = sorted(model.points3D)
    if len(ids) < 2 * SAMPLE:
        return True
    sample = pycolmap.Reconstruction(model)
    for point_id in set(ids).difference(ids[:: len(ids) // SAMPLE]):
        sample.delete_point3D(point_id)
    before = _error(sample)
    _free_lens(sample, cameras)
    adjust(sample, task)
    return _error(sample) <= (1 - MIN_GAIN / 2) * before


def _adjusted(
    model: pycolmap.Reconstruction, task: Task, cameras: list[int]
) -> pycolmap.Reconstruction:
    found = pycolmap.Reconstruction(model)
    full = _free_lens(found, cameras)
    database = task.scratch / "lens.db"
    copy_with_cameras(task.database, database, full)
    task = replace(task, database=str(database))
    adjust(found, task)
    found = triangulate(found, task, "lens")
    adjust(found, task)
    return found


def _free_lens(
    model: pycolmap.Reconstruction, cameras: list[int]
) -> dict[int, tuple[str, list[float]]]:
    """Give cameras all coefficients, 0 at first; return their model and parameters by id."""
    full = {}
    for camera_id in cameras:
        f, x, y, k = model.cameras[camera_id].params
        full[camera_id] = MANY, [f, f, x, y, k, 0.0, 0.0, 0.0]
        model.cameras[camera_id].model = getattr(pycolmap.CameraModelId, MANY)
        model.cameras[camera_id].params = full[camera_id][1]
    return full


def _error(model: pycolmap.Reconstruction) -> float:
    """Median reprojection error, pixels."""
    return float(np.median([p.error for p in model.points3D.values()] or [np.inf]))
