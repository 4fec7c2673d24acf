"""Cameras: COLMAP's models, intrinsics, projection.

The camera frame has +x right, +y down, +z forward. Pixels are counted from the top left corner of
the image, so pixel (0, 0) is centred at (0.5, 0.5). A pinhole is a few multiplications here;
distortion is left to pycolmap, which is loaded only for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import SceneError

if TYPE_CHECKING:
    from chronoscene.io.pycolmap import pycolmap


class CameraModel(NamedTuple):
    """One of COLMAP's camera models."""

    params: tuple[str, ...]
    """Names of the parameters in COLMAP's order: focal lengths, principal point, distortion."""
    kind: Literal["pinhole", "polynomial", "fisheye", "other"]
    """``polynomial`` models are a pinhole where all their distortion parameters are zero."""
    two_focals: str | None = None
    """For a model with one focal length, the model with fx and fy that extends it."""

    @property
    def num_focals(self) -> int:
        return sum(name in ("f", "fx", "fy") for name in self.params)

    @property
    def distortion(self) -> tuple[str, ...]:
        """Names of the parameters after focal lengths and principal point."""
        return self.params[self.num_focals + 2 :]


def _model(params: str, kind: str, two_focals: str | None = None) -> CameraModel:
    return CameraModel(tuple(params.split()), kind, two_focals)  # type: ignore[arg-type]


CAMERA_MODELS = {
    "SIMPLE_PINHOLE": _model("f cx cy", "pinhole", "PINHOLE"),
    "PINHOLE": _model("fx fy cx cy", "pinhole"),
    "SIMPLE_RADIAL": _model("f cx cy k1", "polynomial", "OPENCV"),
    "RADIAL": _model("f cx cy k1 k2", "polynomial", "OPENCV"),
    "OPENCV": _model("fx fy cx cy k1 k2 p1 p2", "polynomial"),
    "OPENCV_FISHEYE": _model("fx fy cx cy k1 k2 k3 k4", "fisheye"),
    "FULL_OPENCV": _model("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "polynomial"),
    "FOV": _model("fx fy cx cy omega", "other"),
    "SIMPLE_RADIAL_FISHEYE": _model("f cx cy k1", "fisheye", "OPENCV_FISHEYE"),
    "RADIAL_FISHEYE": _model("f cx cy k1 k2", "fisheye", "OPENCV_FISHEYE"),
    "THIN_PRISM_FISHEYE": _model("fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1", "fisheye"),
    "RAD_TAN_THIN_PRISM_FISHEYE": _model(
        "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3", "fisheye"
    ),
    "SIMPLE_DIVISION": _model("f cx cy k", "other", "DIVISION"),
    "DIVISION": _model("fx fy cx cy k", "other"),
    "SIMPLE_FISHEYE": _model("f cx cy", "fisheye", "FISHEYE"),
    "FISHEYE": _model("fx fy cx cy", "fisheye"),
    "EUCM": _model("fx fy cx cy alpha beta", "other"),
    "EQUIRECTANGULAR": _model("w h", "other"),
}
"""COLMAP's camera models in the order of their ids, 0 to 17."""

MODEL_NAMES = tuple(CAMERA_MODELS)  # Name of a camera model by its id

PINHOLE_MODELS = tuple(name for name, m in CAMERA_MODELS.items() if m.kind == "pinhole")
"""Camera models without distortion."""

POLYNOMIAL_MODELS = tuple(name for name, m in CAMERA_MODELS.items() if m.kind == "polynomial")
"""Camera models that are a pinhole where all their distortion parameters are zero."""

MAX_SIDE = 1_000_000  # Pixels; beyond any image


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics as COLMAP stores them. Units are pixels of an image of ``width`` x ``height``."""

    camera_id: int
    model: str
    """COLMAP model name, ``PINHOLE`` for example."""
    width: int
    height: int
    params: tuple[float, ...]
    """In COLMAP's order: ``f, cx, cy, ...`` or ``fx, fy, cx, cy, ...``."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    @property
    def K(self) -> Array:
        """Calibration matrix with unequal fx, fy and the principal point kept. [3, 3]"""
        single_focal = CAMERA_MODELS[self.model].num_focals == 1
        fx, fy, cx, cy = (self.params[0], *self.params[:3]) if single_focal else self.params[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> tuple[float, ...]:
        """Parameters after focal lengths and principal point."""
        return self.params[CAMERA_MODELS[self.model].num_focals + 2 :]

    @property
    def is_pinhole(self) -> bool:
        """True if a pinhole projection describes the camera exactly: methods train on these."""
        if self.model in POLYNOMIAL_MODELS:
            return not any(self.distortion)
        return self.model in PINHOLE_MODELS

    @property
    def is_usable(self) -> bool:
        """True if size and parameters are plausible and finite, focal lengths positive."""
        if not (1 <= self.width <= MAX_SIDE and 1 <= self.height <= MAX_SIDE):
            return False
        if len(self.params) != len(CAMERA_MODELS[self.model].params):
            return False
        if not np.isfinite(self.params).all():
            return False
        return self.model == "EQUIRECTANGULAR" or bool((self.K[[0, 1], [0, 1]] > 0).all())


def as_pinhole(camera: Camera) -> Camera:
    """Convert a camera without distortion to a PINHOLE."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    return replace(camera, model="PINHOLE", params=(fx, fy, cx, cy))


def way_to_pinhole(camera: Camera, arguments: str = "") -> str:
    """Advice on a camera with distortion; ``arguments``: of the command that it may name."""
    if camera.model == "EQUIRECTANGULAR":  # `undistorted_camera` refuses it
        return "render perspective views of the panoramas, and register those"
    return f"run chronoscene undistort {arguments}".rstrip()


def project_points(camera: Camera, xyz: Array) -> Array:
    """Project points to pixels, distortion included.

    Args:
        camera: Any model of COLMAP.
        xyz: In the camera frame, in any memory order (columns that are contiguous are quicker).
            [N, 3]

    Returns:
        NaN for points that are not in front of the camera. [N, 2]
    """
    x, y, z = xyz.T
    if camera.is_pinhole:
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        pixels = np.empty((2, len(z)))
        with np.errstate(all="ignore"):  # absurd points become infinite
            z = np.where(z > 0, z, np.nan)
            pixels[0] = x / z * fx + cx
            pixels[1] = y / z * fy + cy
        return pixels.T
    seen = (z > 0) & np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    pixels = np.full((len(z), 2), np.nan)
    pixels[seen] = to_pycolmap(camera).img_from_cam(np.ascontiguousarray(xyz[seen], np.float64))
    return pixels


def unproject_pixels(camera: Camera, xy: Array) -> Array:
    """Find points at depth 1 that a camera sees at pixels, distortion undone. [N, 2] -> [N, 2]

    NaN where COLMAP finds no ray. Its search may also return a point beyond the field of view of
    the model, which does not project to the pixel.
    """
    if camera.is_pinhole:
        K = camera.K
        with np.errstate(all="ignore"):  # absurd cameras: what has no place becomes infinite
            return np.asarray((xy - K[:2, 2]) / K[[0, 1], [0, 1]])
    return np.asarray(to_pycolmap(camera).cam_from_img(np.ascontiguousarray(xy, np.float64)))


def undistorted_camera(camera: Camera) -> Camera:
    """Return the PINHOLE camera of COLMAP's undistorter for these images, with the same id.

    Its size is the largest for which no pixel is blank.

    Raises:
        SceneError: If COLMAP cannot undistort the model.
    """
    from chronoscene.io.pycolmap import pycolmap  # slow to load

    try:
        options = pycolmap.UndistortCameraOptions()
        result = from_pycolmap(pycolmap.undistort_camera(options, to_pycolmap(camera)))
    except (ValueError, RuntimeError) as error:
        raise SceneError(
            f"camera {camera.camera_id}",
            expected="a perspective camera that COLMAP can undistort",
            found=f"{camera.model} {camera.params}",
            todo="render perspective views first, or correct the camera",
        ) from error
    return replace(result, camera_id=camera.camera_id)


def to_pycolmap(camera: Camera) -> pycolmap.Camera:
    """Convert a camera to a pycolmap object."""
    from chronoscene.io.pycolmap import pycolmap  # slow to load

    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
    )


def from_pycolmap(camera: pycolmap.Camera) -> Camera:
    """Convert a pycolmap object to our record."""
    return Camera(
        camera_id=int(camera.camera_id),
        model=camera.model.name,
        width=int(camera.width),
        height=int(camera.height),
        params=tuple(float(p) for p in camera.params),
    )
