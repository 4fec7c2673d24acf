"""Which photos share a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from chronoscene.registration.photo import Capture

LEAST_OF_ITS_OWN = 8
"""Photos with which a camera is calibrated for each period alone. Lenses are refocused and dropped
between dates; but fewer photos calibrate worse than last year's lens fits."""


def camera_groups(captures: Sequence[Capture], model: str) -> list[dict[str, Any]]:
    """Lists of names that share a camera, for `chronoscene.registration.sfm.extract`.

    Photos share one if make, model, size and focal length agree, and their period unless it has
    few of them. Initial focal lengths are left to COLMAP, which knows the sensors of many cameras.
    """
    by_period: dict[tuple[Any, ...], list[Capture]] = {}
    for capture in captures:
        by_period.setdefault((*_lens(capture), capture.period), []).append(capture)
    groups: dict[tuple[Any, ...], list[str]] = {}
    for (*lens, period), members in by_period.items():
        own = len(members) >= LEAST_OF_ITS_OWN
        key = (*lens, period if own else None)
        groups.setdefault(key, []).extend(c.name for c in members)
    return [
        {"names": sorted(names), "model": model, "params": None}
        for names in sorted(groups.values(), key=min)
    ]


def _lens(capture: Capture) -> tuple[Any, ...]:
    exif = capture.exif
    return (exif.make, exif.model, capture.width, capture.height, exif.focal_mm, exif.focal_35mm)
