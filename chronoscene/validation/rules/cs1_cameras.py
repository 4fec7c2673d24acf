"""CS13, CS14: intrinsics, and the rigs and frames of COLMAP 3.12 and later."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.arrays import Array
from chronoscene.colmap.raw_model import CAMERA, RawImages, RawModel
from chronoscene.formats.shared.grouping import NAME_PERIODS
from chronoscene.io.wording import counted, shown
from chronoscene.scene.cameras import (
    PINHOLE_MODELS,
    POLYNOMIAL_MODELS,
    Camera,
    as_pinhole,
    project_points,
    unproject_pixels,
)
from chronoscene.scene.geometry import camera_centre, rotation_from_quaternion
from chronoscene.validation import rule
from chronoscene.validation.folder.observations import good_poses
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit

VISIBLE = 0.5  # Pixels; distortion that moves no pixel this far may be dropped instead of undone

MAX_ANGLE, MIN_ANGLE = 150.0, 1.0
"""Horizontal field of view, in degrees, that a pinhole photo may plausibly have."""

UNEQUAL = 0.1  # Relative difference of fx and fy; pixels are square to a few percent in any camera

UNDISTORT = "undistort the images and the model: chronoscene undistort DIR OUT"
NAME_AND_UNDISTORT = (
    "write sparse/split.txt first; or let chronoscene undistort DIR OUT do it together with the "
    f"images, and {NAME_PERIODS}"
)
PERSPECTIVE = "render perspective views of the panoramas, and register those"
DROP = (
    "write the camera as PINHOLE or SIMPLE_PINHOLE without its distortion, which is below half a "
    "pixel; or undistort as other cameras"
)
NO_DISTORTION = "PINHOLE, SIMPLE_PINHOLE, or a radial or OPENCV model without distortion"

SAME_ANGLE = 1e-3  # Radians between two records of one pose beyond rounding in a text file
SAME_PLACE = 1e-3  # The same for positions, as a share of the extent of the cameras


@rule.error("CS131", bad="`1 PINHOLE 640 480 -500 500 320 240`", remedy="correct the camera")
def camera_unusable(scene: RawScene, cameras: Sequence[Camera]) -> Iterator[Hit]:
    """A camera has no size, an absurd size, or a focal length that is not positive and finite."""
    for camera in cameras:
        if not camera.is_usable:
            expected = "a plausible size, positive focal lengths and finite parameters"
            params = ", ".join(f"{p:g}" for p in camera.params)
            found = f"{camera.width} x {camera.height}, parameters {params}"
            yield Hit(scene.camera_place(camera), expected, found)


@rule.error("CS132", bad="`OPENCV_FISHEYE`", remedy=UNDISTORT)
def camera_model(scene: RawScene, cameras: Sequence[Camera]) -> Iterator[Hit]:
    """A camera model cannot be used as a pinhole camera."""
    for camera in cameras:
        if camera.model not in (*PINHOLE_MODELS, *POLYNOMIAL_MODELS):
            remedy = PERSPECTIVE if camera.model == "EQUIRECTANGULAR" else _undistort(scene)
            yield Hit(scene.camera_place(camera), NO_DISTORTION, camera.model, remedy)


@rule.error("CS133", bad="`SIMPLE_RADIAL` with k = -0.16", remedy=UNDISTORT, needs=("cameras",))
def camera_distorted(scene: RawScene) -> Iterator[Hit]:
    """A camera has lens distortion, which methods cannot train with. Benchmarks refuse it."""
    for camera in _polynomial(scene):
        if not camera.is_pinhole:
            shift = displacement(camera)
            found = f"{camera.model} with distortion that moves pixels by up to {shift:.3g} px"
            if images := scene.images_of_camera.get(camera.camera_id):
                found += f" in {counted(len(images), 'image')}: {shown(images)}"
            remedy = DROP if shift < VISIBLE else _undistort(scene)
            yield Hit(scene.camera_place(camera), "a camera without distortion", found, remedy)


def _undistort(scene: RawScene) -> str:
    """The remedy that works on this folder: without periods, none of our commands reads it."""
    return UNDISTORT if scene.periods is not None else NAME_AND_UNDISTORT


@rule.info(
    "CS134",
    bad="`SIMPLE_RADIAL` with k = 0",
    remedy="nothing to do here; write it as PINHOLE or SIMPLE_PINHOLE for other readers",
    needs=("cameras",),
)
def zero_distortion(scene: RawScene) -> Iterator[Hit]:
    """The distortion parameters of a camera are all zero. It is used as a pinhole camera; other
    readers may go by the name of its model."""
    for camera in _polynomial(scene):
        if camera.is_pinhole:
            found = f"{camera.model} without distortion"
            yield Hit(scene.camera_place(camera), "PINHOLE or SIMPLE_PINHOLE", found)


@rule.warning(
    "CS135",
    bad="f = 35 (millimetres) with a width of 4000 pixels",
    remedy="check that the focal lengths are in pixels and belong to images of this size",
)
def implausible_focal(scene: RawScene, usable_cameras: dict[int, Camera]) -> Iterator[Hit]:
    """The focal lengths imply a field of view or an aspect ratio of pixels that no ordinary camera
    has."""
    for camera in usable_cameras.values():
        fx, fy = camera.K[0, 0], camera.K[1, 1]
        angle = np.degrees(2 * np.arctan(camera.width / (2 * fx)))
        if not MIN_ANGLE <= angle <= MAX_ANGLE:
            found = f"{angle:.3g} degrees (f = {fx:.4g}, width {camera.width})"
            expected = f"a field of view of {MIN_ANGLE:g} to {MAX_ANGLE:g} degrees"
            yield Hit(scene.camera_place(camera), expected, found)
        if abs(fx - fy) > UNEQUAL * max(fx, fy):
            found = f"fx = {fx:.4g}, fy = {fy:.4g}"
            yield Hit(scene.camera_place(camera), "nearly equal focal lengths", found)


@rule.warning(
    "CS136",
    bad="cx = 2000 with a width of 1600",
    remedy="check that the camera belongs to images of this size (not to a crop or a scaled copy)",
)
def principal_point_outside(scene: RawScene, usable_cameras: dict[int, Camera]) -> Iterator[Hit]:
    """The principal point is outside the image."""
    for camera in usable_cameras.values():
        cx, cy = camera.K[0, 2], camera.K[1, 2]
        if not (0 <= cx <= camera.width and 0 <= cy <= camera.height):
            expected = f"a principal point within {camera.width} x {camera.height}"
            yield Hit(scene.camera_place(camera), expected, f"({cx:.5g}, {cy:.5g})")


@rule.info(
    "CS137",
    bad="`cameras.bin` has cameras 1 and 2, but all images have camera 1",
    remedy="nothing to do, unless images are missing from the model",
)
def camera_unused(scene: RawScene, cameras: Sequence[Camera], images: RawImages) -> Iterator[Hit]:
    """A camera is not used by any image."""
    used = set(images.camera_ids.tolist())
    if not used or not used <= {camera.camera_id for camera in cameras}:
        return  # cameras and images do not belong together, which has its own rule
    for camera in cameras:
        if camera.camera_id not in used:
            yield Hit(scene.camera_place(camera), "images of this camera", "none")


def _polynomial(scene: RawScene) -> list[Camera]:
    """Usable cameras of polynomial models."""
    return [c for c in scene.usable_cameras.values() if c.model in POLYNOMIAL_MODELS]


def displacement(camera: Camera) -> float:
    """Largest distance in pixels by which distortion moves a pixel on the image border."""
    along = np.linspace(0.0, 1.0, 65)
    edges = [(along, 0 * along), (along, 0 * along + 1), (0 * along, along), (0 * along + 1, along)]
    pixels = np.concatenate(edges, axis=1).T * [camera.width, camera.height]
    rays = np.ones((len(pixels), 3))
    rays[:, :2] = unproject_pixels(as_pinhole(camera), pixels)
    shift = np.linalg.norm(project_points(camera, rays) - pixels, axis=1)
    return float(shift.max()) if np.isfinite(shift).all() else float("inf")


@rule.error(
    "CS141",
    bad="`frames.bin` without `rigs.bin`",
    remedy="copy the missing file, or delete the other one: without both, each image is its own "
    "frame",
)
def rigs_partial(scene: RawScene, model: RawModel) -> Iterator[Hit]:
    """Only one of the files `rigs` and `frames`, which belong together, is present."""
    form = _form(model)
    present = [s for s in ("rigs", "frames") if (model.folder / f"{s}{form}").is_file()]
    if len(present) == 1:
        missing = "frames" if present == ["rigs"] else "rigs"
        place = f"{scene.model_place or '.'}/{missing}{form}"
        yield Hit(place, f"the file that belongs to {present[0]}{form}", "no such file")


@rule.error(
    "CS143",
    bad="poses transformed in `images.bin` only, with `frames.bin` left as it was",
    remedy="write the model again with COLMAP, or delete rigs and frames if the poses in images "
    "are right",
)
def rig_pose_differs(scene: RawScene, model: RawModel, images: RawImages) -> Iterator[Hit]:
    """The pose of an image in `images` differs from the pose given by its frame and rig. COLMAP
    reads the frames, older readers read the images, so they see two different scenes."""
    raw = model.rigs
    if raw is None or not len(images):
        return
    row = {image_id: i for i, image_id in enumerate(images.ids.tolist())}
    good = good_poses(images)
    triples = [
        (row[image_id], pose, frame.rig_from_world)
        for frame in raw.frames
        for sensor, image_id in frame.data
        if sensor[0] == CAMERA
        and (pose := raw.rigs.get(frame.rig_id, {}).get(sensor)) is not None
        and good[row.get(image_id, -1)]
        and image_id in row
    ]
    if not triples:
        return
    index = np.array([i for i, _, _ in triples])
    stored = pose_matrices(np.column_stack([images.quaternions, images.translations])[index])
    # cam_from_world = cam_from_rig @ rig_from_world
    _, cam_from_rig, rig_from_world = zip(*triples, strict=True)
    composed = pose_matrices(cam_from_rig) @ pose_matrices(rig_from_world)
    turned = np.linalg.norm(stored[:, :3, :3] - composed[:, :3, :3], axis=(1, 2))
    moved = np.linalg.norm(camera_centre(stored) - camera_centre(composed), axis=1)
    extent = float(np.max(np.ptp(scene.centres[good], axis=0)))
    same = (turned <= 2 * SAME_ANGLE) & (moved <= SAME_PLACE * extent + 1e-9)  # not where NaN
    different = [images.names[i] for i in index[~same].tolist()]
    if different:
        found = f"other poses for {counted(len(different), 'image')}: {shown(sorted(different))}"
        place = scene.model_file("images")
        yield Hit(place, "the poses of rigs and frames", found, count=len(different))


def pose_matrices(poses: ArrayLike) -> Array:
    """``[R t; 0 1]`` of poses of 7 numbers each; not finite where the pose is not. [n, 4, 4]"""
    values = np.asarray(poses, np.float64).reshape(-1, 7)
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    matrices[:, :3, :3] = rotation_from_quaternion(values[:, :4])
    matrices[:, :3, 3] = values[:, 4:]
    return matrices


def _form(model: RawModel) -> str:
    """Extension of the model files."""
    return next(iter(model.files.values()))[-4:]
