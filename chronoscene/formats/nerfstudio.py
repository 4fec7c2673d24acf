"""nerfstudio and instant-ngp: ``transforms.json``, with the period as an extra key of each frame.

- A frame's ``period`` (0..T-1) decides; else the distinct values of its ``time``; else all
  frames are of one period. Readers of the format ignore keys that they do not know.
- Frames whose image is missing are left out: the fox of instant-ngp comes with such frames.
- Frames in ``test_filenames`` or ``val_filenames`` are test images. Frames that are in no list are
  left out where there is a ``train_filenames``, as nerfstudio does.
- ``applied_transform`` and ``applied_scale`` are what was done to the original world; both are
  undone, so scenes are in the original world. ``ply_file_path`` is in the world of the file.
  Without the first, and with the model in ``colmap/sparse/0``, the axes were swapped as old
  versions did it.
- The ``mask_path`` of a frame is its mask, black where pixels are ignored.
- nerfstudio's own centring and scaling of poses are not applied: they belong to training.

Source: the data parser of ``nerfstudio-project/nerfstudio``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.colmap.model import PosedImage
from chronoscene.errors import SceneError
from chronoscene.formats.chronoscene import MAX_COORDINATE, MAX_PERIODS, check_name
from chronoscene.formats.matrixcity import is_raw
from chronoscene.formats.shared import grouping, transforms
from chronoscene.formats.shared.json_values import (
    parse_periods,
    parse_world,
    period_items,
    world_item,
)
from chronoscene.formats.shared.ply import read_points, write_points
from chronoscene.formats.shared.transforms import CameraTable
from chronoscene.images.masks import mask_place
from chronoscene.images.store import ImageSource, Progress, place_images
from chronoscene.io.documents import json_error, number, read_json_document
from chronoscene.io.staging import staged_folder
from chronoscene.io.wording import counted
from chronoscene.scene import Camera, Period, Points, Scene, WorldFrame
from chronoscene.scene.cameras import way_to_pinhole
from chronoscene.scene.similarity import Sim3
from chronoscene.scene.splits import DEFAULT_RULE, default_tests

NAME = "nerfstudio"
FILE = "transforms.json"
MARKS = FILE  # What `matches` looks for
POINTS = "sparse_points.ply"  # Where points are written to

FISHEYE = "OPENCV_FISHEYE"

PERIOD_BY = ("period", "time", "gap:X", "count:N", "table:FILE")
"""The key ``period`` or ``time``, groups of times, or a CSV file with columns file and period."""

COLMAP = "colmap/sparse/0"
"""The model that a file without ``applied_transform`` was made from, in old versions."""

HISTORICAL = ((0, 1, 0, 0), (1, 0, 0, 0), (0, 0, -1, 0))
"""The undocumented change of axes that these versions applied to the world of that model."""


def matches(path: Path) -> bool:
    """Return True if a folder has a ``transforms.json`` that is not a raw file of MatrixCity."""
    place = path / FILE
    if (path / "sparse/split.txt").exists() or not place.is_file():
        return False
    return not is_raw(place)


@dataclass(frozen=True, slots=True)
class _Document:
    """A ``transforms.json``."""

    root: Path
    """The scene folder."""
    data: dict[str, Any]
    frames: dict[str, dict[str, Any]]
    """Keys of each frame by the path of its image below the scene folder."""
    places: dict[str, str]
    """Place of each frame, for messages."""

    @property
    def place(self) -> Path:
        return self.root / FILE


def read(path: Path, *, period_by: str | None = None) -> Scene:
    """Read a scene."""
    file = _read_document(path)
    images, tests, rule = _apply_lists(file, _read_images(file))
    grouped = _group(file, [image.name for image in images], period_by)
    scene = transforms.make_scene(
        file.root,
        images,
        grouped,
        default_tests(grouped[0]) if tests is None else tests,
        points=_read_points(file),
        rule=rule,
        format=NAME,
    )
    world = file.data.get("world")
    return replace(
        _to_original(file, scene),
        world=parse_world(file.place, world) if isinstance(world, dict) else WorldFrame(),
        masks=_find_masks(file, scene),
    )


def remarks(path: Path) -> list[str]:
    """List the content that does not become part of a scene."""
    file = _read_document(path)
    depths = sum("depth_file_path" in frame for frame in file.frames.values())
    found = [f"depth maps of {depths} frames are not read"] if depths else []
    if "fisheye_crop_radius" in file.data:
        found.append("fisheye_crop_radius is not read: the border of the images is kept")
    if (path / COLMAP).is_dir():
        if "applied_transform" not in file.data:
            found.append(
                f"there is no applied_transform and a model in {COLMAP}: the swap of axes that old "
                "versions of nerfstudio made is undone"
            )
        found.append(f"{COLMAP} is not read, which has observations of points")
    images = _read_images(file)
    if missing := len(file.frames) - len(images):
        found.append(f"{counted(missing, 'frame')} left out: no image")
    if unlisted := len(images) - len(_apply_lists(file, images)[0]):
        found.append(f"{counted(unlisted, 'frame')} left out: in no list")
    return found


def _read_document(root: Path) -> _Document:
    data = read_json_document(root / FILE)
    file = _Document(root, data, {}, {})
    for i, frame in enumerate(transforms.read_frames(file.place, data)):
        place = f"{file.place}: frames[{i}]"
        name = transforms.image_name(place, root, "", frame.get("file_path"))
        if name in file.frames:
            raise json_error(file.place, "each image once", f"{name!r} twice")
        file.frames[name], file.places[name] = frame, place
    return file


def _find_masks(file: _Document, scene: Scene) -> dict[str, Path]:
    """Return the mask of each frame that names one."""
    masks = {}
    for frame in scene.frames:
        name = scene.image_path(frame).relative_to(file.root).as_posix()
        if "mask_path" in file.frames[name]:
            place = f"{file.places[name]}: mask_path"
            mask = file.root / transforms.file_name(place, "", file.frames[name]["mask_path"])
            if not mask.is_file():
                raise SceneError(mask, expected="a mask", found="nothing", todo="copy it there")
            masks[frame.name] = mask
    return masks


def _read_images(file: _Document) -> list[PosedImage]:
    """Read the frames whose image is there, of which there must be one."""
    cameras, shared, images = CameraTable(), transforms.shared_keys(file.data), []
    for name, frame in file.frames.items():
        path, place = file.root / name, file.places[name]
        if not os.path.isfile(path):
            continue
        world_from_cam = transforms.matrix(place, frame.get("transform_matrix"), (3, 4))
        camera = cameras.camera(place, transforms.frame_keys(shared, frame), path)
        pose = transforms.pose_from_opengl(place, world_from_cam)
        image_id = frame.get("colmap_im_id")
        images.append(PosedImage(image_id if type(image_id) is int else 0, name, camera, pose))
    if not images:
        first = file.root / next(iter(file.frames))
        raise SceneError(first, expected="an image", found="nothing", todo="copy the images there")
    return images


def _apply_lists(
    file: _Document, images: list[PosedImage]
) -> tuple[list[PosedImage], set[str] | None, str]:
    """Return the images that are used, the test images (None for the default), and the rule."""
    train, val, test = (_names(file, f"{key}_filenames") for key in ("train", "val", "test"))
    if train is None and val is None and test is None:
        return images, None, DEFAULT_RULE
    tests = (val or set()) | (test or set())
    if train is not None:
        if both := sorted(train & tests):
            found = repr(both[0])
            raise json_error(file.place, "train and test lists without common names", found)
        images = [image for image in images if image.name in train | tests]
        if not images:
            raise json_error(file.place, "frames that are in the lists of names", "none")
    return images, tests, "the lists of file names in transforms.json"


def _names(file: _Document, key: str) -> set[str] | None:
    names, place = file.data.get(key), f"{file.place}: {key}"
    if names is None:
        return None
    if not isinstance(names, list):
        raise json_error(place, "a list", type(names).__name__)
    found = {transforms.image_name(place, file.root, "", name) for name in names}
    if lost := sorted(found.difference(file.frames)):
        raise json_error(place, "names of frames", repr(lost[0]), "correct the list")
    return found


def _group(file: _Document, names: list[str], by: str | None) -> grouping.Grouped:
    """Group images into periods by the keys of their frames, or by the rule of the option."""
    frames, place = {name: file.frames[name] for name in names}, file.place
    if by is None:
        keys = (key for key in ("period", "time") if any(key in f for f in frames.values()))
        by = next(keys, None)
        if by is None:
            return dict.fromkeys(frames, 0), (Period(0, "0"),)
    if by.startswith(grouping.TABLE):
        return grouping.group_by_table(sorted(frames), Path(by.removeprefix(grouping.TABLE)))
    if by == "period":
        return _group_by_ids(file, frames)
    if by == "time" or by.startswith(("gap:", "count:")):
        times = {name: _time(f"{place}: {name}", frame) for name, frame in frames.items()}
        distinct = len(set(times.values()))
        if by == "time" and distinct > max(1, len(times) // 2):
            expected = "times that the frames of a period share"
            found = f"{distinct} times of {len(times)} frames"
            todo = f"group them: {grouping.OPTION} count:N or gap:X"
            raise json_error(place, expected, found, todo)
        return grouping.group_times(times, f"count:{distinct}" if by == "time" else by)
    raise grouping.rule_error(by, PERIOD_BY)


def _time(place: str, frame: Mapping[str, Any]) -> float:
    time = number(place, frame, "time")
    if time is None:
        raise json_error(place, "a time of every frame", "none")
    return time


def _group_by_ids(file: _Document, frames: Mapping[str, Mapping[str, Any]]) -> grouping.Grouped:
    ids: dict[str, int] = {}
    for name, frame in frames.items():
        period = frame.get("period")
        if type(period) is not int or not 0 <= period < MAX_PERIODS:
            raise json_error(f"{file.place}: {name}", "a period 0, 1, ...", repr(period)[:40])
        ids[name] = period
    used = sorted(set(ids.values()))
    if used != list(range(len(used))):
        raise json_error(file.place, f"periods 0..{len(used) - 1} without gaps", str(used)[:60])
    table = file.data.get("periods")
    if isinstance(table, list):
        return ids, parse_periods(file.place, table, len(used))
    return ids, tuple(Period(i, str(i)) for i in used)


def _read_points(file: _Document) -> Points:
    name = file.data.get("ply_file_path")
    if name is None:
        return Points.empty()
    return read_points(file.root / transforms.file_name(f"{file.place}: ply_file_path", "", name))


def _to_original(file: _Document, scene: Scene) -> Scene:
    """Undo ``applied_transform`` and ``applied_scale``."""
    place = file.place
    scale = number(place, file.data, "applied_scale")
    applied = file.data.get("applied_transform")
    if applied is None and (file.root / COLMAP).is_dir():
        applied = HISTORICAL
    if scale is None and applied is None:
        return scene
    scale = 1.0 if scale is None else scale
    if not 1 / MAX_COORDINATE < scale < MAX_COORDINATE:
        raise json_error(place, "a positive applied_scale", f"{scale:g}")
    matrix_place, full = f"{place}: applied_transform", np.eye(4)
    if applied is not None:
        full = transforms.matrix(matrix_place, applied, (3, 4))
    rotation = transforms.nearest_rotation(matrix_place, full[:3, :3])
    original_from_file = Sim3(scale, rotation, scale * full[:3, 3]).inverse()
    frames = [
        replace(f, cam_from_world=original_from_file.apply_to_pose(f.cam_from_world))
        for f in scene.frames
    ]
    points = replace(scene.points, xyz=original_from_file.apply(scene.points.xyz))
    return replace(scene.with_frames(frames), points=points)


def write(
    scene: Scene, out: Path, *, image_source: ImageSource = "copy", progress: Progress | None = None
) -> Path:
    """Write a scene in this format.

    Each frame has its ``period``, and ``time`` = period / (T - 1) for loaders of dynamic scenes.
    Labels, dates and the world frame go to the extra keys ``periods`` and ``world``. Tracks and ids
    of points have no place in this format.
    """
    for frame in scene.frames:
        check_name(out, frame.name)
        if "\\" in frame.name:
            raise SceneError(
                out,
                expected="image names without backslashes, which are slashes in this format",
                found=repr(frame.name),
                todo="rename the image (chronoscene edit SCENE OUT --rename OLD=NEW)",
            )
    finite = scene.points.finite
    if not finite.all():
        scene = replace(scene, points=scene.points.select(finite))
    text = json.dumps(_to_json(scene), indent=1, ensure_ascii=False) + "\n"
    with staged_folder(out) as staged:
        (staged / FILE).write_text(text, encoding="utf-8", newline="\n")
        if len(scene.points):
            write_points(staged / POINTS, scene.points)
        place_images(scene, staged / "images", image_source=image_source, progress=progress)
    return out


def losses(scene: Scene) -> list[str]:
    """List the content of a scene that this format cannot hold."""
    lost = []
    if len(scene.points.track_frame):
        lost.append("the observations of points, their ids and errors")
    if count := int((~scene.points.finite).sum()):
        lost.append(f"{count} points that are not finite")
    if len({frame.camera.model == FISHEYE for frame in scene.frames}) > 1:
        lost.append(f"{FISHEYE} beside other cameras, as its loader uses one kind for all frames")
    if 0 < len(scene.masks) < len(scene.frames):
        lost.append("masks of some frames only, as its loader wants one for each or for none")
    return lost


def _to_json(scene: Scene) -> dict[str, Any]:
    tests = [f"images/{f.name}" for f in scene.frames if f.split == "test"]
    models = sorted({_camera_keys(frame.camera)["camera_model"] for frame in scene.frames})
    return {
        "camera_model": models[0],  # all that the loader asks is whether they are fisheyes
        **({"ply_file_path": POINTS} if len(scene.points) else {}),
        "train_filenames": [f"images/{f.name}" for f in scene.frames if f.split == "train"],
        "val_filenames": tests,
        "test_filenames": tests,
        "periods": period_items(scene.periods),
        "world": world_item(scene.world),
        "frames": [
            {
                "file_path": f"images/{frame.name}",
                "transform_matrix": transforms.opengl_from_pose(frame.cam_from_world).tolist(),
                "colmap_im_id": frame.image_id,
                "period": frame.period,
                "time": frame.period / max(1, scene.num_periods - 1),
                **_camera_keys(frame.camera),
                **({"mask_path": mask_place(frame.name)} if frame.name in scene.masks else {}),
            }
            for frame in scene.frames
        ],
    }


def _camera_keys(camera: Camera) -> dict[str, Any]:
    model, keys = camera.model, transforms.MODEL_KEYS.get(camera.model)
    if model == "FULL_OPENCV" and not any(camera.distortion[5:]):
        model, keys = "OPENCV", (*transforms.MODEL_KEYS["OPENCV"], "k3")
    if keys is None:
        raise SceneError(
            f"camera {camera.camera_id}",
            expected=f"a camera model that nerfstudio has: {', '.join(transforms.MODEL_KEYS)}",
            found=model,
            todo=f"{way_to_pinhole(camera)} first",
        )
    K = camera.K
    return {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": K[0, 0].item(),
        "fl_y": K[1, 1].item(),
        "cx": K[0, 2].item(),
        "cy": K[1, 2].item(),
        **dict(zip(keys, camera.distortion, strict=False)),
    }
