"""Cameras to render a finished run from: those of its scene, of files, or around it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.bench.files.predictions import image_file
from chronoscene.bench.use.trained_run import TrainedRun
from chronoscene.colmap.model import read_model
from chronoscene.errors import ConfigError
from chronoscene.formats.shared import transforms
from chronoscene.images.store import ImageStore, evaluation_size, resize_camera
from chronoscene.io.documents import json_error, number, read_json_document
from chronoscene.scene import Camera, Scene
from chronoscene.scene.cameras import undistorted_camera
from chronoscene.scene.orbit import orbit
from chronoscene.scene.similarity import Sim3

VIEWS = ("test", "all", "orbit")
"""Cameras that follow from the scene; others are in a file or a folder."""

NORMALISED = "dataparser_transforms.json"
"""What nerfstudio writes beside a model, whose frame is moved, turned and scaled."""


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One picture to take."""

    name: str
    """File name of the picture, with its folders and extension."""
    camera: Camera
    """Without distortion, at the size to render."""
    cam_from_world: NDArray[np.float64]
    """In the world of the scene. [4, 4]"""
    period: float | None
    """None where the source of the camera does not say."""


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """Cameras in their order."""

    shots: tuple[Shot, ...]
    is_path: bool
    """Whether one camera moves; else each stands for itself."""


def find_shots(source: str, run: TrainedRun, scene_root: Path | None, frames: int) -> Shots:
    """The cameras that ``--cameras`` names.

    Args:
        source: One of `VIEWS`, the folder of a COLMAP model, or a camera path of nerfstudio.
        run: Says which scene, and the largest width of images.
        scene_root: Where the scene is now; None where it was.
        frames: Number of pictures of an orbit.

    Raises:
        ConfigError: If the source is none of these, or has no camera.
        SceneError: If the scene or the file is missing, damaged, or of an unknown kind.
    """
    if source in VIEWS:
        scene = run.scene(scene_root)
        if source == "test" and not scene.select(split="test"):
            raise ConfigError(
                f"--cameras {source}",
                expected="a scene with test views",
                found=f"none in {scene.root}",
                todo="use --cameras all",
            )
        return _around(run, scene, frames) if source == "orbit" else _of_scene(run, scene, source)
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
    shots: Shots, run: TrainedRun, periods: tuple[float, ...], frames: int
) -> tuple[Shot, ...]:
    """The same cameras at the periods asked for.

    Args:
        shots: Those of a path go through a range of periods on their way; each of the others shows
            the whole range.
        run: Says whether there is something between two periods.
        periods: Empty, so that each camera shows its own; one; or both ends of a range.
        frames: Number of pictures of a range.

    Raises:
        ConfigError: If no period is given and a camera has none.
    """
    if not periods:
        if any(shot.period is None for shot in shots.shots):
            raise ConfigError(
                "--period",
                expected="a period, or a range FROM:TO, as these cameras have none",
                found="none",
                todo="add it",
            )
        return shots.shots
    if shots.is_path:
        along = _range(run, periods, len(shots.shots))
        return tuple(replace(shot, period=p) for shot, p in zip(shots.shots, along, strict=True))
    if len(periods) == 1:
        return tuple(replace(shot, period=periods[0]) for shot in shots.shots)
    along = _range(run, periods, frames)
    return tuple(
        replace(shot, name=f"{Path(shot.name).with_suffix('')}/{i:04}.png", period=period)
        for shot in shots.shots
        for i, period in enumerate(along)
    )


def _range(run: TrainedRun, periods: tuple[float, ...], count: int) -> Iterable[float]:
    """Periods from the first to the last; each has an equal share where nothing is between."""
    start, end = periods[0], periods[-1]
    if run.is_continuous:
        return np.linspace(start, end, count).tolist()
    step = 1 if end >= start else -1
    whole = np.arange(start, end + step, step)
    return whole[np.arange(count) * len(whole) // count].tolist()


def _of_scene(run: TrainedRun, scene: Scene, split: str) -> Shots:
    store = ImageStore(scene, max_width=run.record.max_width)
    frames = scene.frames if split == "all" else scene.select(split="test")
    shots = (
        Shot(image_file(f.name), store.camera(f), f.cam_from_world, float(f.period)) for f in frames
    )
    return Shots(tuple(shots), is_path=False)


def _around(run: TrainedRun, scene: Scene, frames: int) -> Shots:
    poses = np.stack([frame.cam_from_world for frame in scene.frames])
    camera = ImageStore(scene, max_width=run.record.max_width).camera(scene.frames[0])
    path = orbit(poses, scene.points.xyz, frames)
    return Shots(tuple(Shot(_numbered(i), camera, p, None) for i, p in enumerate(path)), True)


def _numbered(i: int) -> str:
    return f"{i:04}.png"


def _of_model(run: TrainedRun, folder: Path) -> Shots:
    shots = []
    for image in read_model(folder).images:
        camera = image.camera if image.camera.is_pinhole else undistorted_camera(image.camera)
        size = evaluation_size(*camera.size, run.record.max_width)
        camera = resize_camera(camera, *size)
        shots.append(Shot(image_file(image.name), camera, image.cam_from_world, None))
    return Shots(tuple(shots), is_path=False)


def _of_path(run: TrainedRun, path: Path) -> Shots:
    """A camera path as nerfstudio's viewer exports it."""
    data = read_json_document(path)
    kind = data.get("camera_type", "perspective")
    if kind != "perspective":
        raise json_error(path, "perspective cameras", repr(kind), "export the path again")
    listed = data.get("camera_path")
    if not isinstance(listed, list) or not listed or not all(isinstance(c, dict) for c in listed):
        raise json_error(path, "a list of cameras as camera_path", "none")
    size = _side(path, data, "render_width"), _side(path, data, "render_height")
    world_from_file = _world_from_file(path.with_name(NORMALISED))
    shots = []
    for i, item in enumerate(listed):
        place = f"{path}: camera_path[{i}]"
        camera = _camera(place, item, *size)
        values = item.get("camera_to_world")
        if isinstance(values, list) and len(values) == 16:  # row by row
            values = np.reshape(np.array(values, object), (4, 4)).tolist()
        pose = transforms.pose_from_opengl(place, transforms.matrix(place, values))
        time = number(place, item, "render_time")
        period = None if time is None else time * (run.num_periods - 1)
        shots.append(Shot(_numbered(i), camera, world_from_file.apply_to_pose(pose), period))
    return Shots(tuple(shots), is_path=True)


def _side(path: Path, data: Mapping[str, Any], key: str) -> int:
    value = number(path, data, key)
    if value is None or not 1 <= value <= 16384 or value != int(value):
        raise json_error(path, f"{key} in whole pixels", repr(data.get(key))[:40])
    return int(value)


def _camera(place: str, item: Mapping[str, Any], width: int, height: int) -> Camera:
    """The camera of a vertical field of view, which is in degrees."""
    fov = number(place, item, "fov")
    if fov is None or not 0 < fov < 180:
        raise json_error(place, "a fov between 0 and 180 degrees", repr(item.get("fov"))[:40])
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    return Camera(1, "SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))


def _world_from_file(path: Path) -> Sim3:
    """From the frame of a model of nerfstudio to the world; the same where no file tells it."""
    if not path.is_file():
        return Sim3(1.0, np.eye(3), np.zeros(3))
    data = read_json_document(path)
    matrix = transforms.matrix(f"{path}: transform", data.get("transform"), (3, 4))
    scale = number(path, data, "scale")
    if scale is None or scale <= 0:
        raise json_error(path, "a positive scale", repr(data.get("scale"))[:40])
    rotation = transforms.nearest_rotation(f"{path}: transform", matrix[:3, :3])
    return Sim3(scale, rotation, scale * matrix[:3, 3]).inverse()
