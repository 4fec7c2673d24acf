"""Cameras from the keys of ``transforms.json`` and its relatives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chronoscene.formats.shared.json_values import json_error, number
from chronoscene.images.store import image_size
from chronoscene.scene.cameras import CAMERA_MODELS, Camera

LARGEST_SIDE = 1_000_000
"""Pixels; beyond any image."""

MODEL_KEYS = {
    name: CAMERA_MODELS[name].distortion
    for name in (
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE",
    )
}  # fmt: skip
"""Camera models that such a file can name, with the keys of their distortion in COLMAP's order."""

_LIST_ORDER = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Order of ``distortion_params``."""


class CameraTable:
    """Cameras of a file; frames with equal intrinsics share one."""

    def __init__(self) -> None:
        self._ids: dict[tuple[Any, ...], int] = {}

    def camera(self, place: object, data: Mapping[str, Any], image: Path) -> Camera:
        """Camera of a frame.

        Args:
            place: For messages.
            data: Keys of the file, overridden by those of the frame.
            image: Where the size is found if the file does not say it.
        """
        width, height = _size(place, data, image)
        fx, fy = _focals(place, data, width, height)
        cx, cy = number(place, data, "cx"), number(place, data, "cy")
        model, distortion = _model(place, data)
        if CAMERA_MODELS[model].num_focals == 1:
            if fx != fy:
                raise json_error(place, f"equal fl_x and fl_y of a {model}", f"{fx}, {fy}")
            focals: tuple[float, ...] = (fx,)
        else:
            focals = (fx, fy)
        centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
        params = (*focals, *centre, *distortion)
        key = (model, width, height, params)
        return Camera(self._ids.setdefault(key, len(self._ids) + 1), *key)


def _size(place: object, data: Mapping[str, Any], image: Path) -> tuple[int, int]:
    width, height = number(place, data, "w"), number(place, data, "h")
    if width is None or height is None:
        return image_size(image)
    for value in (width, height):
        if not (1 <= value <= LARGEST_SIDE and value == int(value)):
            raise json_error(place, "w and h in whole pixels", f"{width:g} x {height:g}")
    return int(width), int(height)


def _focals(place: object, data: Mapping[str, Any], width: int, height: int) -> tuple[float, float]:
    fx = number(place, data, "fl_x") or _from_angle(place, data, "camera_angle_x", width)
    fy = number(place, data, "fl_y") or _from_angle(place, data, "camera_angle_y", height) or fx
    fx = fx or fy
    if fx is None or fy is None or min(fx, fy) <= 0:
        raise json_error(place, "a positive fl_x, or camera_angle_x in radians", f"{fx}, {fy}")
    return fx, fy


def _from_angle(place: object, data: Mapping[str, Any], key: str, pixels: int) -> float | None:
    """Focal length of a field of view over a number of pixels."""
    angle = number(place, data, key)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise json_error(place, f"{key} between 0 and pi", f"{angle:g}")
    return pixels / 2 / math.tan(angle / 2)


def _model(place: object, data: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Camera model and distortion; the named model, or one that has all that is not zero."""
    values = _distortion(place, data)
    named = data.get("camera_model")
    if named is not None and named not in tuple(MODEL_KEYS):
        known = f"a camera_model {', '.join(MODEL_KEYS)}"
        todo = "render perspective views first" if named == "EQUIRECTANGULAR" else "correct it"
        raise json_error(place, known, repr(named)[:40], todo)
    used = {key for key, value in values.items() if value}
    if data.get("is_fisheye"):
        named = "OPENCV_FISHEYE"
    elif named is None:
        named = "OPENCV" if used else "PINHOLE"
    if named != "OPENCV_FISHEYE" and not used <= set(MODEL_KEYS[named]):
        named = "OPENCV"
    if named == "OPENCV" and "k3" in used and "k4" not in used:
        ks = (values[key] for key in ("k1", "k2", "p1", "p2", "k3"))
        return "FULL_OPENCV", (*ks, 0.0, 0.0, 0.0)
    if wrong := sorted(used - set(MODEL_KEYS[named])):
        raise json_error(place, f"distortion of {named}", ", ".join(wrong))
    return named, tuple(values[key] for key in MODEL_KEYS[named])


def _distortion(place: object, data: Mapping[str, Any]) -> dict[str, float]:
    listed = data.get("distortion_params")
    if listed is not None:
        if not isinstance(listed, list) or len(listed) > len(_LIST_ORDER):
            raise json_error(place, f"distortion_params {', '.join(_LIST_ORDER)}", "others")
        data = dict(zip(_LIST_ORDER, listed, strict=False))
    return {key: number(place, data, key) or 0.0 for key in _LIST_ORDER}
