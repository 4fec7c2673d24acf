"""Pictures of the report page: rectified patches of one spot, and reduced photos, as data URIs."""

from __future__ import annotations

import base64
import io
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.errors import ChronoSceneError
from chronoscene.images.store import load_rgb
from chronoscene.registration.quality.rays import Array
from chronoscene.registration.report.spots import Spot
from chronoscene.registration.result import Registered
from chronoscene.scene.cameras import project_points

PATCH = 260
"""Pixels: side of a patch on the page."""

MAGNIFIED = 1.5
"""Pixels of a patch for one of the photo."""

PHOTO_WIDTH = 460

QUALITY = 82


class Photos:
    """Photos of a registration; a few are kept decoded."""

    def __init__(self, model: Registered) -> None:
        self._model = model
        self._load = lru_cache(maxsize=12)(self._decode)

    def _decode(self, index: int) -> NDArray[np.uint8] | None:
        camera = self._model.cameras[index]
        path = Path(self._model.images_root) / self._model.names[index]
        try:
            return load_rgb(path, size=(camera.width, camera.height))
        except ChronoSceneError:
            return None

    def reduced(self, index: int) -> str | None:
        """A photo, `PHOTO_WIDTH` wide; None if it cannot be read."""
        pixels = self._load(index)
        if pixels is None:
            return None
        picture = Image.fromarray(pixels)
        height = round(picture.height * PHOTO_WIDTH / picture.width)
        return data_uri(picture.resize((PHOTO_WIDTH, height), Image.Resampling.BICUBIC))

    def patches(self, spot: Spot) -> tuple[str, str] | None:
        """The same square of the surface at a spot from both images, drawn to one scale."""
        grid = patch_grid(self._model, spot)
        found = [self._sample(index, grid) for index in (spot.a, spot.b)]
        if found[0] is None or found[1] is None:
            return None
        return data_uri(Image.fromarray(found[0])), data_uri(Image.fromarray(found[1]))

    def _sample(self, index: int, grid: Array) -> NDArray[np.uint8] | None:
        import cv2

        pixels = self._load(index)
        if pixels is None:
            return None
        pose = self._model.cam_from_world[index]
        local = grid.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
        xy = project_points(self._model.cameras[index], local)
        # Pixel (0, 0) is centred at (0.5, 0.5); cv2 counts from the centre.
        maps = np.nan_to_num(xy - 0.5, nan=-1e4).reshape(PATCH, PATCH, 2).astype(np.float32)
        return np.asarray(
            cv2.remap(
                pixels, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT, borderValue=(128, 128, 128),
            ),
            np.uint8,
        )  # fmt: skip


def patch_grid(model: Registered, spot: Spot) -> Array:
    """Places on the plane of a spot, upright in its first image. [PATCH, PATCH, 3]"""
    pose, camera = model.cam_from_world[spot.a], model.cameras[spot.a]
    depth = float((pose[:3, :3] @ spot.xyz + pose[:3, 3])[2])
    step = depth / float(camera.K[0, 0]) / MAGNIFIED
    right = pose[0, :3] - (pose[0, :3] @ spot.normal) * spot.normal
    right /= np.linalg.norm(right)
    down = np.cross(right, spot.normal)
    down *= np.sign(down @ pose[1, :3] or 1.0)
    offsets = step * (np.arange(PATCH) - (PATCH - 1) / 2)
    return np.asarray(
        spot.xyz + offsets[None, :, None] * right + offsets[:, None, None] * down, np.float64
    )


def data_uri(picture: Image.Image) -> str:
    """A picture as JPEG in a data URI."""
    file = io.BytesIO()
    picture.convert("RGB").save(file, "JPEG", quality=QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()
