"""The writer of `chronoscene.formats.nerfstudio`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import SceneError
from chronoscene.formats.chronoscene import check_name
from chronoscene.formats.shared.json_values import period_items, world_item
from chronoscene.formats.shared.ply import write_points
from chronoscene.formats.shared.transforms import MODEL_KEYS, opengl_from_pose
from chronoscene.formats.shared.writing import ImageSource, Progress, place_images
from chronoscene.io.staging import staged_folder
from chronoscene.scene import Camera, Points, Scene

FILE = "transforms.json"

POINTS = "sparse_points.ply"

FISHEYE = "OPENCV_FISHEYE"


def write(
    scene: Scene,
    out: Path,
    *,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
) -> Path:
    """Write a scene in this format; the folder appears complete or not at all.

    Each frame has its ``period``, and ``time`` = period / (T - 1) for loaders of dynamic scenes.
    Labels, dates and the world frame go to the extra keys ``periods`` and ``world``. Tracks and ids
    of points have no place in this format.

    Raises:
        SceneError: If ``out`` is in use, an image is missing, or the format lacks a camera model.
    """
    out = Path(out)
    for frame in scene.frames:
        check_name(out, frame.name)
    finite = _finite(scene.points)
    if not finite.all():
        scene = replace(scene, points=scene.points.select(finite))
    text = json.dumps(_document(scene), indent=1, ensure_ascii=False) + "\n"
    with staged_folder(out) as staged:
        (staged / FILE).write_text(text, encoding="utf-8", newline="\n")
        if len(scene.points):
            write_points(staged / POINTS, scene.points)
        place_images(scene, staged / "images", image_source=image_source, progress=progress)
    return out


def losses(scene: Scene) -> list[str]:
    """What a scene has that this format cannot hold."""
    lost = []
    if len(scene.points.track_frame):
        lost.append("the observations of points, their ids and errors")
    if count := int((~_finite(scene.points)).sum()):
        lost.append(f"{count} points that are not finite")
    if len({frame.camera.model == FISHEYE for frame in scene.frames}) > 1:
        lost.append(f"{FISHEYE} beside other cameras, as its loader takes one kind for all frames")
    return lost


def _finite(points: Points) -> NDArray[np.bool_]:
    """Which points a cloud can hold. [P]"""
    return np.asarray(np.isfinite(points.xyz).all(axis=1))


def _document(scene: Scene) -> dict[str, Any]:
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
                "transform_matrix": opengl_from_pose(frame.cam_from_world).tolist(),
                "colmap_im_id": frame.image_id,
                "period": frame.period,
                "time": frame.period / max(1, scene.num_periods - 1),
                **_camera_keys(frame.camera),
            }
            for frame in scene.frames
        ],
    }


def _camera_keys(camera: Camera) -> dict[str, Any]:
    model, keys = camera.model, MODEL_KEYS.get(camera.model)
    if model == "FULL_OPENCV" and not any(camera.distortion[5:]):
        model, keys = "OPENCV", (*MODEL_KEYS["OPENCV"], "k3")
    if keys is None:
        raise SceneError(
            f"camera {camera.camera_id}",
            expected=f"a camera model that nerfstudio has: {', '.join(MODEL_KEYS)}",
            found=model,
            todo="run chronoscene undistort first",
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
