"""Images at the evaluation resolution: one rule to resize, one cache; and copies of image files.

The rule, for every method alike: an image wider than ``max_width`` is scaled to that width, its
height truncated to whole pixels, with Pillow's bicubic filter, which smooths before it shrinks.
The size of the model's camera decides; a file of a different size is resized to the target in one
step. Intrinsics are scaled by the exact ratio of the sizes per axis.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from mmap import mmap
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chronoscene.checks import check_choice
from chronoscene.errors import SceneError
from chronoscene.images.decoding import Photo, load_photo
from chronoscene.images.disk_cache import DiskCache
from chronoscene.images.masks import mask_place
from chronoscene.scene import Camera, Frame, Scene
from chronoscene.scene.cameras import CAMERA_MODELS

MAX_WIDTH = 1600  # Pixels; the limit that the field's loaders use

AHEAD = 4
"""Photos that each decoder may be ahead: enough for steps that are quicker than others."""

ImageSource = Literal["copy", "link", "symlink", "none"]

IMAGE_SOURCES: tuple[ImageSource, ...] = ("copy", "link", "symlink", "none")
"""``copy``; hard ``link`` where the disk can, else copy; absolute ``symlink``; no images."""

Progress = Callable[[int, int], None]
"""Called with the number of images done and their total."""


def evaluation_size(width: int, height: int, max_width: int = MAX_WIDTH) -> tuple[int, int]:
    """Apply the resize rule to width and height in pixels."""
    if width <= max_width:
        return width, height
    return max_width, max(1, height * max_width // width)


def decoded_bytes(scene: Scene, frame: Frame, max_width: int) -> int:
    """Return the memory of the image of a frame at the evaluation size, and of its mask file."""
    width, height = evaluation_size(*frame.camera.size, max_width)
    return width * height * (4 if frame.name in scene.masks else 3)


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Resize a camera with its image; each axis is scaled by its exact ratio.

    Where truncation makes the two ratios differ, a model with one focal length turns into the same
    model with two.

    Raises:
        SceneError: If the model has no focal length in pixels.
    """
    if (width, height) == camera.size:
        return camera
    model, params = camera.model, camera.params
    if model == "EQUIRECTANGULAR":
        raise SceneError(
            f"camera {camera.camera_id}",
            expected="a camera with a focal length",
            found=model,
            todo="render perspective views of the panorama first",
        )
    x, y = (width, camera.width), (height, camera.height)
    two_focals = CAMERA_MODELS[model].two_focals
    if two_focals and x[0] * y[1] == y[0] * x[1]:
        ratios: tuple[tuple[int, int], ...] = (x, x, y)
    else:
        if two_focals:
            model, params = two_focals, (params[0], *params)
            params += (0.0,) * (len(CAMERA_MODELS[model].params) - len(params))
        ratios = (x, y, x, y)
    scaled = tuple(p * new / old for p, (new, old) in zip(params, ratios, strict=False))
    return replace(
        camera, model=model, width=width, height=height, params=scaled + params[len(ratios) :]
    )


class ImageStore:
    """The images of a scene at the evaluation size, decoded when they are first needed, or ahead.

    Thread-safe. The least recently used image leaves the cache first.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        max_width: int = MAX_WIDTH,
        memory_limit: int = 2 * 1024**3,
        decoders: int = 1,
        disk: DiskCache | None = None,
        fixed: bool = False,
    ) -> None:
        """Set up the store; decode nothing yet.

        Args:
            scene: Where the images are.
            max_width: Limit of the resize rule in pixels.
            memory_limit: Bytes that cached images and masks may take; 0 for no cache. What
                decoding takes comes on top.
            decoders: Threads that decode ahead; they start with the first call of `expect`.
            disk: Keeps decoded images for the next time; None to decode them again.
            fixed: Refuse files that change from now on, when they are read.
        """
        self.waited = 0.0
        """Seconds that callers waited for images that were not in memory."""
        self._scene = scene
        self._max_width = max_width
        self._limit = memory_limit
        self._load = load_photo if disk is None else disk.load
        self._cache: OrderedDict[str, Photo] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()
        self._ahead = AHEAD * decoders
        self._decoders = ThreadPoolExecutor(decoders, "decoder")
        self._coming: dict[str, Future[Photo]] = {}
        files = [p for f in scene.frames for p in _files(scene, f)] if fixed else []
        self._stamps = {path: _stamp(path) for path in files}

    @property
    def cached_bytes(self) -> int:
        """Bytes in the cache."""
        return self._bytes

    def camera(self, frame: Frame) -> Camera:
        """Return the camera of a frame at the evaluation size."""
        return resize_camera(frame.camera, *evaluation_size(*frame.camera.size, self._max_width))

    def load(self, frame: Frame) -> NDArray[np.uint8]:
        """Return the image of a frame at the evaluation size. Shared: do not write to it.

        Returns:
            RGB. [H, W, 3]

        Raises:
            ImageError: If the file or its mask is missing or damaged.
            SceneError: If one of them has changed, in a store of fixed files.
        """
        return self._photo(frame)[0]

    def load_mask(self, frame: Frame) -> NDArray[np.bool_] | None:
        """Return the mask of the pixels of a frame that count, None if all do; otherwise as `load`.

        A resized pixel counts if all pixels of the file count that its colour is made of. [H, W]
        """
        return self._photo(frame)[1]

    def expect(self, frames: Sequence[Frame]) -> None:
        """Decode images in the background that will be needed next, in their order.

        That is the first one and as many as the decoders may be ahead, but no more than fit into
        memory. An image that cannot be decoded raises its error when it is loaded.
        """
        free = self._limit
        with self._lock:
            for frame in frames[: 1 + self._ahead]:
                free -= decoded_bytes(self._scene, frame, self._max_width)
                if free < 0:
                    break
                if frame.name in self._cache:
                    self._cache.move_to_end(frame.name)  # it must not leave before it is used
                elif frame.name not in self._coming:
                    self._coming[frame.name] = self._decoders.submit(self._fetch, frame)

    def _photo(self, frame: Frame) -> Photo:
        with self._lock:
            photo = self._cache.get(frame.name)
            if photo is not None:
                self._cache.move_to_end(frame.name)
                return photo
            coming = self._coming.get(frame.name)
        started = time.perf_counter()
        try:
            return self._fetch(frame) if coming is None else coming.result()
        finally:
            with self._lock:
                self.waited += time.perf_counter() - started

    def _fetch(self, frame: Frame) -> Photo:
        """Load a photo into the cache."""
        size = evaluation_size(*frame.camera.size, self._max_width)
        path, mask_path = self._scene.image_path(frame), self._scene.masks.get(frame.name)
        try:
            image, mask = self._load(path, mask_path, size=size)
            self._check_unchanged(frame)
            return self._keep(frame.name, (_mapped(image), None if mask is None else _mapped(mask)))
        finally:
            with self._lock:
                self._coming.pop(frame.name, None)

    def _check_unchanged(self, frame: Frame) -> None:
        for path in _files(self._scene, frame) if self._stamps else ():
            if _stamp(path) != self._stamps[path]:
                raise SceneError(
                    path,
                    expected="a file that stays as it was when the run began",
                    found="a later change",
                    todo="run the same command again, which plans with the present files",
                )

    def _keep(self, name: str, photo: Photo) -> Photo:
        """Put a photo into the cache; another thread may have been faster."""
        with self._lock:
            if name in self._cache:
                return self._cache[name]
            if _bytes(photo) > self._limit:
                return photo
            self._cache[name] = photo
            self._bytes += _bytes(photo)
            while self._bytes > self._limit:
                self._bytes -= _bytes(self._cache.popitem(last=False)[1])
        return photo


def _files(scene: Scene, frame: Frame) -> list[Path]:
    """Return the image of a frame, and its mask if it has one."""
    mask = scene.masks.get(frame.name)
    return [scene.image_path(frame), *([] if mask is None else [mask])]


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return size and time of change of a file; None if it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _mapped(array: NDArray[Any]) -> NDArray[Any]:
    """Copy an array to pages of its own, which go back to the system with it.

    Blocks that decoders and libraries free in between leave holes that the allocator keeps: with
    them, photos took 1.3 times the memory of their pixels.
    """
    copy = np.frombuffer(mmap(-1, array.nbytes), array.dtype).reshape(array.shape)
    copy[:] = array
    return copy


def _bytes(photo: Photo) -> int:
    return sum(array.nbytes for array in photo if array is not None)


def place_images(
    scene: Scene,
    root: Path,
    *,
    names: Mapping[str, str] | None = None,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
) -> None:
    """Put the images of a scene below ``root``, under their names or the given new ones.

    Mask files go to ``masks/`` beside ``root``, under the names that belong to those of the images.

    Raises:
        SceneError: If an image is missing.
        ConfigError: If the image source is unknown.
    """
    check_choice("image_source", image_source, IMAGE_SOURCES)
    for done, frame in enumerate(scene.frames, start=1):
        if image_source != "none":
            name = names[frame.name] if names is not None else frame.name
            place_image(scene.image_path(frame), root / name, image_source)
            if mask := scene.masks.get(frame.name):
                place_image(mask, root.parent / mask_place(name), image_source)
        if progress is not None:
            progress(done, len(scene.frames))


def place_image(source: Path, target: Path, image_source: ImageSource) -> None:
    """Copy or link one image.

    Raises:
        SceneError: If it is missing, or its target exists.
    """
    if not source.is_file():
        todo = "copy it there, or leave the image out (chronoscene edit SCENE OUT --drop IMAGE)"
        raise SceneError(source, expected="an image", found="nothing", todo=todo)
    if os.path.lexists(target):  # a/b and a//b; or a and A on a disk that ignores case
        raise SceneError(
            target,
            expected="a separate file for each image",
            found="a file that was written for another image",
            todo="rename the image",
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    if image_source == "symlink":
        target.symlink_to(source.resolve())
        return
    if image_source == "link":
        try:
            os.link(source.resolve(), target)
            return
        except OSError:
            pass  # another disk, or one without links
    shutil.copyfile(source, target)
