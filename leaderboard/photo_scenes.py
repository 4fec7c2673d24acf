"""Registered models of photos that may not be passed on, which make a scene with the photos.

What COLMAP computes depends on the processor in its last bits; a stored model does not. It has
cameras, poses, periods, points and which photos see them. Pixels of observations are left out, as
no method reads them: a point is taken to be seen where it projects to.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.io.staging import replacing
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.scene.cameras import project_points
from chronoscene.scene.tracks import by_image, track_owners
from chronoscene.undistort import undistort

MODELS = Path(__file__).with_name("models")
"""Stored models, by the names of their scenes."""


def save_model(scene: Scene, path: Path) -> None:
    """Write the model of a scene whose photos share a camera, which may have distortion."""
    (camera,) = {frame.camera for frame in scene.frames}
    points = scene.points
    about = {
        "camera": [camera.model, camera.width, camera.height, *camera.params],
        "frames": [[f.name, f.period, f.split] for f in scene.frames],
        "periods": [[p.label, p.date] for p in scene.periods],
        "split_rule": scene.split_rule,
    }
    with replacing(path) as staged, staged.open("wb") as file:
        np.savez_compressed(
            file,
            about=np.frombuffer(json.dumps(about).encode(), np.uint8),
            poses=scene.frame_poses,
            xyz=points.xyz.astype(np.float32),
            rgb=points.rgb,
            seen_by=np.diff(points.track_start).astype(np.uint16),
            track_frame=points.track_frame.astype(np.uint16),
        )


def make_scene(path: Path, photos: Path, out: Path) -> None:
    """Undistort photos with a stored model of them.

    Args:
        path: File of `save_model`.
        photos: Their folder; names are below it.
        out: The scene to write.

    Raises:
        SceneError: If a photo is missing, or ``out`` is in use.
    """
    undistort(_with_photos(path, photos, out.name), out, threads=1)


def _with_photos(path: Path, photos: Path, name: str) -> Scene:
    with np.load(path, allow_pickle=False) as file:
        about = json.loads(file["about"].tobytes())
        poses, xyz, rgb = file["poses"], file["xyz"].astype(np.float64), file["rgb"]
        seen_by, track_frame = file["seen_by"], file["track_frame"].astype(np.int32)
    model, width, height, *params = about["camera"]
    camera = Camera(1, model, width, height, tuple(params))
    frames = tuple(
        Frame(file_name, number, camera, pose, period, split)
        for number, (pose, (file_name, period, split)) in enumerate(
            zip(poses, about["frames"], strict=True), start=1
        )
    )
    for frame in frames:
        if not (photos / frame.name).is_file():
            raise SceneError(
                photos / frame.name,
                expected=f"a photo of {name}",
                found="no such file",
                todo="correct --photos",
            )
    start = np.concatenate([[0], np.cumsum(seen_by.astype(np.int64))])
    owner = track_owners(start)
    pixels = np.empty((len(track_frame), 2))
    for frame, rows in zip(frames, by_image(track_frame, len(frames)), strict=True):
        rotation, shift = frame.cam_from_world[:3, :3], frame.cam_from_world[:3, 3]
        pixels[rows] = project_points(camera, xyz[owner[rows]] @ rotation.T + shift)
    return Scene(
        name=name,
        root=photos,
        images_root=photos,
        frames=frames,
        points=Points(
            ids=np.arange(1, len(xyz) + 1),
            xyz=xyz,
            rgb=rgb,
            error=np.zeros(len(xyz)),
            track_start=start,
            track_frame=track_frame,
            track_xy=pixels,
        ),
        periods=tuple(Period(i, label, date) for i, (label, date) in enumerate(about["periods"])),
        split_rule=about["split_rule"],
        format=our_format.NAME,
    )
