"""Pictures of the report page: patches of a spot, reduced photos, and the map of the cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.arrays import Array
from chronoscene.errors import ChronoSceneError
from chronoscene.images.decoding import load_rgb
from chronoscene.io.pages import data_uri
from chronoscene.registration.report.spots import Spot
from chronoscene.registration.result import Registered
from chronoscene.scene.cameras import project_points
from chronoscene.scene.geometry import camera_centre

PATCH = 260  # Pixels: side of a patch on the page
MAGNIFIED = 1.5  # Pixels of a patch for one of the photo

PHOTO_WIDTH = 460

REACH = 15  # Pixels around a spot that are looked at
MIN_CONTRAST = 5.0  # Standard deviation of grey levels; clear sky has one or two

MAP_WIDTH = 720.0  # Units of the drawing
MAX_DOTS = 1500  # Points of the scene that are drawn

TICK = 16.0

MAX_GPS_VECTOR = 0.25
"""Share of the width beyond which a GPS vector is cut off and counted as gross."""


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

    def is_textured(self, spot: Spot) -> bool:
        """True if both images show something to click at a spot: no sky, no blank wall."""
        views = ((spot.a, spot.xy_a), (spot.b, spot.xy_b))
        return all(self._contrast(index, xy) > MIN_CONTRAST for index, xy in views)

    def _contrast(self, index: int, xy: Array) -> float:
        pixels = self._load(index)
        if pixels is None:
            return np.inf
        x, y = (int(v) for v in xy)
        window = pixels[max(y - REACH, 0) : y + REACH + 1, max(x - REACH, 0) : x + REACH + 1]
        return float(window.mean(axis=2).std()) if window.size else 0.0

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
    """Grid on the plane of a spot, upright in its first image. [PATCH, PATCH, 3]"""
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


@dataclass(frozen=True, slots=True)
class MapCamera:
    """A camera on the map."""

    name: str
    period: int
    x: float
    y: float
    tip: tuple[float, float]
    """End of the tick that shows where it looks."""
    gps: tuple[float, float] | None
    """GPS position on the map."""
    cut: bool
    """True if the GPS position lies farther off than is drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraMap:
    """Map of the cameras, in units of the drawing."""

    width: float
    height: float
    cameras: tuple[MapCamera, ...]
    dots: tuple[tuple[float, float], ...]
    bar: float
    """Length of the scale bar, units of the drawing."""
    bar_label: str
    north: bool
    """True if up is north."""
    gross: int


def camera_map(model: Registered) -> CameraMap:
    """Lay out the map: east to the right and north up where that is known, else the main axes."""
    centres = camera_centre(model.cam_from_world)
    axes = _axes(model, centres)
    plan = centres @ axes.T
    points = model.points[:: len(model.points) // MAX_DOTS + 1] @ axes.T
    low, high = _frame(plan, points)
    scale = MAP_WIDTH / float((high - low)[0])
    height = float(np.clip(scale * (high - low)[1], 0.3 * MAP_WIDTH, 1.3 * MAP_WIDTH))

    def draw(x: Array) -> Array:
        moved = (x - (low + high) / 2) * scale
        return np.asarray(np.stack([MAP_WIDTH / 2 + moved[..., 0], height / 2 - moved[..., 1]], -1))

    forward = model.cam_from_world[:, 2, :3] @ axes.T
    at, tips = draw(plan), draw(plan) + TICK * forward * [1, -1]
    # Without a georeference, positions are in another frame than the cameras.
    known = model.gps_enu if model.georeference is not None else np.full_like(model.gps_enu, np.nan)
    gps = draw(known @ axes.T)
    cameras = []
    for i, name in enumerate(model.names):
        vector = gps[i] - at[i]
        length = float(np.linalg.norm(vector))
        cut = bool(np.isfinite(length) and length > MAX_GPS_VECTOR * MAP_WIDTH)
        end = at[i] + vector * (MAX_GPS_VECTOR * MAP_WIDTH / length) if cut else gps[i]
        cameras.append(
            MapCamera(
                name,
                int(model.periods[i]),
                *_pair(at[i]),
                tip=_pair(tips[i]),
                gps=_pair(end) if np.isfinite(length) else None,
                cut=cut,
            )
        )
    inside = ((points >= low) & (points <= high)).all(axis=1)
    bar, label = _bar(scale, model.unit)
    return CameraMap(
        width=MAP_WIDTH,
        height=round(height, 1),
        cameras=tuple(cameras),
        dots=tuple(_pair(p) for p in draw(points[inside])),
        bar=bar,
        bar_label=label,
        north=model.georeference is not None,
        gross=sum(c.cut for c in cameras),
    )


def _axes(model: Registered, centres: Array) -> Array:
    """Directions of right and up on the map, in the world. [2, 3]"""
    if model.georeference is not None:
        return np.eye(3)[:2]
    # Up is against the mean of the cameras' down, which drones and walkers keep roughly level.
    up = -model.cam_from_world[:, 1, :3].mean(axis=0)
    forward = model.cam_from_world[:, 2, :3].mean(axis=0)
    if np.linalg.norm(up) < 0.3 or np.linalg.norm(forward) > 0.9:
        up = -forward if np.linalg.norm(forward) > 0.7 else up
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    flat = centres - centres.mean(axis=0)
    flat = flat - (flat @ up)[:, None] * up
    right = np.linalg.svd(flat, full_matrices=False)[2][0] if len(flat) > 1 else np.eye(3)[0]
    right = right - (right @ up) * up
    right = right / max(float(np.linalg.norm(right)), 1e-9)
    return np.stack([right, np.cross(up, right)])


def _frame(plan: Array, points: Array) -> tuple[Array, Array]:
    """Corners of what is drawn: all cameras, and most of the points."""
    low, high = plan.min(axis=0), plan.max(axis=0)
    if len(points) >= 10:
        inner = np.percentile(points, [5, 95], axis=0)
        size = float(np.linalg.norm(high - low))
        # Far background must not make the cameras tiny.
        low = np.minimum(low, np.maximum(inner[0], low - size))
        high = np.maximum(high, np.minimum(inner[1], high + size))
    size = np.maximum(high - low, 1e-6 + 0.2 * float((high - low).max()))
    middle = (low + high) / 2
    return middle - 0.58 * size, middle + 0.58 * size


def _bar(scale: float, unit: str) -> tuple[float, str]:
    """A scale bar of a round length, about a fifth of the width."""
    length = MAP_WIDTH / 5 / scale
    power = 10.0 ** np.floor(np.log10(length))
    round_length = power * max(f for f in (1, 2, 5) if f * power <= length)
    name = "m" if unit == "metre" else "unit" if round_length == 1 else "units"
    return round(round_length * scale, 1), f"{round_length:g} {name}"


def _pair(xy: Array) -> tuple[float, float]:
    return round(float(xy[0]), 1), round(float(xy[1]), 1)
