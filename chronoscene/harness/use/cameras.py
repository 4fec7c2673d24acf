"""Cameras to render a finished run from: of its scene, of files, or on an orbit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.arrays import Array
from chronoscene.colmap.model import read_model
from chronoscene.errors import ConfigError
from chronoscene.formats.shared import transforms
from chronoscene.harness.files.predictions import image_file
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import evaluation_size, resize_camera
from chronoscene.io.documents import json_error, number, read_json_document
from chronoscene.scene import Camera, Scene
from chronoscene.scene.cameras import undistorted_camera
from chronoscene.scene.orbit import orbit
from chronoscene.scene.similarity import Sim3

VIEWS = ("test", "all", "orbit")
"""Cameras that follow from the scene."""

LARGEST_SIDE = 16384
"""Largest width and height of a picture, in pixels."""

FARTHEST = 1e12
"""Largest radius and height of an orbit, in units of the scene: float32 holds no square of much
larger ones."""

NORMALISED = "dataparser_transforms.json"
"""File of nerfstudio with the transform from the world to the frame of a model."""


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """A camera with its pose, and the period to show."""

    name: str
    """File name of the picture, with its folders and extension."""
    camera: Camera
    """Without distortion, at the size to render."""
    cam_from_world: Array
    """In the world of the scene. [4, 4]"""
    period: float | None
    """None if the source of the camera has none."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraSequence:
    """Viewpoints in their order."""

    viewpoints: tuple[Viewpoint, ...]
    is_path: bool
    """True if they are a moving camera."""


@dataclass(frozen=True, slots=True)
class OrbitShape:
    """Size and shape of an orbit where they differ from those of the scene and its cameras."""

    size: tuple[int, int] | None = None
    """Width and height of its pictures in pixels; None for those of the evaluation."""
    radius: float | None = None
    """Level distance from the middle of the points, in units of the scene."""
    height: float | None = None
    """Height above the middle of the points, in units of the scene."""

    def __post_init__(self) -> None:
        if self.size is not None and not all(1 <= side <= LARGEST_SIDE for side in self.size):
            raise ConfigError(
                "--size",
                expected=f"sides from 1 to {LARGEST_SIDE} pixels",
                found="{} x {}".format(*self.size),
                todo="choose another size",
            )


def find_viewpoints(
    source: str,
    run: TrainedRun,
    scene_root: Path | None,
    frames: int,
    shape: OrbitShape | None = None,
) -> CameraSequence:
    """Return the cameras that ``--cameras`` names.

    Args:
        source: One of `VIEWS`, the folder of a COLMAP model, or a camera path of nerfstudio.
        run: Run whose scene and largest image width are used.
        scene_root: Folder of the scene; None if it has not moved.
        frames: Number of pictures of an orbit.
        shape: How an orbit is to differ from what the scene gives.

    Raises:
        ConfigError: If the source is none of these, or has no camera, or is no orbit and has the
            shape of one, or an orbit is too far away.
        SceneError: If the scene or the file is missing, damaged, or of an unknown kind.
    """
    shape = shape or OrbitShape()
    if source != "orbit" and shape != OrbitShape():
        raise ConfigError(
            "--size, --radius, --height",
            expected="--cameras orbit, as other cameras have their own size and place",
            found=f"--cameras {source}",
            todo="leave them out",
        )
    for option, length in (("--radius", shape.radius), ("--height", shape.height)):
        if length is not None and abs(length) > FARTHEST:
            raise ConfigError(
                option,
                expected=f"at most {FARTHEST:g} units of the scene",
                found=f"{length:g}",
                todo="choose a smaller one",
            )
    if source in VIEWS:
        scene = run.scene(scene_root)
        if source == "test" and not scene.select(split="test"):
            raise ConfigError(
                f"--cameras {source}",
                expected="a scene with test views",
                found=f"none in {scene.root}",
                todo="use --cameras all",
            )
        if source == "orbit":
            return _around(run, scene, frames, shape)
        return _of_scene(run, scene, source)
    path = Path(source)
    if path.is_dir():
        return _of_model(run, path)
    if path.is_file():
        return _of_path(run, path)
    raise ConfigError(
        f"--cameras {source}",
        expected=f"{', '.join(VIEWS)}, the folder of a COLMAP model or a camera path of nerfstudio",
        found="no such file or folder",
        todo="correct the path",
    )


def with_periods(
    cameras: CameraSequence, run: TrainedRun, periods: tuple[float, ...], frames: int
) -> tuple[Viewpoint, ...]:
    """Return the cameras at the periods asked for.

    Args:
        cameras: A moving camera passes through a range of periods on its way; any other camera
            shows the whole range.
        run: The run to render.
        periods: Empty, so that each camera shows its own; one; or both ends of a range.
        frames: Number of pictures of a range.

    Raises:
        ConfigError: If no period is given and a camera has none.
    """
    if not periods:
        if any(viewpoint.period is None for viewpoint in cameras.viewpoints):
            raise ConfigError(
                "--period",
                expected="a period, or a range FROM:TO, as these cameras have none",
                found="none",
                todo="add it",
            )
        return cameras.viewpoints
    if cameras.is_path:
        along = _range(run, periods, len(cameras.viewpoints))
        return tuple(
            replace(viewpoint, period=p)
            for viewpoint, p in zip(cameras.viewpoints, along, strict=True)
        )
    if len(periods) == 1:
        return tuple(replace(viewpoint, period=periods[0]) for viewpoint in cameras.viewpoints)
    along = _range(run, periods, frames)
    return tuple(
        replace(viewpoint, name=f"{Path(viewpoint.name).with_suffix('')}/{i:04}.png", period=period)
        for viewpoint in cameras.viewpoints
        for i, period in enumerate(along)
    )


def _range(run: TrainedRun, periods: tuple[float, ...], count: int) -> Iterable[float]:
    """Return periods from the first to the last; whole ones if nothing is between.

    Each whole one has an equal share, or, of too few pictures, the first and the last have one.
    """
    start, end = periods[0], periods[-1]
    if run.is_continuous:
        return np.linspace(start, end, count).tolist()
    step = 1 if end >= start else -1
    whole = np.arange(start, end + step, step)
    if count < len(whole):
        return whole[np.linspace(0, len(whole) - 1, count).round().astype(int)].tolist()
    return whole[np.arange(count) * len(whole) // count].tolist()


def _of_scene(run: TrainedRun, scene: Scene, split: str) -> CameraSequence:
    store = run.photos(scene)
    frames = scene.frames if split == "all" else scene.select(split="test")
    viewpoints = (
        Viewpoint(image_file(f.name), store.camera(f), f.cam_from_world, float(f.period))
        for f in frames
    )
    return CameraSequence(tuple(viewpoints), is_path=False)


def _around(run: TrainedRun, scene: Scene, frames: int, shape: OrbitShape) -> CameraSequence:
    camera = run.photos(scene).camera(scene.frames[0])
    if shape.size is not None:
        width, height = shape.size  # with the same horizontal field of view
        camera = _centred(width, height, camera.K[0, 0] * width / camera.width)
    poses, points = scene.frame_poses, scene.points.xyz
    path = orbit(poses, points, frames, radius=shape.radius, height=shape.height)
    return CameraSequence(
        tuple(Viewpoint(_numbered(i), camera, p, None) for i, p in enumerate(path)), True
    )


def _centred(width: int, height: int, focal: float) -> Camera:
    """Return a camera that looks at the middle of its image."""
    return Camera(1, "SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))


def _numbered(i: int) -> str:
    return f"{i:04}.png"


def _of_model(run: TrainedRun, folder: Path) -> CameraSequence:
    viewpoints = []
    for image in read_model(folder).images:
        camera = image.camera if image.camera.is_pinhole else undistorted_camera(image.camera)
        size = evaluation_size(*camera.size, run.record.max_width)
        camera = resize_camera(camera, *size)
        viewpoints.append(Viewpoint(image_file(image.name), camera, image.cam_from_world, None))
    if not viewpoints:
        raise ConfigError(
            f"--cameras {folder}",
            expected="a model with images",
            found="none",
            todo="name another folder",
        )
    return CameraSequence(tuple(viewpoints), is_path=False)


def _of_path(run: TrainedRun, path: Path) -> CameraSequence:
    """Read a camera path that nerfstudio's viewer exported."""
    data = read_json_document(path)
    kind = data.get("camera_type", "perspective")
    if kind != "perspective":
        raise json_error(path, "perspective cameras", repr(kind), "export the path again")
    listed = data.get("camera_path")
    if not isinstance(listed, list) or not listed or not all(isinstance(c, dict) for c in listed):
        raise json_error(path, "a list of cameras as camera_path", "none")
    size = _side(path, data, "render_width"), _side(path, data, "render_height")
    world_from_file = _world_from_file(path.with_name(NORMALISED))
    viewpoints = []
    for i, item in enumerate(listed):
        place = f"{path}: camera_path[{i}]"
        camera = _camera(place, item, *size)
        values = item.get("camera_to_world")
        if isinstance(values, list) and len(values) == 16:  # row by row
            values = np.reshape(np.array(values, object), (4, 4)).tolist()
        pose = transforms.pose_from_opengl(place, transforms.matrix(place, values))
        time = number(place, item, "render_time")
        # Rounded: of 23 periods, that of number 15 is at 15 / 22, and 15 / 22 * 22 is not 15.
        period = None if time is None else round(time * (run.num_periods - 1), 6)
        viewpoints.append(
            Viewpoint(_numbered(i), camera, world_from_file.apply_to_pose(pose), period)
        )
    return CameraSequence(tuple(viewpoints), is_path=True)


def _side(path: Path, data: Mapping[str, Any], key: str) -> int:
    value = number(path, data, key)
    if value is None or not 1 <= value <= LARGEST_SIDE or value != int(value):
        raise json_error(path, f"{key} in whole pixels", repr(data.get(key))[:40])
    return int(value)


def _camera(place: str, item: Mapping[str, Any], width: int, height: int) -> Camera:
    """Return the camera of a vertical field of view in degrees."""
    fov = number(place, item, "fov")
    if fov is None or not 0 < fov < 180:
        raise json_error(place, "a fov between 0 and 180 degrees", repr(item.get("fov"))[:40])
    return _centred(width, height, height / 2 / math.tan(math.radians(fov) / 2))


def _world_from_file(path: Path) -> Sim3:
    """Return the transform from the frame of a nerfstudio model; identity without a file."""
    if not path.is_file():
        return Sim3.identity()
    data = read_json_document(path)
    matrix = transforms.matrix(f"{path}: transform", data.get("transform"), (3, 4))
    scale = number(path, data, "scale")
    if scale is None or scale <= 0:
        raise json_error(path, "a positive scale", repr(data.get("scale"))[:40])
    rotation = transforms.nearest_rotation(f"{path}: transform", matrix[:3, :3])
    return Sim3(scale, rotation, scale * matrix[:3, 3]).inverse()
