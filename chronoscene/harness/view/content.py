"""Scene and runs that all viewers share, in the frame in which the browser sees them."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from chronoscene.arrays import Array
from chronoscene.figures.cloud import cloud_of
from chronoscene.harness.use.change_scores import map_pair
from chronoscene.harness.use.changes import ChangeMap, Render
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.scene import Frame, Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.orbit import find_up, orbit
from chronoscene.scene.similarity import Sim3

EXTENT = 10.0
"""Distance within which cameras and most points are, in the frame of the browser. Its depth maps
end at 168, and its numbers are of single precision."""
STEP_BACK = 1.5
"""Distance of the first view in that of the cameras, which are then in it. Runs are shown from
where the cameras are: they are trained for that."""
PHOTO_WIDTH = 240  # Pixels of a photo in the browser


class Content:
    """A scene, and the runs of it that are rendered."""

    def __init__(self, scene: Scene, runs: Sequence[TrainedRun] = (), summary: str = "") -> None:
        """Find the frame of the browser; ``summary`` is Markdown that is shown with the scene."""
        self.scene, self.runs, self.summary = scene, runs, summary
        self.cloud = cloud_of(scene)
        """Points and camera centres in the world, and labels of the periods."""
        self.photos = ImageStore(scene, max_width=PHOTO_WIDTH, memory_limit=2**28)
        self._maps: dict[tuple[TrainedRun, tuple[int, int]], ChangeMap] = {}
        self._lock = threading.Lock()
        centres, points = self.cloud.centres, self.cloud.xyz
        middle = centres.mean(axis=0)
        radius = np.linalg.norm(centres - middle, axis=1).max()
        if len(points):
            radius = max(radius, np.nanpercentile(np.linalg.norm(points - middle, axis=1), 90))
        scale = EXTENT / max(float(radius), 1e-9)
        self.view_from_world = Sim3(scale, np.eye(3), -scale * middle)
        """Transform to the frame of the browser, whose axes are those of the world."""
        self.poses = self.view_from_world.apply_to_pose(scene.frame_poses)
        """Cameras in the frame of the browser. [C, 4, 4]"""

    def start(self) -> tuple[Array, Array, Array]:
        """Return position, target and up direction of the first view, for the browser. [3] each"""
        points = self.view_from_world.apply(self.cloud.xyz)
        if not len(points):
            points = camera_centre(self.poses) + EXTENT * self.poses[:, 2, :3]
        target = np.nanmedian(points, axis=0)
        eye = camera_centre(orbit(self.poses, points, 1)[0])
        back = 1.0 if self.runs else STEP_BACK
        return target + back * (eye - target), target, find_up(self.poses)

    def changes(self, run: TrainedRun, pair: tuple[int, int], render: Render) -> ChangeMap:
        """Return the change map of a run between two periods, made at its first use.

        Raises:
            ConfigError: If there is nothing to compare.
        """
        with self._lock:
            if (run, pair) not in self._maps:
                self._maps[run, pair] = map_pair(run, self.scene, pair, render=render)
            return self._maps[run, pair]


def vertical_fov(frame: Frame) -> float:
    """Return the vertical field of view of a photo in radians, without its distortion."""
    if frame.camera.model == "EQUIRECTANGULAR":
        return np.pi / 2
    return float(2 * np.arctan(frame.camera.height / 2 / frame.camera.K[1, 1]))
