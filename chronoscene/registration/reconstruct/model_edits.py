"""Helpers on pycolmap's models: poses, ids, and merging. Worker process only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.pycolmap import pycolmap
from chronoscene.scene.geometry import Sim3, pose_from_rotation_translation


def image_pose(image: pycolmap.Image) -> NDArray[np.float64]:
    """``cam_from_world`` of a registered image. [4, 4]"""
    matrix = image.cam_from_world().matrix()
    return pose_from_rotation_translation(matrix[:, :3], matrix[:, 3])


def sorted_ids(model: pycolmap.Reconstruction) -> list[int]:
    """Ids of the registered images in the order of their names."""
    return sorted(model.reg_image_ids(), key=lambda i: str(model.images[i].name))


def as_pycolmap(sim: Sim3) -> pycolmap.Sim3d:
    """The same similarity as a pycolmap object."""
    return pycolmap.Sim3d(np.column_stack([sim.scale * sim.rotation, sim.translation]))


def merge(
    models: Sequence[pycolmap.Reconstruction], frames: Sequence[Sim3], database: str | Path
) -> pycolmap.Reconstruction:
    """One model of several that share no image, each moved by its similarity.

    Every image and camera gets the id that the database knows it by, whatever its id in its own
    model; images are found by name. Points are left out: they are triangulated again from the
    matches of all units, which joins their tracks. Of a camera in several models, the calibration
    of the model with most images is taken.
    """
    merged = known_images(database)
    ids = {str(image.name): i for i, image in merged.images.items()}
    calibrated: set[int] = set()
    for k in sorted(range(len(models)), key=lambda i: -models[i].num_reg_images()):
        model = pycolmap.Reconstruction(models[k])
        model.transform(as_pycolmap(frames[k]))
        for old in sorted_ids(model):
            image = merged.images[ids[str(model.images[old].name)]]
            if image.camera_id not in calibrated:
                params = model.cameras[model.images[old].camera_id].params
                merged.cameras[image.camera_id].params = params.tolist()
            set_pose(merged, image.image_id, model.images[old].cam_from_world())
        calibrated |= {merged.images[i].camera_id for i in merged.reg_image_ids()}
    return merged


def known_images(database: str | Path) -> pycolmap.Reconstruction:
    """A model with the cameras and images of a database, none of them posed."""
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = True
    with pycolmap.Database.open(str(database)) as opened:
        cache = pycolmap.DatabaseCache.create(opened, options)
    model = pycolmap.Reconstruction()
    model.load(cache)
    return model


def set_pose(
    model: pycolmap.Reconstruction, image_id: int, cam_from_world: pycolmap.Rigid3d
) -> None:
    """Register an image with its pose."""
    image = model.images[image_id]
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, cam_from_world)
    model.register_frame(image.frame_id)
