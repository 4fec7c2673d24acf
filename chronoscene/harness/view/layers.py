"""Sparse points, cameras with photos, and changes, which the browser of one viewer draws itself."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from chronoscene.arrays import Array, Pixels
from chronoscene.errors import ChronoSceneError
from chronoscene.figures.canvas import rgb_of
from chronoscene.figures.change_map import colors_of
from chronoscene.harness.use.changes import ChangeMap
from chronoscene.harness.view.content import EXTENT, Content, vertical_fov
from chronoscene.scene import Frame
from chronoscene.scene.geometry import camera_centre, quaternion_from_rotation

if TYPE_CHECKING:
    import viser

MAX_POINTS, MAX_CAMERAS = 300_000, 300
"""Points of a scene, and cameras of a period, that a browser gets: a choice that is the same for
equal scenes."""
FRUSTUM = 0.12  # Length of a drawn frustum in mean distances between neighbouring cameras
POINT = 0.003 * EXTENT  # Edge of a point, or of a place of a change map
TEST, TRAIN = (255, 193, 36), (76, 134, 255)  # Colours of frusta
CHANGED = (2, 3, 4)  # Classes of a change map that are drawn
ALL = -1  # In place of a period: all of them


class Layers:
    """Objects in the scene of one browser, made at their first use."""

    def __init__(
        self, client: viser.ClientHandle, content: Content, clicked: Callable[[Frame], None]
    ) -> None:
        """Draw nothing yet; ``clicked`` will get the frames whose cameras are clicked."""
        self._client, self._content, self._clicked = client, content, clicked
        self._points: dict[int, viser.PointCloudHandle] = {}
        self._frusta: dict[Frame, viser.CameraFrustumHandle] = {}
        self._changes: viser.PointCloudHandle | None = None
        self._cameras_of: int | None = None
        self._hidden: Frame | None = None
        self._lock = threading.RLock()

    def show_points(self, period: int | None) -> None:
        """Show the points of a period; of `ALL`, in colours of the periods; or of none."""
        with self._lock:
            if period is not None and period not in self._points:
                self._points[period] = self._add_points(period)
            for key, handle in self._points.items():
                handle.visible = key == period

    def _add_points(self, period: int) -> viser.PointCloudHandle:
        cloud = self._content.cloud
        numbers = np.flatnonzero(np.isfinite(cloud.xyz).all(axis=1))
        numbers = np.random.default_rng(0).permutation(numbers)[:MAX_POINTS]
        if period == ALL:
            groups, palette = cloud.groups()
            colors = np.array([*map(rgb_of, palette)]).astype(np.uint8)[groups[numbers]]
        else:
            numbers = numbers[np.isin(cloud.period[numbers], (period, -1))]
            colors = self._content.scene.points.rgb[numbers]
        return self._add_cloud(f"/points/{period}", cloud.xyz[numbers], colors)

    def _add_cloud(self, name: str, xyz: Array, colors: Pixels) -> viser.PointCloudHandle:
        return self._client.scene.add_point_cloud(
            name,
            self._content.view_from_world.apply(xyz).astype(np.float32),
            colors,
            point_size=POINT,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def show_cameras(self, period: int | None) -> None:
        """Show the cameras of a period, or none; `add_photos` adds their photos."""
        with self._lock:
            if period == self._cameras_of:
                return
            for handle in self._frusta.values():
                handle.remove()
            self._frusta, self._cameras_of = {}, period
            scene = self._content.scene
            mine = [i for i, frame in enumerate(scene.frames) if frame.period == period]
            scale = FRUSTUM * EXTENT * np.sqrt(scene.num_periods / len(scene.frames))
            for i in mine[:: -(-len(mine) // MAX_CAMERAS) or 1]:
                frame = scene.frames[i]
                self._frusta[frame] = self._add_frustum(frame, self._content.poses[i], scale)

    def add_photos(self) -> None:
        """Show the photos of the cameras, as long as these are shown."""
        with self._lock:
            shown = [*self._frusta.items()]
        for frame, handle in shown:
            with suppress(ChronoSceneError):  # without its photo, a camera stays empty
                image = None if handle.image is not None else self._content.photos.load(frame)
                with self._lock:
                    if self._frusta.get(frame) is not handle:
                        return
                    if image is not None:
                        handle.image = image

    def _add_frustum(self, frame: Frame, pose: Array, scale: float) -> viser.CameraFrustumHandle:
        handle = self._client.scene.add_camera_frustum(
            f"/cameras/{frame.image_id}",
            fov=vertical_fov(frame),
            aspect=frame.camera.width / frame.camera.height,
            scale=scale,
            thickness=0.02 * scale,
            color=TEST if frame.split == "test" else TRAIN,
            wxyz=quaternion_from_rotation(pose[:3, :3].T),
            position=camera_centre(pose),
            visible=frame is not self._hidden,
        )
        handle.on_click(lambda _: self._clicked(frame))
        return handle

    def hide_camera(self, frame: Frame) -> None:
        """Hide one camera, whose photo would cover its view, and show the others."""
        with self._lock:
            self._hidden = frame
            for key, handle in self._frusta.items():
                handle.visible = key is not frame

    def show_changes(self, made: ChangeMap | None) -> None:
        """Show the changed places of a map, in the colours of their classes, or none."""
        with self._lock:
            if self._changes is not None:
                self._changes.remove()
                self._changes = None
            if made is not None:
                rows = np.isin(made.classes, CHANGED)
                colors = colors_of(made.classes[rows])
                self._changes = self._add_cloud("/changes", made.xyz[rows], colors)
