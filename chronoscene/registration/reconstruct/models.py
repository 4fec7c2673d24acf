"""Poses, ids and files of pycolmap's models. Worker process only."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.arrays import Array
from chronoscene.io.pycolmap import pycolmap
from chronoscene.scene.geometry import pose_from_rotation_translation
from chronoscene.scene.similarity import Sim3


def image_pose(image: pycolmap.Image) -> Array:
    """``cam_from_world`` of a registered image. [4, 4]"""
    matrix = image.cam_from_world().matrix()
    return pose_from_rotation_translation(matrix[:, :3], matrix[:, 3])


def set_pose(
    model: pycolmap.Reconstruction, image_id: int, cam_from_world: pycolmap.Rigid3d
) -> None:
    """Register an image with its pose."""
    image = model.images[image_id]
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, cam_from_world)
    model.register_frame(image.frame_id)


def set_poses(model: pycolmap.Reconstruction, poses: Mapping[str, Any]) -> set[int]:
    """Register images at their poses, 3 x 4 by name, and return their ids."""
    ids = {str(image.name): int(i) for i, image in model.images.items()}
    for name, pose in poses.items():
        set_pose(model, ids[name], pycolmap.Rigid3d(np.array(pose, np.float64)))
    return {ids[name] for name in poses}


def only(model: pycolmap.Reconstruction, image_ids: Collection[int]) -> pycolmap.Reconstruction:
    """Copy a model, with the poses of some of its images alone."""
    part = pycolmap.Reconstruction(model)
    for image_id in set(model.reg_image_ids()) - set(image_ids):
        part.deregister_frame(part.images[image_id].frame_id)
    return part


def sorted_ids(model: pycolmap.Reconstruction) -> list[int]:
    """Ids of the registered images in the order of their names."""
    return sorted(model.reg_image_ids(), key=lambda i: str(model.images[i].name))


def as_pycolmap(sim: Sim3) -> pycolmap.Sim3d:
    """Convert a similarity to pycolmap."""
    return pycolmap.Sim3d(np.column_stack([sim.scale * sim.rotation, sim.translation]))


def known_images(database: str | Path) -> pycolmap.Reconstruction:
    """Make a model of the cameras and images of a database, none of them registered."""
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = True
    with pycolmap.Database.open(str(database)) as opened:
        cache = pycolmap.DatabaseCache.create(opened, options)
    model = pycolmap.Reconstruction()
    model.load(cache)
    return model


def write_model(model: pycolmap.Reconstruction, folder: Path, photos: str) -> None:
    """Write a model with colours; the folder appears complete or not at all."""
    model.extract_colors_for_all_images(photos)
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    model.write_binary(str(partial))
    # COLMAP does not notice a full disk; reading fails where a file refers to what another lacks.
    pycolmap.Reconstruction(str(partial))
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def summary(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Counts and mean error for the log."""
    return {
        "images": int(model.num_reg_images()),
        "points": int(model.num_points3D()),
        "observations": int(model.compute_num_observations()),
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 4),
    }
