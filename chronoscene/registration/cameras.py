"""Which photos share a camera."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, Literal, get_args

from chronoscene.registration.photo import Capture

Calibration = Literal["auto", "per-period", "shared"]

CALIBRATIONS: tuple[Calibration, ...] = get_args(Calibration)

LEAST_OF_ITS_OWN = {"auto": 20, "per-period": 0, "shared": sys.maxsize}
"""Photos with which a camera is calibrated for each period alone. Lenses are refocused and dropped
between dates; but few photos, of flat ground from one height above all, leave the focal length
open, and calibrate worse than last year's lens fits."""


def camera_groups(
    captures: Sequence[Capture], model: str, calibration: Calibration = "auto"
) -> list[dict[str, Any]]:
    """Lists of names that share a camera, for `chronoscene.registration.sfm.extract`.

    Photos share one if make, model, size and focal length agree, and their period if it has enough
    of them (`LEAST_OF_ITS_OWN`). Initial focal lengths are left to COLMAP, which knows the sensors
    of many cameras.
    """
    by_period: dict[tuple[Any, ...], list[Capture]] = {}
    for capture in captures:
        by_period.setdefault((*_lens(capture), capture.period), []).append(capture)
    groups: dict[tuple[Any, ...], list[str]] = {}
    for (*lens, period), members in by_period.items():
        own = len(members) >= LEAST_OF_ITS_OWN[calibration]
        key = (*lens, period if own else None)
        groups.setdefault(key, []).extend(c.name for c in members)
    return [
        {"names": sorted(names), "model": model, "params": None}
        for names in sorted(groups.values(), key=min)
    ]


def _lens(capture: Capture) -> tuple[Any, ...]:
    exif = capture.exif
    return (exif.make, exif.model, capture.width, capture.height, exif.focal_mm, exif.focal_35mm)
