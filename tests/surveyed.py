"""A plane with a box that is built later, seen by photos whose depth is known exactly."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from PIL import Image

from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.harness.use.changes import back_project
from chronoscene.methods import Prediction
from chronoscene.scene import Camera, Frame, Period, Points, Scene, WorldFrame
from chronoscene.scene.geometry import camera_centre, look_at
from chronoscene.scene.similarity import Sim3

LOW, HIGH = np.array([2.0, -1.0, 0.0]), np.array([6.0, 4.0, 3.0])
"""Corners of the box of period 1: 4 x 5 x 3 m, off the middle in both directions."""
CAMERA = Camera(1, "PINHOLE", 96, 72, (80.0, 80.0, 48.0, 36.0))
GROUND, ROOF = np.array([0.2, 0.5, 0.3]), np.array([0.8, 0.2, 0.1])


def render(camera, cam_from_world, period, *, to_scene=lambda xyz: xyz, noise=0.0):
    """Cast rays at the plane and the box, in a world that ``to_scene`` maps to theirs."""
    centre = camera_centre(cam_from_world)
    ones = np.ones((camera.height, camera.width))
    rays = back_project(ones, Viewpoint("", camera, cam_from_world, period))
    centre, rays = to_scene(centre[None])[0], to_scene(rays) - to_scene(centre[None])
    depth = -centre[2] / np.where(rays[:, 2] < 0, rays[:, 2], np.nan)
    if period >= 1:
        with np.errstate(divide="ignore"):
            limits = (np.stack([LOW, HIGH]) - centre)[:, None] / rays
        enter, leave = limits.min(axis=0).max(axis=1), limits.max(axis=0).min(axis=1)
        depth = np.where(enter < leave, enter, depth)
    xyz = centre + depth[:, None] * rays
    roof = (xyz[:, 2] > 0.01)[:, None]
    if noise:
        depth += np.random.default_rng(camera.width + int(period)).normal(0, noise, len(depth))
    shape = camera.height, camera.width
    rgb = np.where(roof, ROOF, GROUND).reshape(*shape, 3).astype(np.float32)
    depth = np.nan_to_num(depth).reshape(shape).astype(np.float32)
    return Prediction(rgb, alpha=(depth > 0).astype(np.float32), depth=depth)


def make_scene(root=Path("scene"), world=None):
    """16 photos a period from 40 m around the middle, and points on the ground."""
    frames = []
    for period in (0, 1):
        for k in range(16):
            angle = 2 * np.pi * k / 16
            eye = np.array([12 * np.cos(angle), 12 * np.sin(angle), 40.0])
            pose = look_at(eye, np.array([1.0, 1.0, 0.0]))
            name = f"{period}/{k:02}.png"
            frames.append(Frame(name, len(frames) + 1, CAMERA, pose, period, "train"))
    east, north = np.meshgrid(np.arange(-9, 10.0), np.arange(-7, 8.0))
    xyz = np.stack([east, north, np.zeros_like(east)], axis=-1).reshape(-1, 3)
    xyz[::50, 2] = 3.0
    count = len(xyz)
    frames_of = np.repeat(np.arange(count) % 2 * 16, 3) + np.tile([0, 5, 10], count)
    points = Points(
        ids=np.arange(1, count + 1),
        xyz=xyz,
        rgb=np.full((count, 3), 100, np.uint8),
        error=np.zeros(count),
        track_start=np.arange(count + 1) * 3,
        track_frame=frames_of.astype(np.int32),
        track_xy=np.zeros((3 * count, 2)),
    )
    return Scene(
        "site", root, root, tuple(frames), points, (Period(0, "before"), Period(1, "after")),
        "all", "memory", world or WorldFrame("metre"),
    )  # fmt: skip


def write_photos(scene):
    """Write a black photo of each frame."""
    for frame in scene.frames:
        path = scene.image_path(frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", frame.camera.size).save(path)


class ToyRun:
    """A stand-in for a `TrainedRun` that renders the plane and the box."""

    def __init__(self, scene=None, *, noise=0.0, uses_period=True):
        self.found, self.noise, self.distinguishes_periods = scene, noise, uses_period
        self.num_periods, self.folder = 2, Path("run")
        self.record = SimpleNamespace(max_width=1600, label="site: toy", strategy="pooled")
        self.spec, self.config = SimpleNamespace(title="Toy"), SimpleNamespace()

    def render(self, camera, cam_from_world, period):
        return render(camera, cam_from_world, period, noise=self.noise)

    def scene(self, root):
        return self.found


def moved(scene, shift, **world):
    """The scene in a world whose origin is elsewhere."""
    move = Sim3(1.0, np.eye(3), np.asarray(shift))
    frames = tuple(
        replace(f, cam_from_world=move.apply_to_pose(f.cam_from_world)) for f in scene.frames
    )
    points = replace(scene.points, xyz=move.apply(scene.points.xyz))
    return replace(scene, frames=frames, points=points, world=WorldFrame("metre", **world))
