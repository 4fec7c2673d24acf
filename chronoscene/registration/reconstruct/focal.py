"""The focal length that photos state, where the images do not determine it. Worker process only.

Photos of flat ground from one height, or along a street, fit almost any focal length: distortion,
height and shape make up for it. A model that contradicts the metadata is compared with one whose
focal length is that of the metadata.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import copy_with_cameras, verified_matches
from chronoscene.registration.photos.stated import contradicts
from chronoscene.registration.reconstruct.consistency import agreement, pair_agreements
from chronoscene.registration.reconstruct.mapping import Task

MAX_GROWTH = 1.05
"""Growth of the median reprojection error up to which images leave the focal length open."""

MAX_LOSS = 0.01  # Share of the matches that may agree less with the poses

Focals = Mapping[str, Sequence[float]]
"""Focal length in pixels and its relative error, by image name."""

MapAgain = Callable[[Task], list[pycolmap.Reconstruction]]


def hold_focals(
    task: Task, models: list[pycolmap.Reconstruction], focals: Focals, map_again: MapAgain
) -> list[pycolmap.Reconstruction]:
    """Map again with stated focal lengths if they are contradicted; the models that count.

    Args:
        task: Its focal lengths are held from then on if the second mapping counts.
        models: The largest first.
        focals: What photos state.
        map_again: Maps the same images in another task.
    """
    if not models or task.held:
        return models
    stated = stated_focals(models[0], focals)
    found = {i: float(models[0].cameras[i].mean_focal_length()) for i in stated}
    used = {models[0].images[i].camera_id for i in models[0].reg_image_ids()}
    far = [i for i, (f, error) in stated.items() if contradicts(found[i], f, error)]
    if not far or used - stated.keys():
        return models
    held = replace(task, database=str(task.scratch / "held.db"), held=True, remarks=[])
    _set_focals(task, held, focals)
    again = map_again(held)
    words = ", ".join(f"{found[i]:.0f} instead of {stated[i][0]:.0f} px" for i in far)
    cost = _cost(models, again, task)
    if cost is not None:
        task.remarks.append(
            f"focal length {words}, which the photos state; it is needed, for {cost}"
        )
        return models
    task.remarks += [
        *held.remarks,
        f"focal length {words}, which the photos state: that one fits as well and is held",
    ]
    task.database, task.held, task.short = held.database, True, held.short
    return again


def stated_focals(model: pycolmap.Reconstruction, focals: Focals) -> dict[int, tuple[float, float]]:
    """Stated focal length and error of the cameras of registered images."""
    found: dict[int, tuple[float, float]] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        if str(image.name) in focals:
            focal, error = focals[str(image.name)]
            found.setdefault(int(image.camera_id), (focal, error))
    return found


def _set_focals(task: Task, held: Task, focals: Focals) -> None:
    """Copy the database, with stated focal lengths."""
    changed: dict[int, tuple[str, list[float]]] = {}
    with pycolmap.Database.open(task.database) as opened:
        cameras = {int(c.camera_id): c for c in opened.read_all_cameras()}
        for image in opened.read_all_images():
            camera = cameras[int(image.camera_id)]
            if str(image.name) in focals:
                params = np.array(camera.params)
                params[list(camera.focal_length_idxs())] = focals[str(image.name)][0]
                changed[int(image.camera_id)] = str(camera.model_name), params.tolist()
    copy_with_cameras(task.database, Path(held.database), changed)


def _cost(
    free: list[pycolmap.Reconstruction], held: list[pycolmap.Reconstruction], task: Task
) -> str | None:
    """Describe how a model with held focal lengths is worse; None if it is as good."""
    if not held or held[0].num_reg_images() < free[0].num_reg_images():
        return "with that one, fewer images are registered"
    errors = [float(np.median([p.error for p in m[0].points3D.values()])) for m in (free, held)]
    if errors[1] > MAX_GROWTH * errors[0]:
        return f"with that one, the error grows from {errors[0]:.3f} to {errors[1]:.3f} px"
    _, matches = verified_matches(task.database)
    shares = [agreement(pair_agreements(m[0], matches), m[0].reg_image_ids()) for m in (free, held)]
    if shares[1] < shares[0] - MAX_LOSS:
        return "with that one, fewer matches agree"
    return None
