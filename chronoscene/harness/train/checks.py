"""Checks of the values that a method returns, with messages that name the field."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

import numpy as np

from chronoscene.errors import ChronoSceneError
from chronoscene.methods import MethodSize, PeriodSharing, Prediction, StepReport, View


class MethodError(ChronoSceneError):
    """A method that breaks the contract of `chronoscene.methods.Method`."""


def refuse(place: str, expected: str, found: object) -> MethodError:
    """Return the error of a method at a place, such as ``StepReport.loss``."""
    return MethodError(
        place,
        expected=expected,
        found=str(found),
        todo="correct the method, or report it to its author; see docs/guides/adding-a-method.md",
    )


def check_step(report: StepReport, place: str) -> None:
    """Check the result of ``step``; the loss may be infinite or NaN."""
    _check_type(report, StepReport, place)
    _check_number(report.loss, Real, f"{place}: StepReport.loss", "a number")
    _check_count(report.primitives, f"{place}: StepReport.primitives")
    _check_number(report.views, Integral, f"{place}: StepReport.views", "an integer")
    if report.views < 1:
        raise refuse(f"{place}: StepReport.views", "at least 1", report.views)
    if report.skipped not in (None, "empty", "not finite"):
        raise refuse(
            f"{place}: StepReport.skipped", "None, 'empty' or 'not finite'", repr(report.skipped)
        )


def check_size(size: MethodSize, place: str) -> None:
    """Check the result of ``size``."""
    _check_type(size, MethodSize, place)
    for name in ("primitives", "parameters"):
        _check_count(getattr(size, name), f"{place}: MethodSize.{name}")


def check_sharing(sharing: PeriodSharing, size: MethodSize, place: str) -> None:
    """Check the result of ``sharing``: it adds up to that of ``size``."""
    _check_type(sharing, PeriodSharing, place)
    stored = sum(sharing.period_numbers) + sharing.partly_shared_numbers + sharing.shared_numbers
    for field, unit, found in (
        ("PeriodSharing.blocks", "primitives", sum(sharing.blocks)),
        ("PeriodSharing", "parameters", stored),
    ):
        wanted = getattr(size, unit)
        if found != wanted:
            raise refuse(f"{place}: {field}", f"{wanted} {unit} in all", found)


def check_prediction(prediction: Prediction, view: View, place: str) -> None:
    """Check the result of ``render``."""
    _check_type(prediction, Prediction, place)
    size = (view.height, view.width)
    for name, shape in (("rgb", (*size, 3)), ("alpha", size), ("depth", size)):
        image = getattr(prediction, name)
        if image is None and name != "rgb":
            continue
        wanted = f"a finite float32 array of shape {list(shape)}"
        field = f"{place}: Prediction.{name}"
        if not isinstance(image, np.ndarray):
            raise refuse(field, wanted, type(image).__name__)
        if image.dtype != np.float32 or image.shape != shape:
            raise refuse(field, wanted, f"{image.dtype} of shape {list(image.shape)}")
        if not np.isfinite(image).all():
            raise refuse(field, wanted, "values that are not finite")
    if prediction.drawn is not None:
        _check_number(prediction.drawn, Integral, f"{place}: Prediction.drawn", "an integer")


def _check_type(value: Any, wanted: type, place: str) -> None:
    if not isinstance(value, wanted):
        raise refuse(place, f"a {wanted.__name__}", type(value).__name__)


def _check_count(value: Any, place: str) -> None:
    _check_number(value, Integral, place, "an integer")
    if value < 0:
        raise refuse(place, "at least 0", value)


def _check_number(value: Any, kind: type, place: str, wanted: str) -> None:
    if not isinstance(value, kind):
        raise refuse(place, wanted, repr(value))
