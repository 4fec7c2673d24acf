"""CS13: intrinsics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.cameras import PINHOLE_MODELS, POLYNOMIAL_MODELS, Camera
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

VISIBLE = 0.5
"""Pixels; distortion that moves nothing by as much may be dropped instead of undone."""

WIDEST, NARROWEST = 150.0, 1.0
"""Degrees of view across the width that a pinhole photo may plausibly have."""

UNEQUAL = 0.1
"""Relative difference of fx and fy; pixels are square to a few percent in any camera."""

UNDISTORT = "undistort the images and the model: chronoscene undistort SCENE OUT"
DROP = "write the camera as PINHOLE or SIMPLE_PINHOLE; its distortion is below half a pixel"


@rule(
    "CS131",
    "camera-unusable",
    "error",
    what="A camera has no size, an absurd size, or a focal length that is not positive and finite.",
    remedy="correct the camera",
    bad="`1 PINHOLE 640 480 -500 500 320 240`",
    needs=("cameras",),
)
def camera_unusable(scene: RawScene) -> Iterator[Hit]:
    for camera in _cameras(scene):
        if not camera.is_usable:
            expected = "a plausible size, positive focal lengths and finite parameters"
            params = ", ".join(f"{p:g}" for p in camera.params)
            found = f"{camera.width} x {camera.height}, parameters {params}"
            yield Hit(_place(scene, camera), expected, found)


@rule(
    "CS132",
    "camera-model",
    "error",
    what="A camera model is none that a pinhole can stand for.",
    remedy=UNDISTORT,
    bad="`OPENCV_FISHEYE`",
    needs=("cameras",),
)
def camera_model(scene: RawScene) -> Iterator[Hit]:
    for camera in _cameras(scene):
        if camera.model not in (*PINHOLE_MODELS, *POLYNOMIAL_MODELS):
            yield Hit(_place(scene, camera), "PINHOLE or SIMPLE_PINHOLE", camera.model)


@rule(
    "CS133",
    "camera-distorted",
    "error",
    what="A camera has distortion, which methods cannot train with. Benchmarks refuse it.",
    remedy=UNDISTORT,
    bad="`SIMPLE_RADIAL` with k = -0.16",
    needs=("cameras",),
)
def camera_distorted(scene: RawScene) -> Iterator[Hit]:
    for camera in _polynomial(scene):
        if not camera.is_pinhole:
            shift = displacement(camera)
            found = f"{camera.model} whose distortion moves pixels by up to {shift:.3g} px"
            remedy = DROP if shift < VISIBLE else None
            yield Hit(_place(scene, camera), "a camera without distortion", found, remedy)


@rule(
    "CS134",
    "zero-distortion",
    "info",
    what="A camera has a model with distortion whose parameters are all zero. It is used as the "
    "pinhole that it is; other readers may go by the name of the model.",
    remedy="nothing to do here; write it as PINHOLE or SIMPLE_PINHOLE for other readers",
    bad="`SIMPLE_RADIAL` with k = 0",
    needs=("cameras",),
)
def zero_distortion(scene: RawScene) -> Iterator[Hit]:
    for camera in _polynomial(scene):
        if camera.is_pinhole:
            found = f"{camera.model} without distortion"
            yield Hit(_place(scene, camera), "PINHOLE or SIMPLE_PINHOLE", found)


@rule(
    "CS135",
    "implausible-focal",
    "warning",
    what="The focal length gives a field of view, or pixels, that no ordinary camera has.",
    remedy="check that focal length and image size are of the same image, and in pixels",
    bad="f = 35 (millimetres) with a width of 4000 pixels",
    needs=("cameras",),
)
def implausible_focal(scene: RawScene) -> Iterator[Hit]:
    for camera in scene.usable_cameras.values():
        fx, fy = camera.K[0, 0], camera.K[1, 1]
        angle = np.degrees(2 * np.arctan(camera.width / (2 * fx)))
        if not NARROWEST <= angle <= WIDEST:
            found = f"{angle:.3g} degrees (f = {fx:.4g}, width {camera.width})"
            expected = f"a field of view of {NARROWEST:g} to {WIDEST:g} degrees"
            yield Hit(_place(scene, camera), expected, found)
        if abs(fx - fy) > UNEQUAL * max(fx, fy):
            found = f"fx = {fx:.4g}, fy = {fy:.4g}"
            yield Hit(_place(scene, camera), "nearly equal focal lengths", found)


@rule(
    "CS136",
    "principal-point-outside",
    "warning",
    what="The principal point is outside of the image.",
    remedy="check that the camera belongs to the images at this size (not to a crop or a copy)",
    bad="cx = 2000 with a width of 1600",
    needs=("cameras",),
)
def principal_point_outside(scene: RawScene) -> Iterator[Hit]:
    for camera in scene.usable_cameras.values():
        cx, cy = camera.K[0, 2], camera.K[1, 2]
        if not (0 <= cx <= camera.width and 0 <= cy <= camera.height):
            expected = f"a principal point within {camera.width} x {camera.height}"
            yield Hit(_place(scene, camera), expected, f"({cx:.5g}, {cy:.5g})")


@rule(
    "CS137",
    "camera-unused",
    "info",
    what="No image uses a camera.",
    remedy="nothing to do, unless images are missing from the model",
    bad="`cameras.bin` has cameras 1 and 2, all images have camera 1",
    needs=("cameras", "images"),
)
def camera_unused(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    used = set(scene.images.camera_ids.tolist())
    if not used or not used <= {camera.camera_id for camera in _cameras(scene)}:
        return  # cameras and images do not belong together, which is an error of its own
    for camera in _cameras(scene):
        if camera.camera_id not in used:
            yield Hit(_place(scene, camera), "images of this camera", "none")


def displacement(camera: Camera) -> float:
    """Largest distance in pixels by which the distortion moves a pixel on the image's border.

    Source: Brown's model as in COLMAP and OpenCV, with the rational factor of FULL_OPENCV.
    """
    along = np.linspace(0.0, 1.0, 65)
    edges = [(along, 0 * along), (along, 0 * along + 1), (0 * along, along), (0 * along + 1, along)]
    u, v = np.concatenate(edges, axis=1) * [[camera.width], [camera.height]]
    K = camera.K
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    with np.errstate(all="ignore"):
        moved_x, moved_y = _distort(camera, x, y)
        shift = np.hypot((moved_x - x) * K[0, 0], (moved_y - y) * K[1, 1])
    return float(shift.max()) if np.isfinite(shift).all() else float("inf")


def _distort(
    camera: Camera, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    k1, k2, p1, p2, k3, k4, k5, k6 = _brown(camera)
    r2 = x * x + y * y
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    factor = above / below
    return (
        x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _brown(camera: Camera) -> Sequence[float]:
    """k1, k2, p1, p2, k3, k4, k5, k6 of a polynomial model."""
    given = camera.distortion
    return (*given, *(0.0,) * (8 - len(given)))


def _polynomial(scene: RawScene) -> list[Camera]:
    """Usable cameras of polynomial models."""
    return [c for c in scene.usable_cameras.values() if c.model in POLYNOMIAL_MODELS]


def _cameras(scene: RawScene) -> Sequence[Camera]:
    assert scene.cameras is not None
    return scene.cameras


def _place(scene: RawScene, camera: Camera) -> str:
    return f"{scene.model_file('cameras')} (camera {camera.camera_id})"
