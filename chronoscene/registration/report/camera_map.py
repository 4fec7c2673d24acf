"""Map of the cameras by period, from above, as numbers that the page draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.registration.quality.rays import Array
from chronoscene.registration.result import Registered
from chronoscene.scene.geometry import camera_centre

WIDTH = 720.0
"""Units of the drawing."""

MAX_DOTS = 1500
"""Points of the scene that are drawn."""

TICK = 16.0

MAX_GPS_VECTOR = 0.25
"""Share of the width beyond which a GPS vector is cut off and counted as gross."""


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
    """Where its GPS says that it was."""
    cut: bool
    """Whether the GPS lies farther off than is drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraMap:
    """Everything that is drawn."""

    width: float
    height: float
    cameras: tuple[MapCamera, ...]
    dots: tuple[tuple[float, float], ...]
    bar: float
    """Length of the scale bar, units of the drawing."""
    bar_label: str
    north: bool
    """Whether up is north."""
    gross: int


def camera_map(model: Registered) -> CameraMap:
    """Lay out the map: east to the right and north up where that is known, else the main axes."""
    centres = camera_centre(model.cam_from_world)
    axes = _axes(model, centres)
    plan = centres @ axes.T
    points = model.points[:: len(model.points) // MAX_DOTS + 1] @ axes.T
    low, high = _frame(plan, points)
    scale = WIDTH / float((high - low)[0])
    height = float(np.clip(scale * (high - low)[1], 0.3 * WIDTH, 1.3 * WIDTH))

    def draw(x: Array) -> Array:
        moved = (x - (low + high) / 2) * scale
        return np.asarray(np.stack([WIDTH / 2 + moved[..., 0], height / 2 - moved[..., 1]], -1))

    forward = model.cam_from_world[:, 2, :3] @ axes.T
    at, tips = draw(plan), draw(plan) + TICK * forward * [1, -1]
    gps = draw(model.gps_enu @ axes.T)
    cameras = []
    for i, name in enumerate(model.names):
        vector = gps[i] - at[i]
        length = float(np.linalg.norm(vector))
        cut = bool(np.isfinite(length) and length > MAX_GPS_VECTOR * WIDTH)
        end = at[i] + vector * (MAX_GPS_VECTOR * WIDTH / length) if cut else gps[i]
        cameras.append(
            MapCamera(
                name, int(model.periods[i]), *_pair(at[i]), _pair(tips[i]),
                _pair(end) if np.isfinite(length) else None, cut,
            )
        )  # fmt: skip
    inside = ((points >= low) & (points <= high)).all(axis=1)
    bar, label = _bar(scale, model.unit)
    return CameraMap(
        width=WIDTH,
        height=round(height, 1),
        cameras=tuple(cameras),
        dots=tuple(_pair(p) for p in draw(points[inside])),
        bar=bar,
        bar_label=label,
        north=model.georeference is not None,
        gross=sum(c.cut for c in cameras),
    )


def _axes(model: Registered, centres: Array) -> Array:
    """Right and up of the map in the world. [2, 3]"""
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
    length = WIDTH / 5 / scale
    power = 10.0 ** np.floor(np.log10(length))
    round_length = power * max(f for f in (1, 2, 5) if f * power <= length)
    return round(round_length * scale, 1), f"{round_length:g} {'m' if unit == 'metre' else 'units'}"


def _pair(xy: Array) -> tuple[float, float]:
    return round(float(xy[0]), 1), round(float(xy[1]), 1)
