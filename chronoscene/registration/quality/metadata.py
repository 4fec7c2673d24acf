"""A registration against the focal length, height and heading that its photos state.

Dates can fit each other perfectly in a model whose lens, heights and shape are wrong together. What
the photos state does not depend on the model.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.registration.photos.stated import contradicts
from chronoscene.registration.quality.thresholds import FLAT, TAKE_OFF, Objection
from chronoscene.registration.result import Registered
from chronoscene.scene.geometry import camera_centre

MIN_PHOTOS = 4  # Photos that state a height or a heading
MAX_HEIGHT_DIFFERENCE = 0.05
MIN_HEIGHT = 10.0  # Metres; barometers err by about one
MAX_TURN = 18.0  # Degrees: 5 % of a circle. Compasses err by ten
BELOW = 20  # Points next to a camera in plan that are the ground below it


@dataclass(frozen=True, slots=True)
class Comparison:
    """A quantity of the model beside what photos state."""

    what: str
    unit: str
    found: float
    stated: float
    photos: int
    contradiction: bool

    @property
    def text(self) -> str:
        """Both values in words."""
        found, stated = (f"{x:.1f} {self.unit}" for x in (self.found, self.stated))
        return f"{found}, while {self.photos} photos state {stated}"


TODO = {
    "focal length": FLAT,
    "height above ground": TAKE_OFF,
    "heading": "if the compass is reliable, register again without the photos whose GPS is off",
}


def compare_with_metadata(model: Registered) -> list[Comparison]:
    """Compare the focal length of each camera, heights and headings, as far as they are stated."""
    found = list(_focals(model))
    if model.georeference is not None:
        found += [c for c in (_height(model), _heading(model)) if c is not None]
    return found


def objections(comparisons: list[Comparison]) -> Iterator[Objection]:
    """An objection to every contradiction."""
    for c in comparisons:
        if c.contradiction:
            yield Objection(
                "doubtful", "metadata", f"{c.what} of the model", c.text,
                "lens, height and shape of a model can be wrong together, and fit", TODO[c.what],
            )  # fmt: skip


def _focals(model: Registered) -> Iterator[Comparison]:
    by_camera: dict[int, list[int]] = {}
    for i, (name, camera) in enumerate(zip(model.names, model.cameras, strict=True)):
        if name in model.stated and model.stated[name].focal is not None:
            by_camera.setdefault(camera.camera_id, []).append(i)
    for rows in by_camera.values():
        K, said = model.cameras[rows[0]].K, model.stated[model.names[rows[0]]]
        assert said.focal is not None
        found = float(np.sqrt(K[0, 0] * K[1, 1]))
        wrong = contradicts(found, said.focal, said.focal_error)
        yield Comparison("focal length", "px", found, said.focal, len(rows), wrong)


def _height(model: Registered) -> Comparison | None:
    """Median height above the points below each camera."""
    said = np.array([_stated(model, name, "height") for name in model.names])
    use = said > MIN_HEIGHT
    if use.sum() < MIN_PHOTOS or len(model.points) < BELOW:
        return None
    centres = camera_centre(model.cam_from_world[use])
    _, below = cKDTree(model.points[:, :2]).query(centres[:, :2], k=BELOW)
    ground = np.median(model.points[below, 2], axis=1)
    found, height = float(np.median(centres[:, 2] - ground)), float(np.median(said[use]))
    slope = float(np.ptp(np.percentile(ground, [5, 95])))
    wrong = abs(found - height) > MAX_HEIGHT_DIFFERENCE * height + slope
    return Comparison("height above ground", "m", found, height, int(use.sum()), wrong)


def _heading(model: Registered) -> Comparison | None:
    """Median direction of view; where cameras look down, that of the upper side of the photo."""
    said = np.array([_stated(model, name, "heading") for name in model.names])
    forward, up = model.cam_from_world[:, 2, :3], -model.cam_from_world[:, 1, :3]
    level = np.abs(forward[:, 2:]) < 0.7
    axis = np.where(level, forward, up)
    use = np.isfinite(said) & (np.linalg.norm(axis[:, :2], axis=1) > 0.5)
    if use.sum() < MIN_PHOTOS:
        return None
    found = np.degrees(np.arctan2(axis[use, 0], axis[use, 1]))
    turn = np.exp(1j * np.radians(found - said[use]))
    mean = float(np.degrees(np.angle(turn.sum())))
    away = (found - said[use] - mean + 180) % 360 - 180
    difference = mean + float(np.median(away))
    middle = float(np.median(said[use])) % 360
    wrong = abs(difference) > MAX_TURN
    return Comparison("heading", "degrees", middle + difference, middle, int(use.sum()), wrong)


def _stated(model: Registered, name: str, what: str) -> float:
    value = getattr(model.stated.get(name), what, None)
    return float("nan") if value is None else float(value)
