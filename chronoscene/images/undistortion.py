"""Cameras without distortion, positions of pixels in their images, and these images.

They are resampled with the cubic filter of Catmull and Rom, which reproduces straight lines and
parabolas, so nothing moves. OpenCV's cubic filter (another constant, places rounded to 1/32 pixel)
moved points of light by 0.05 pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import SceneError
from chronoscene.images.decoding import image_size
from chronoscene.images.store import resize_camera
from chronoscene.kernels.compilation import inner, kernel
from chronoscene.scene import Camera, Frame, Scene
from chronoscene.scene.cameras import (
    as_pinhole,
    project_points,
    undistorted_camera,
    unproject_pixels,
)
from chronoscene.scene.tracks import by_image

ROWS = 128  # Rows of a map that are computed at once, to bound the memory
MAX_JPEG_SIDE = 65535  # Pixels; a camera that needs more than a JPEG file can hold is a mistake

MAX_ROUND_TRIP_ERROR = 0.01
"""Pixels between an observation and the projection of its ray; beyond, the ray is wrong."""


@dataclass(frozen=True, slots=True)
class CameraChange:
    """A camera before and after, for images of one size."""

    source: Camera
    """At the size of the image files."""
    target: Camera

    @property
    def is_copy(self) -> bool:
        """True if pixels stay as they are."""
        same_size = self.source.size == self.target.size
        same_K = np.array_equal(self.source.K, self.target.K)
        return self.source.is_pinhole and same_size and same_K


def plan_cameras(scene: Scene, *, center: bool = False) -> list[CameraChange]:
    """Plan the new camera of each frame; images of one camera and one size share it."""
    targets: dict[tuple[Camera, int, int], CameraChange] = {}
    used: set[int] = set()
    spare = 1 + max((f.camera.camera_id for f in scene.frames), default=0)
    changes = []
    for frame in scene.frames:
        size = image_size(scene.image_path(frame))
        key = (frame.camera, *size)
        if key not in targets:
            camera_id = frame.camera.camera_id
            if camera_id in used:
                camera_id, spare = spare, spare + 1
            used.add(camera_id)
            source = resize_camera(frame.camera, *size)
            target = replace(pinhole_camera(source, center=center), camera_id=camera_id)
            targets[key] = CameraChange(source, target)
        changes.append(targets[key])
    return changes


def pinhole_camera(camera: Camera, *, center: bool = False) -> Camera:
    """Return the PINHOLE camera for the images of a camera.

    Raises:
        SceneError: If the camera is not perspective, or its principal point is not in the image.
    """
    camera = as_pinhole(camera) if camera.is_pinhole else undistorted_camera(camera)
    if not np.isfinite(camera.params).all():
        raise _camera_error(camera, "a camera that can be undistorted")
    if center:
        camera = _centred(camera)
    if max(camera.width, camera.height) > MAX_JPEG_SIDE:
        raise _camera_error(camera, f"at most {MAX_JPEG_SIDE} pixels a side")
    return camera


def _centred(camera: Camera) -> Camera:
    """Crop a camera to the largest image with the principal point in its centre."""
    fx, fy, cx, cy = camera.params
    width = 2 * math.floor(min(cx, camera.width - cx))
    height = 2 * math.floor(min(cy, camera.height - cy))
    if min(width, height) < 2:
        raise _camera_error(camera, "a principal point inside the image")
    return replace(camera, width=width, height=height, params=(fx, fy, width / 2, height / 2))


def _camera_error(camera: Camera, expected: str) -> SceneError:
    found = f"{camera.width} x {camera.height}, {tuple(round(p, 3) for p in camera.params)}"
    return SceneError(
        f"camera {camera.camera_id}", expected=expected, found=found, todo="correct the camera"
    )


def move_observations(scene: Scene, changes: list[CameraChange]) -> tuple[Scene, int, int]:
    """Move the observations of a scene to its new cameras.

    Returns:
        The scene, the number of observations dropped because they are outside the new images, and
        the number of points dropped because they lost all their observations.
    """
    points = scene.points
    xy, inside = np.empty_like(points.track_xy), np.zeros(len(points.track_xy), bool)
    rows_of = by_image(points.track_frame, len(scene.frames))
    frames: list[Frame] = []
    for frame, change, mine in zip(scene.frames, changes, rows_of, strict=True):
        ratio = np.divide(change.source.size, frame.camera.size)
        xy[mine] = move_pixels(change, points.track_xy[mine] * ratio)
        inside[mine] = ((xy[mine] >= 0) & (xy[mine] <= change.target.size)).all(axis=1)
        frames.append(replace(frame, camera=change.target))
    rank = np.arange(len(frames), dtype=np.int32)
    moved = replace(points, track_xy=xy).select_observations(inside, rank)
    lost = (np.diff(points.track_start) > 0) & (np.diff(moved.track_start) == 0)
    new = replace(scene.with_frames(frames), points=moved.select(~lost))
    return new, int((~inside).sum()), int(lost.sum())


def move_pixels(change: CameraChange, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move pixels of the old image to the new one; NaN if outside. [N, 2] -> [N, 2]"""
    if change.is_copy or not len(xy):
        return xy
    rays = unproject_pixels(change.source, xy)
    if not change.source.is_pinhole:
        # COLMAP iterates, and returns a result even beyond the field of view of the model, where
        # there is no such ray; the projection of that result is not the pixel.
        again = project_points(change.source, np.column_stack([rays, np.ones(len(rays))]))
        rays[~(np.abs(again - xy).max(axis=1) < MAX_ROUND_TRIP_ERROR)] = np.nan
    fx, fy, cx, cy = change.target.params
    return rays * [fx, fy] + [cx, cy]


@lru_cache(maxsize=4)
def sampling_map(change: CameraChange) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the pixel of the old image at each centre of the new one, x and y. [H, W] each"""
    source, target = change.source, change.target
    fx, fy, cx, cy = target.params
    maps = np.empty((2, target.height, target.width), np.float32)
    with np.errstate(over="ignore"):  # absurd cameras: what has no place becomes infinite
        x = (np.arange(target.width) + 0.5 - cx) / fx
        for first in range(0, target.height, ROWS):
            rows = np.arange(first, min(first + ROWS, target.height))
            rays = np.ones((len(rows), len(x), 3))
            rays[..., 0], rays[..., 1] = x, ((rows + 0.5 - cy) / fy)[:, None]
            pixels = project_points(source, rays.reshape(-1, 3)).reshape(len(rows), len(x), 2)
            maps[:, rows] = np.moveaxis(pixels, -1, 0)
    return maps[0], maps[1]


@inner
def _weights(t: float, out: NDArray[np.float64]) -> None:
    """Compute weights of four neighbours at a share ``t`` of the way between the middle two."""
    out[0] = t * (-0.5 + t * (1.0 - 0.5 * t))
    out[1] = 1.0 + t * t * (-2.5 + 1.5 * t)
    out[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    out[3] = t * t * (-0.5 + 0.5 * t)


@kernel
def _warp(
    image: NDArray[np.uint8], x: NDArray[np.float32], y: NDArray[np.float32], out: NDArray[np.uint8]
) -> None:
    height, width, channels = image.shape
    wx, wy = np.empty(4), np.empty(4)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            u, v = x[row, column] - 0.5, y[row, column] - 0.5
            if not (math.isfinite(u) and math.isfinite(v)):
                out[row, column] = 0
                continue
            u, v = min(max(u, -2.0), width + 1.0), min(max(v, -2.0), height + 1.0)
            left, top = math.floor(u), math.floor(v)
            _weights(u - left, wx)
            _weights(v - top, wy)
            for channel in range(channels):
                total = 0.0
                for i in range(4):
                    source_row = min(max(top + i - 1, 0), height - 1)
                    line = 0.0
                    for j in range(4):
                        source_column = min(max(left + j - 1, 0), width - 1)
                        line += wx[j] * image[source_row, source_column, channel]
                    total += wy[i] * line
                out[row, column, channel] = min(max(math.floor(total + 0.5), 0), 255)


def warp(
    image: NDArray[np.uint8], x: NDArray[np.float32], y: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Resample an image; releases the interpreter's lock.

    Args:
        image: [H, W, C]
        x: Column in pixels to look at; pixel 0 is centred at 0.5. [H', W']
        y: Row. [H', W']

    Returns:
        Pixels beyond the border repeat it; black where a place is not finite. [H', W', C]
    """
    out = np.empty((*x.shape, image.shape[2]), np.uint8)
    _warp(np.ascontiguousarray(image), x, y, out)
    return out


def warp_mask(
    mask: NDArray[np.bool_], x: NDArray[np.float32], y: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Warp a mask as `warp` does an image: a pixel counts if all sixteen that it comes from do.

    Args:
        mask: Where it counts before. [H, W]
        x: As for `warp`. [H', W']
        y: As for `warp`. [H', W']
    """
    import cv2

    height, width = mask.shape
    counts = cv2.erode(mask.astype(np.uint8), np.ones((4, 4), np.uint8), anchor=(1, 1)) != 0
    finite = np.isfinite(x) & np.isfinite(y)
    column, row = (np.floor(np.where(finite, p, 0.0) - 0.5) for p in (x, y))
    column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
    return np.asarray(counts[row.astype(int), column.astype(int)] & finite)
