"""Position and scale of a registration in the world, judged apart from the alignment.

A model whose periods fit each other perfectly can be metres off in the world. Check points, which
took no part in the estimation, measure that. Control points show only how well the model could be
moved to them, and GPS is as good as the receiver: neither proves a position.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from chronoscene.arrays import Array, Ints
from chronoscene.registration.quality.left_out import (
    contradicted,
    errors_left_out,
    not_fixed,
    precision,
)
from chronoscene.registration.quality.metadata import Comparison, compare_with_metadata
from chronoscene.registration.quality.metadata import objections as contradictions
from chronoscene.registration.quality.thresholds import (
    Level,
    Objection,
    Threshold,
    check,
    worst_level,
)
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.control import CONTRADICTION
from chronoscene.registration.ties.residuals import PointResidual
from chronoscene.registration.ties.tie_alignment import TieAlignment
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import scale_deviation

_COMPARE = (
    "compare the reference system, the coordinates and the clicks of the points with the largest "
    "errors (control.csv)"
)
_CHECK = "set some surveyed points aside as check points: role check in the file of --tie-points"

_SYSTEM = "check the reference system of the points, and the order east, north, height"

UPWARDS = 0.5
"""Mean sine of the elevations of all views, above which the photos look at what is above them."""

HEIGHT_GAP = 5.0
"""Metres between surveyed heights and those of GPS from which on a sentence says so. Receivers err
by as much in height, and systems of height differ by more: neither is an error of the survey."""

_MOST_AGREE = "the other control points agree with each other, but not with it"

POSITION_THRESHOLDS: dict[str, Threshold] = {
    "horizontal": Threshold(
        what="horizontal RMSE",
        unit="ground pixels", doubtful=2, fail=6,
        why="twice the pixel on the ground is the ASPRS class for mapping; clicks are precise to "
        "about one",
        todo=_COMPARE,
    ),
    "vertical": Threshold(
        what="vertical RMSE",
        unit="ground pixels", doubtful=3, fail=9,
        why="rays of neighbouring photos intersect at small angles, so heights are less precise",
        todo=_COMPARE,
    ),
    "points": Threshold(
        what="check points",
        doubtful=3, larger_is_better=True,
        why="fewer say nothing about a tilt of the model",
        todo=_CHECK,
    ),
    "left_out": Threshold(
        what="error without its own coordinates, in standard deviations",
        doubtful=4, fail=12,
        why="the photos and the other points place it elsewhere than it was surveyed",
        todo=_COMPARE,
    ),
    "gps": Threshold(
        what="horizontal distance of the surveyed position from GPS, median",
        unit="m", doubtful=15, fail=100,
        why="receivers err by metres; more comes from another reference system, or exchanged axes",
        todo=_SYSTEM,
    ),
    "scale": Threshold(
        what="standard deviation of the scale by GPS",
        unit="%", doubtful=1,
        why="lengths are as uncertain as the scale, and volumes three times as much",
        todo="measure a distance between two spots of the scene, and give them as control; or take "
        "photos over a larger area",
    ),
}  # fmt: skip
"""The fail limits of the errors are three times the doubtful ones."""


@dataclass(frozen=True, slots=True)
class Rmse:
    """Root mean square errors of points or cameras, in metres."""

    count: int
    horizontal: float
    vertical: float
    worst: str
    """Name of the one with the largest error."""
    largest: float
    """Its distance."""

    @property
    def text(self) -> str:
        """The errors in words."""
        return (
            f"{self.horizontal:.3g} m horizontal, {self.vertical:.3g} m vertical (RMSE of "
            f"{self.count}; largest {self.largest:.3g} m, {self.worst})"
        )


@dataclass(frozen=True, slots=True)
class Position:
    """The judgement on the absolute position."""

    level: Level | Literal["not checked"]
    text: str
    """One or two sentences."""
    objections: tuple[Objection, ...]
    """The most severe first."""
    check: Rmse | None
    """Points that took no part in the estimation."""
    control: Rmse | None
    """Points that the model was moved to: optimistic."""
    gps: Rmse | None
    """Cameras against their GPS positions."""
    ground_pixel: float | None
    """Metres that a pixel covers, median over the surveyed points."""
    scale_error: float | None = None
    """Relative standard deviation of the scale by GPS, unless control determines the scale."""
    metadata: tuple[Comparison, ...] = ()
    """The model beside what its photos state."""
    left_out: Rmse | None = None
    """Control points, each placed by an adjustment to which its coordinates are unknown."""

    @property
    def todo(self) -> tuple[str, ...]:
        """Things to do, without repetition, the most important first."""
        return tuple(dict.fromkeys(f.todo for f in self.objections))

    @property
    def lines(self) -> list[tuple[str, Rmse]]:
        """The errors that were measured, with what they are errors of."""
        named = (
            ("check points", self.check),
            ("control points, which the model was fitted to", self.control),
            ("control points, each without its coordinates in turn", self.left_out),
            ("cameras against GPS", self.gps),
        )
        return [(name, rmse) for name, rmse in named if rmse is not None]


def judge_position(model: Registered, ties: TieAlignment | None = None) -> Position:
    """Judge where a registration lies in the world, by the best measurement there is.

    Args:
        model: The registration, after alignment by tie points.
        ties: Result of the alignment by tie points.
    """
    points = [] if ties is None else [r for r in ties.residuals if r.error is not None]
    controlled = ties is not None and ties.controlled
    # Control that could not move the model is as independent as check points.
    checks = [r for r in points if r.role == "check" or not controlled]
    used = [r for r in points if r.used]
    found, control = _of_points(checks), _of_points(used)
    gps = None if model.georeference is None else _rmse(*_gps_errors(model))
    without = errors_left_out(model)
    left_out = _rmse(list(without), np.array([error for error, _ in without.values()]))
    pixels = [r.ground_pixel for r in points if r.ground_pixel is not None]
    pixel = float(np.median(pixels)) if pixels else None
    objections = [
        *(_turned_over(model) if controlled else ()),
        *_errors("check points", found, pixel),
        *_errors("control points", control, pixel),
        *contradicted(model, POSITION_THRESHOLDS["left_out"]),
    ]
    objections += _rejected(
        [r for r in points if r.role == "control" and controlled and not r.used]
    )
    objections += [
        Objection("doubtful", "contradiction", "control points", remark, _MOST_AGREE, _COMPARE)
        for remark in (ties.remarks if ties is not None else ())
        if remark.startswith(CONTRADICTION)
    ]
    if found is not None:
        objections += check(POSITION_THRESHOLDS["points"], found.count, "check points", "points")
    if points and gps is not None:
        gap = float(np.linalg.norm(np.median(_gps_errors(model)[1][:, :2], axis=0)))
        objections += check(POSITION_THRESHOLDS["gps"], gap, "ground control and GPS", "gps")
    scale_error = None if gps is None or controlled else _scale_error(model)
    if scale_error is not None:
        objections += check(POSITION_THRESHOLDS["scale"], 100 * scale_error, "GPS", "scale")
    compared = compare_with_metadata(model)
    if found is None or found.count < POSITION_THRESHOLDS["points"].doubtful:
        objections += contradictions(compared)  # check points measure the same, and better
    if model.resection is None or found is not None:
        objections += _unproven(found, control, gps)
    else:
        objections += not_fixed(model, POSITION_THRESHOLDS["horizontal"], pixel)
    objections.sort(key=lambda f: (f.level != "fail", f.check != "metadata"))
    level: Level | Literal["not checked"] = worst_level(f.level for f in objections)
    if found is None and control is None and gps is None and not objections:
        level = "not checked"
    text = _words(level, objections, found, left_out, ties) + precision(model)
    if points and gps is not None:
        text += _heights(model)
    if level == "not checked" and model.georeference is not None:
        text = "The model lies where the scene that it extends does; nothing else measures that."
    return Position(
        level,
        text,
        tuple(objections),
        found,
        control,
        gps,
        ground_pixel=pixel,
        scale_error=scale_error,
        metadata=tuple(compared),
        left_out=left_out,
    )


def _of_points(points: Sequence[PointResidual]) -> Rmse | None:
    return _rmse([r.name for r in points], np.array([r.error for r in points]))


def _rmse(names: Sequence[str], errors: Array) -> Rmse | None:
    if not len(names):
        return None
    distance = np.linalg.norm(errors, axis=1)
    square = np.mean(errors**2, axis=0)
    worst = int(np.argmax(distance))
    return Rmse(
        count=len(names),
        horizontal=float(np.sqrt(square[0] + square[1])),
        vertical=float(np.sqrt(square[2])),
        worst=names[worst],
        largest=float(distance[worst]),
    )


def _gps_errors(model: Registered) -> tuple[list[str], Array]:
    """Subtract the GPS positions that took part in the estimation from the cameras.

    Returns:
        Names of their images, and errors in metres. [G, 3]
    """
    use = _with_used_gps(model)
    errors = camera_centre(model.cam_from_world[use]) - model.gps_enu[use]
    return [model.names[i] for i in use], errors


def _with_used_gps(model: Registered) -> Ints:
    return np.flatnonzero(model.gps_used & np.isfinite(model.gps_enu).all(axis=1))


def _scale_error(model: Registered) -> float:
    """Relative standard deviation of the scale, from the horizontal residuals of all positions."""
    flat = model.gps_enu[_with_used_gps(model), :2]
    return scale_deviation(_gps_errors(model)[1][:, :2], flat)


def _errors(place: str, rmse: Rmse | None, pixel: float | None) -> Iterator[Objection]:
    """Objections to the errors of points, in pixels on the ground."""
    if rmse is None or not pixel:
        return
    for key, value in (("horizontal", rmse.horizontal), ("vertical", rmse.vertical)):
        note = f" ({value:.3g} m; largest error {rmse.largest:.3g} m, {rmse.worst})"
        yield from check(POSITION_THRESHOLDS[key], value / pixel, place, key, note)


def _heights(model: Registered) -> str:
    """Tell if surveyed heights differ from those of GPS, all in one direction."""
    errors = _gps_errors(model)[1][:, 2]
    gap = float(np.median(errors))
    scattered = np.median(np.abs(errors - gap)) > abs(gap) / 3
    if abs(gap) < HEIGHT_GAP or scattered or not _states_heights(model):
        return ""
    return (
        f" The surveyed heights are {abs(gap):.3g} m {'above' if gap > 0 else 'below'} those of "
        "GPS: heights may be above the sea, the ellipsoid or the place of take-off, and receivers "
        "err by metres."
    )


def _states_heights(model: Registered) -> bool:
    """Find out if the GPS positions have heights; unknown ones are all set to 0."""
    assert model.georeference is not None
    heights = model.georeference.to_geodetic(model.gps_enu[_with_used_gps(model)])[:, 2]
    return bool(np.ptp(heights) > 0.01)


def _turned_over(model: Registered) -> Iterator[Objection]:
    """An objection to control that places the ground above the cameras."""
    if float(model.cam_from_world[:, 2, 2].mean()) > UPWARDS:
        yield Objection(
            "doubtful", "upwards", "the photos", "all in all, they look up from below the points",
            "control on flat ground whose east and north are exchanged fits a model that is "
            "turned over", _SYSTEM,
        )  # fmt: skip


def _rejected(points: Sequence[PointResidual]) -> Iterator[Objection]:
    """Control points that do not fit the others."""
    for r in points:
        found = f"{np.linalg.norm(r.error or 0.0):.3g} m off, so it was left out"
        yield Objection(
            "doubtful", "outlier", f"control point {r.name}", found,
            _MOST_AGREE, _COMPARE,
        )  # fmt: skip


def _unproven(found: Rmse | None, control: Rmse | None, gps: Rmse | None) -> Iterator[Objection]:
    """An objection where nothing but the estimation itself speaks for a position."""
    if found is not None:
        return
    if control is not None:
        yield Objection(
            "doubtful", "independent", "control points",
            f"{control.text}; there are no check points",
            "the model was fitted to these points, so their errors are optimistic", _CHECK,
        )  # fmt: skip
    elif gps is not None:
        yield Objection(
            "doubtful", "independent", "GPS", f"cameras differ from it by {gps.text}",
            "an error that all positions share, of metres for a consumer receiver and in height, "
            "does not show", "give surveyed points: --tie-points with world coordinates",
        )  # fmt: skip


def _words(
    level: str,
    objections: Sequence[Objection],
    found: Rmse | None,
    left_out: Rmse | None,
    ties: TieAlignment | None,
) -> str:
    if level == "not checked":
        why = "there is no ground control, and GPS was not used"
        if ties is not None and any(r.role != "tie" for r in ties.residuals):
            why = "; ".join(ties.remarks) or "none of the surveyed points can be placed"
        return f"Where the model lies in the world is unknown: {why}."
    if level == "pass" and found is not None:
        return f"Check points, which took no part in the estimation: {found.text}."
    if level == "pass" and left_out is not None:
        return f"Control points, each without its own coordinates in turn: {left_out.text}."
    first = objections[0]
    match level, first.check:
        case "fail", "gps":
            start = "The surveyed points and GPS contradict each other; one of the two is wrong."
        case "fail", _:
            start = "The model does not lie where surveyed points are."
        case _, "metadata":
            start = (
                "The model contradicts what its photos state; its lengths and heights may be wrong."
            )
        case _, "independent":
            start = "The position may be correct, but nothing independent proves it."
        case _:
            start = "The position is not proven to the precision of the photos."
    return f"{start} {first.place[0].upper()}{first.place[1:]}: {first.found}."
