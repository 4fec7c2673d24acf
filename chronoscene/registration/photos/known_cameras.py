"""Calibrations that are known: a file of camera models for photos by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.errors import SceneError
from chronoscene.io.documents import read_text
from chronoscene.registration.photos.photo import Capture
from chronoscene.scene.cameras import CAMERA_MODELS, Camera
from chronoscene.scene.splits import composed

_TODO = (
    "write lines such as: */cam1/*.jpg OPENCV 6012 4008 6621.7 6621.7 3013.2 1943.5 -0.09 0.08 0 0"
)

MAX_STRETCH = 0.005  # Difference of the two ratios of sizes: rounding of a resized photo, not a cut


def read_cameras(path: Path) -> list[tuple[str, Camera]]:
    """Read lines of a pattern of names, and a camera as in COLMAP's ``cameras.txt``.

    Raises:
        SceneError: If a line is wrong; the message names it.
    """
    found: list[tuple[str, Camera]] = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split()
        try:
            pattern, model, width, height = fields[:4]
            camera = Camera(
                len(found) + 1, model, int(width), int(height), tuple(map(float, fields[4:]))
            )
            right = camera.is_usable
        except (ValueError, KeyError):
            right = False
        if not right:
            expected = "pattern, camera model of COLMAP, width, height and its parameters"
            raise SceneError(
                f"{path}:{number}", expected=expected, found=repr(line[:80]), todo=_TODO
            )
        found.append((pattern, camera))
    if not found:
        raise SceneError(path, expected="cameras", found="none", todo=_TODO)
    return found


def known_groups(path: Path, captures: Sequence[Capture]) -> list[dict[str, Any]]:
    """Group photos by known cameras, for `extraction.extract`, scaled to the size of the photos.

    Raises:
        SceneError: If a photo has no camera, or another shape than it.
    """
    cameras = read_cameras(path)
    groups: dict[tuple[int, int, int], dict[str, Any]] = {}
    for capture in captures:
        name = composed(capture.name)
        fits = (i for i, (p, _) in enumerate(cameras) if fnmatchcase(name, composed(p)))
        row = next(fits, None)
        if row is None:
            raise SceneError(path, expected=f"a pattern that fits {capture.name}", found="none",
                             todo=_TODO)  # fmt: skip
        camera = scaled(path, cameras[row][1], capture)
        key = row, camera.width, camera.height
        group = {"names": [], "model": camera.model, "params": list(camera.params)}
        groups.setdefault(key, group)["names"].append(capture.name)
    return list(groups.values())


def scaled(path: Path, camera: Camera, capture: Capture) -> Camera:
    """Scale a camera to the size of a photo; distortion has no unit."""
    across, down = capture.width / camera.width, capture.height / camera.height
    if abs(across / down - 1) > MAX_STRETCH:
        found = f"{capture.width} x {capture.height}, of another shape"
        raise SceneError(path, expected=f"photos such as the {camera.width} x {camera.height} of "
                         f"its camera for {capture.name}", found=found,
                         todo="give the calibration of these photos")  # fmt: skip
    count = CAMERA_MODELS[camera.model].num_focals + 2
    factor = {3: [(across + down) / 2, across, down], 4: [across, down] * 2}[count]
    params = (*np.multiply(camera.params[:count], factor).tolist(), *camera.params[count:])
    return replace(camera, width=capture.width, height=capture.height, params=params)
