"""Scenes without distortion: images resampled to PINHOLE cameras, observations moved along.

pycolmap chooses the cameras and knows the models; the pixels are interpolated here, bicubically, so
that one step does what is to be done: undistortion, and the crop that centres the principal point.
Images whose camera does not change are copied byte for byte.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.colmap import project_points, undistorted_camera, unproject_pixels
from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.colmap_layout import filter_observations
from chronoscene.formats.writing import Progress, place_image, staged_folder
from chronoscene.images import image_size, load_rgb, resize_camera
from chronoscene.scene import Camera, Frame, Points, Scene
from chronoscene.threads import available_threads
from chronoscene.warp import warp

JPEG_QUALITY = 95

ROWS = 128
"""Rows of a map that are computed at once, to bound the memory."""

LARGEST_SIDE = 65535
"""Pixels; what a JPEG file can hold. A camera that needs more is a mistake."""

WRITABLE = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")

_METADATA_FORMATS = (".png", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True, slots=True)
class CameraChange:
    """A camera before and after, for images of one size."""

    source: Camera
    """At the size of the image files."""
    target: Camera

    @property
    def is_copy(self) -> bool:
        """Whether pixels stay as they are."""
        same_size = (self.source.width, self.source.height) == (
            self.target.width,
            self.target.height,
        )
        same_K = np.array_equal(self.source.K, self.target.K)
        return self.source.is_pinhole and same_size and same_K


@dataclass(frozen=True, slots=True, eq=False)
class Undistortion:
    """What was done to a scene."""

    scene: Scene
    """The new scene."""
    changes: tuple[CameraChange, ...]
    observations_lost: int
    """Observations outside of the new images."""
    points_lost: int
    """Points whose last observation was lost."""


def undistort(
    scene: Scene,
    out: Path,
    *,
    center: bool = False,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Undistortion:
    """Write a scene in the ChronoScene format whose cameras are all PINHOLE.

    Poses, periods and split stay. Where a file has another size than its camera, the camera is
    scaled to the file first.

    Args:
        scene: Any scene.
        out: Folder that does not exist yet, or is empty.
        center: Crop the images so that the principal point is in their centre.
        threads: Images that are worked on at the same time; None for one per processor.
        progress: Called after each image.

    Raises:
        SceneError: If ``out`` is in use, an image is damaged, or a camera cannot be undistorted.
    """
    for frame in scene.frames:
        our_format.check_writable_name(out, frame)
        _check_extension(scene.image_path(frame))
    changes = plan_cameras(scene, center=center)
    new, observations_lost, points_lost = move_observations(scene, changes)
    with staged_folder(out) as staged:
        our_format.write_texts(new, staged)
        _write_images(scene, staged / "images", changes, threads, progress)
    distinct = tuple(dict.fromkeys(changes))
    done = replace(new, root=out, images_root=out / "images", format=our_format.NAME)
    return Undistortion(done, distinct, observations_lost, points_lost)


def _check_extension(path: Path) -> None:
    if path.suffix.lower() not in WRITABLE:
        raise SceneError(
            path,
            expected=f"an image file that can be written: {', '.join(WRITABLE)}",
            found=repr(path.suffix),
            todo="convert the images first",
        )


def plan_cameras(scene: Scene, *, center: bool = False) -> list[CameraChange]:
    """New camera of each frame; images of one camera and one size share it."""
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
    """The PINHOLE camera for the images of a camera.

    Raises:
        SceneError: If there is none: not perspective, or no principal point inside to centre.
    """
    if camera.is_pinhole:
        K = camera.K
        params = (K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item())
        camera = replace(camera, model="PINHOLE", params=params)
    else:
        camera = undistorted_camera(camera)
    if center:
        camera = _centred(camera)
    if max(camera.width, camera.height) > LARGEST_SIDE:
        raise _camera_error(camera, f"at most {LARGEST_SIDE} pixels a side")
    return camera


def _centred(camera: Camera) -> Camera:
    """The largest image inside of the camera's that has the principal point in its centre."""
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
    """The scene with its new cameras and observations.

    Returns:
        The scene, the number of observations that are outside of the new images and were dropped,
        and the number of points that lost all of theirs and were dropped too.
    """
    points = scene.points
    xy, inside = np.empty_like(points.track_xy), np.zeros(len(points.track_xy), bool)
    order = np.argsort(points.track_frame, kind="stable")
    ends = np.searchsorted(points.track_frame[order], np.arange(len(scene.frames) + 1))
    frames: list[Frame] = []
    for i, (frame, change) in enumerate(zip(scene.frames, changes, strict=True)):
        mine = order[ends[i] : ends[i + 1]]
        size = np.array([frame.camera.width, frame.camera.height])
        file_size = np.array([change.source.width, change.source.height])
        xy[mine] = move_pixels(change, points.track_xy[mine] * (file_size / size))
        limits = np.array([change.target.width, change.target.height])
        inside[mine] = ((xy[mine] >= 0) & (xy[mine] <= limits)).all(axis=1)
        frames.append(replace(frame, camera=change.target))
    moved = filter_observations(
        replace(points, track_xy=xy), inside, np.arange(len(frames), dtype=np.int32)
    )
    lost = (np.diff(points.track_start) > 0) & (np.diff(moved.track_start) == 0)
    new = replace(scene.with_frames(frames), points=_drop_unobserved(moved, lost))
    return new, int((~inside).sum()), int(lost.sum())


def _drop_unobserved(points: Points, drop: NDArray[np.bool_]) -> Points:
    """Points without some that have no observations."""
    keep = ~drop
    return replace(
        points,
        ids=points.ids[keep],
        xyz=points.xyz[keep],
        rgb=points.rgb[keep],
        error=points.error[keep],
        track_start=np.append(points.track_start[:-1][keep], points.track_start[-1]),
    )


def move_pixels(change: CameraChange, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where pixels of the old image are in the new one; NaN where nowhere. [N, 2] -> [N, 2]"""
    if change.is_copy or not len(xy):
        return xy
    fx, fy, cx, cy = change.target.params
    if change.source.is_pinhole:  # exact, whatever the model
        K = change.source.K
        rays = (xy - K[:2, 2]) / K[[0, 1], [0, 1]]
    else:
        rays = unproject_pixels(change.source, xy)
    return rays * [fx, fy] + [cx, cy]


@lru_cache(maxsize=4)
def sampling_map(change: CameraChange) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixel of the old image under each centre of the new one, x and y. [H, W] each"""
    source, target = change.source, change.target
    fx, fy, cx, cy = target.params
    maps = np.empty((2, target.height, target.width), np.float32)
    x = (np.arange(target.width) + 0.5 - cx) / fx
    for first in range(0, target.height, ROWS):
        rows = np.arange(first, min(first + ROWS, target.height))
        y = (rows + 0.5 - cy) / fy
        rays = np.ones((len(rows), len(x), 3))
        rays[..., 0], rays[..., 1] = x, y[:, None]
        pixels = project_points(source, rays.reshape(-1, 3)).reshape(len(rows), len(x), 2)
        maps[:, rows] = np.moveaxis(pixels, -1, 0)
    return maps[0], maps[1]


def undistort_pixels(rgb: NDArray[np.uint8], change: CameraChange) -> NDArray[np.uint8]:
    """Resample an image to the new camera. [H, W, 3] -> [H', W', 3]"""
    return warp(rgb, *sampling_map(change))


def _write_images(
    scene: Scene,
    root: Path,
    changes: list[CameraChange],
    threads: int | None,
    progress: Progress | None,
) -> None:
    """Write all images; those of one camera after each other, so that its map is made once."""
    order = sorted(range(len(changes)), key=lambda i: changes[i].target.camera_id)
    tasks = [(scene.frames[i], changes[i]) for i in order]
    pool = ThreadPoolExecutor(threads or available_threads())
    try:
        results: Iterator[Any] = pool.map(lambda task: _write_image(scene, root, *task), tasks)
        for done, _ in enumerate(results, start=1):
            if progress is not None:
                progress(done, len(tasks))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        sampling_map.cache_clear()


def _write_image(scene: Scene, root: Path, frame: Frame, change: CameraChange) -> None:
    source, target = scene.image_path(frame), root / frame.name
    if change.is_copy:
        place_image(source, target, "copy")
        return
    pixels = undistort_pixels(load_rgb(source), change)
    target.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {}
    suffix = target.suffix.lower()
    if suffix in (".jpg", ".jpeg"):
        options = {"quality": JPEG_QUALITY, "subsampling": 0}
    elif suffix == ".webp":
        options = {"lossless": True}
    if suffix in _METADATA_FORMATS:
        options |= _metadata(source)
    Image.fromarray(pixels).save(target, **options)


def _metadata(path: Path) -> dict[str, bytes]:
    """EXIF block and colour profile as they are: dates of capture are in the first."""
    with Image.open(path) as image:
        blocks = {key: image.info.get(key) for key in ("exif", "icc_profile")}
    return {key: block for key, block in blocks.items() if isinstance(block, bytes)}
