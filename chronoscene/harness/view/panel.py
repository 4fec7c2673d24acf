"""One browser: its panel, its camera, and the pictures that it asks for."""

from __future__ import annotations

import math
import threading
from concurrent.futures import CancelledError
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.errors import ChronoSceneError
from chronoscene.figures.canvas import UNSEEN
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.view.content import Content, vertical_fov
from chronoscene.harness.view.layers import ALL, Layers
from chronoscene.harness.view.paths import KeyView, path_file
from chronoscene.harness.view.pictures import Side, color_depth, draw_picture
from chronoscene.harness.view.summary import literal
from chronoscene.harness.view.worker import FULL, RenderWorker
from chronoscene.scene import Frame
from chronoscene.scene.geometry import (
    camera_centre,
    pose_from_rotation_translation,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

if TYPE_CHECKING:
    import viser

STEP = 0.05  # Of the sliders of periods
LIKE_LEFT = "as on the left"
POINTS = ("none", "of the period", "all periods")
BEHIND = 1.02
"""Factor of the depth while changes are shown: their places are on the surfaces."""
QUALITY, DRAFT_QUALITY = 92, 75  # Of JPEG, at rest and while something moves


class Viewer:
    """A browser that is connected."""

    def __init__(
        self, client: viser.ClientHandle, content: Content, worker: RenderWorker | None
    ) -> None:
        """Make the panel; ``worker`` draws the runs, if there are any."""
        self._client, self._content, self._worker = client, content, worker
        self._labels, self._closed = list(content.cloud.labels), False
        if len(set(self._labels)) < len(self._labels):
            self._labels = [f"{i}: {label}" for i, label in enumerate(self._labels)]
        self._layers = Layers(client, content, self._visit)
        self._views: list[KeyView] = []
        self._compared: tuple[int, list[int]] | None = None
        self._refused = ""
        self._asking, self._updating = threading.Lock(), threading.Lock()
        if content.summary:
            client.gui.add_markdown(content.summary)
        controls = [*self._add_picture(), *self._add_split(), *self._add_changes()]
        for control in [*controls, *self._add_scene()]:
            control.on_update(lambda _: self.update())
        self._add_path()
        client.camera.on_update(lambda _: self._ask())

    def close(self) -> None:
        """End what goes on in the background after the browser has left."""
        with self._asking, self._updating:
            self._closed = True
        self._layers.show_cameras(None)
        if self._worker is not None:
            self._worker.close(self._client.client_id)

    # The panel. All controls are there; those without a use are hidden.

    def _add_picture(self) -> list[Any]:
        gui, runs, last = self._client.gui, self._content.runs, len(self._labels) - 1.0
        names = [f"{i}: {run.spec.title}, {run.record.strategy}" for i, run in enumerate(runs, 1)]
        self._names = names or ["none"]
        self._method = gui.add_dropdown("Method", self._names, visible=len(runs) > 1)
        step = STEP if runs else 1.0
        self._period = gui.add_slider("Period", 0.0, last, step, 0.0, visible=last > 0)
        self._label = gui.add_markdown("")
        can = last > 0 and any(run.separates_appearance for run in runs)
        self._recolored = gui.add_checkbox("Colours of another period", False, visible=can)
        self._colors = gui.add_slider("Colours of", 0.0, last, STEP, 0.0)
        with_depth = any("depth" in run.spec.outputs for run in runs)
        self._depth = gui.add_checkbox("Depth", False, visible=with_depth)
        return [self._method, self._period, self._recolored, self._colors, self._depth]

    def _add_split(self) -> list[Any]:
        gui, several = self._client.gui, len(self._content.runs) > 1
        usable = several or bool(self._content.runs and len(self._labels) > 1)
        with gui.add_folder("Split screen", visible=usable):
            self._split = gui.add_checkbox("Split", several)
            self._wipe = gui.add_slider("Position", 0.0, 1.0, 0.01, 0.5)
            right = self._names[several]
            self._other = gui.add_dropdown("Right method", self._names, initial_value=right)
            options = [LIKE_LEFT, *self._labels]
            right = options[0 if several else -1]
            self._right = gui.add_dropdown("Right period", options, initial_value=right)
        return [self._split, self._wipe, self._other, self._right]

    def _add_changes(self) -> list[Any]:
        gui, labels = self._client.gui, self._labels
        can = any(r.distinguishes_periods and "depth" in r.spec.outputs for r in self._content.runs)
        with gui.add_folder("Changes", visible=can and len(labels) > 1):
            hint = "red: gone, blue: new, yellow: another appearance"
            self._changes = gui.add_checkbox("Show changes", False, hint=hint)
            self._from = gui.add_dropdown("From", labels)
            self._to = gui.add_dropdown("To", labels, initial_value=labels[-1])
        return [self._changes, self._from, self._to]

    def _add_scene(self) -> list[Any]:
        gui, runs = self._client.gui, self._content.runs
        start = POINTS[0 if runs else min(len(self._labels), 2)]
        with gui.add_folder("Scene"):
            self._points = gui.add_dropdown("Sparse points", POINTS, initial_value=start)
            self._legend = gui.add_html(self._legend_of_points())
            hint = "yellow: test, blue: training; a click goes there"
            self._cameras = gui.add_checkbox("Cameras", not runs, hint=hint)
            self._photo: Any = None
        return [self._points, self._cameras]

    def _legend_of_points(self) -> str:
        """Return HTML with the colours of the points of all periods."""
        _, colors = self._content.cloud.groups()
        entries = [
            f'<div><span style="color: {color}">\N{BLACK SQUARE}</span> {escape(name)}</div>'
            for color, name in zip(colors, (*self._labels, UNSEEN), strict=False)
        ]
        return f'<div style="margin: 0 1em; font-size: 0.85em">{"".join(entries)}</div>'

    def _add_path(self) -> None:
        gui = self._client.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            self._count = gui.add_markdown("No views yet")
            add, drop = gui.add_button("Add this view"), gui.add_button("Remove the last view")
            self._seconds = gui.add_slider("Seconds", 1.0, 60.0, 0.5, 8.0)
            self._save = gui.add_button("Save for render", visible=False)
        add.on_click(lambda _: self._keep([*self._views, self._now()]))
        drop.on_click(lambda _: self._keep(self._views[:-1]))
        self._save.on_click(lambda _: self._send_path())

    def _keep(self, views: list[KeyView]) -> None:
        self._views, self._save.visible = views, bool(views)
        self._count.content = f"Views, each with its period: {len(views)}"

    def _send_path(self) -> None:
        whole = not all(run.is_continuous for run in self._content.runs)
        shape = self._seconds.value, self._size, len(self._labels)
        data = path_file(self._views, *shape, whole=whole)
        self._client.send_file_download("camera_path.json", data, save_immediately=True)

    def update(self) -> None:
        """Show what the panel says."""
        self._ask()
        with self._updating:
            if self._closed:
                return
            period, low = float(self._period.value), math.floor(self._period.value)
            label = self._labels[low]
            if share := round(100 * (period - low)):
                label = f"{100 - share} % {label}, {share} % {self._labels[low + 1]}"
            self._label.content = f"**{literal(label)}**"
            self._colors.visible = self._recolored.value
            self._wipe.visible = self._right.visible = self._split.value
            self._other.visible = self._split.value and len(self._names) > 1
            self._from.visible = self._to.visible = self._changes.value
            choices = dict(zip(POINTS, (None, round(period), ALL), strict=True))
            self._layers.show_points(choices[self._points.value])
            self._legend.visible = choices[self._points.value] == ALL
            self._layers.show_cameras(round(period) if self._cameras.value else None)
        self._layers.add_photos()
        self._compare()

    # The picture.

    def _sides(self, period: float) -> list[Side]:
        chosen = self._right.value
        other = period if chosen == LIKE_LEFT else float(self._labels.index(chosen))
        sides = [(self._method.value, period), (self._other.value, other)]
        found = []
        for name, shown in sides if self._split.value else sides[:1]:
            run = self._content.runs[self._names.index(name)]
            recolored = self._recolored.value and run.separates_appearance
            found.append(Side(run, shown, float(self._colors.value) if recolored else None))
        return found

    def _ask(self) -> None:
        """Ask for a picture of what camera and panel say now."""
        with self._asking:  # else an older state could be asked for last
            if self._worker is not None and not self._closed:
                view, size = self._now(), self._size
                draw = partial(self._draw, view, size, self._sides(view.period))
                self._worker.request(self._client.client_id, draw, size)

    def _draw(self, view: KeyView, size: tuple[int, int], sides: list[Side], pixels: int) -> None:
        """Draw a picture and send it; called by the worker."""
        try:
            rgb, depth = draw_picture(view, size, sides, pixels, float(self._wipe.value))
            self._send(rgb, depth, complete=pixels >= min(math.prod(size), FULL))
            self._refused = ""
        except Exception as error:  # the other viewers go on
            if str(error) != self._refused:  # once, not for each picture
                self._notify(error)
            self._refused = str(error)

    def _send(self, rgb: NDArray[np.float32], depth: Array, *, complete: bool) -> None:
        objects = self._points.value != POINTS[0] or self._cameras.value or self._changes.value
        scale = self._content.view_from_world.scale * (BEHIND if self._changes.value else 1)
        if not self._closed:
            self._client.scene.set_background_image(
                color_depth(depth) if self._depth.value else to_bytes(rgb),
                "jpeg",
                jpeg_quality=QUALITY if complete else DRAFT_QUALITY,
                depth=scale * depth if objects else None,
            )
            self._client.flush()

    def _compare(self) -> None:
        """Show the changes that are asked for, which takes a while at their first use."""
        first, last = sorted(self._labels.index(each.value) for each in (self._from, self._to))
        number = self._names.index(self._method.value)
        wanted = (number, [first, last]) if self._changes.value and first < last else None
        if wanted == self._compared or self._worker is None:
            return
        self._compared = wanted
        self._layers.show_changes(None)
        if wanted is None:
            return
        text = "comparing the two periods in all training views"
        note = self._client.add_notification("Changes", text, loading=True)
        run, between = self._content.runs[number], self._worker.between
        try:
            made = self._content.changes(
                run, (first, last), lambda *view: between(partial(run.render, *view))
            )
            if wanted == self._compared and not self._closed:
                self._layers.show_changes(made)
        except (ChronoSceneError, CancelledError) as error:
            self._notify(error)
        note.remove()

    def _notify(self, error: Exception) -> None:
        if not self._closed:
            self._client.add_notification("Error", str(error), color="red", auto_close_seconds=15)

    # The camera.

    @property
    def _size(self) -> tuple[int, int]:
        """Width and height of the canvas in pixels."""
        camera = self._client.camera
        return max(1, camera.image_width), max(1, camera.image_height)

    def _now(self) -> KeyView:
        """Return the view that is shown."""
        camera = self._client.camera
        rotation = rotation_from_quaternion(camera.wxyz).T
        pose = pose_from_rotation_translation(rotation, -rotation @ camera.position)
        pose = self._content.view_from_world.inverse().apply_to_pose(pose)
        return KeyView(pose, float(camera.fov), float(self._period.value))

    def _visit(self, frame: Frame) -> None:
        """Go to the camera of a photo, and show the photo in the panel."""
        self._layers.hide_camera(frame)
        pose = self._content.view_from_world.apply_to_pose(frame.cam_from_world)
        with self._client.atomic():
            self._client.camera.position = camera_centre(pose)
            self._client.camera.wxyz = quaternion_from_rotation(pose[:3, :3].T)
            self._client.camera.fov = vertical_fov(frame)
        self._period.value = float(frame.period)  # type: ignore[misc]
        try:
            image = self._content.photos.load(frame)
        except ChronoSceneError as error:
            self._notify(error)
            return
        if self._photo is None:
            self._photo = self._client.gui.add_image(image, label=frame.name)
        self._photo.image, self._photo.label = image, frame.name
