"""Photos that share a camera, and so its calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from typing import Any

from chronoscene.registration.context import Calibration
from chronoscene.registration.photos.photo import Capture
from chronoscene.scene import Scene
from chronoscene.scene.grouping import grouped

MIN_PHOTOS = 20
"""Photos from which on a camera is calibrated for each date alone. Lenses are refocused and dropped
between dates; but few photos, above all of flat ground from one height, do not determine the focal
length, and a calibration of another date fits better."""

AUTO, FEW, MANY = "auto", "SIMPLE_RADIAL", "OPENCV"
"""Camera models of COLMAP: the choice between the other two. All photos are mapped with the first;
`MIN_PHOTOS` of a camera determine the second (`reconstruct.lens`)."""

SAME_VISIT = timedelta(days=1)
"""Time between periods up to which they count as one visit, with one calibration."""


def scene_groups(scene: Scene) -> list[dict[str, Any]]:
    """Group the images of a scene by camera, for `extraction.extract`."""
    by_camera = grouped((frame.camera.camera_id, frame) for frame in scene.frames)
    return [
        {
            "names": sorted(f.name for f in frames),
            "model": frames[0].camera.model,
            "params": list(frames[0].camera.params),
        }
        for frames in by_camera.values()
    ]


def camera_groups(
    captures: Sequence[Capture], model: str, calibration: Calibration = "auto"
) -> list[dict[str, Any]]:
    """Group photos that share a camera, for `extraction.extract`.

    Photos share one if make, model, size and focal length agree. With ``auto``, photos of different
    visits do not, where each has enough of them (`MIN_PHOTOS`). Initial focal lengths are
    left to COLMAP, which knows the sensors of many cameras.
    """
    by_lens = grouped((_lens(capture), capture) for capture in captures)
    groups = [g for members in by_lens.values() for g in _SPLITTERS[calibration](members)]
    return [
        {"names": sorted(names), "model": FEW if model == AUTO else model, "params": None}
        for names in sorted(([c.name for c in group] for group in groups), key=min)
    ]


def _lens(capture: Capture) -> tuple[Any, ...]:
    exif = capture.exif
    return (exif.make, exif.model, capture.width, capture.height, exif.focal_mm, exif.focal_35mm)


def _periods(captures: Sequence[Capture]) -> list[list[Capture]]:
    by_period = grouped((capture.period, capture) for capture in captures)
    return [by_period[p] for p in sorted(by_period)]


def _visits(captures: Sequence[Capture]) -> list[list[Capture]]:
    """Group photos by visit; visits with too few photos form one group."""
    visits: list[list[Capture]] = []
    undated = []
    dated: list[tuple[datetime, datetime, list[Capture]]] = []
    for members in _periods(captures):
        times = [c.taken for c in members if c.taken is not None]
        if times:
            dated.append((min(times), max(times), members))
        else:
            undated.append(members)
    end: datetime | None = None
    for first, last, members in sorted(dated, key=lambda d: d[0]):
        if end is not None and first - end <= SAME_VISIT:
            visits[-1] += members
        else:
            visits.append(list(members))
        end = last if end is None else max(end, last)
    visits += undated
    few = [c for members in visits if len(members) < MIN_PHOTOS for c in members]
    return [m for m in visits if len(m) >= MIN_PHOTOS] + ([few] if few else [])


_SPLITTERS: dict[Calibration, Callable[[Sequence[Capture]], list[list[Capture]]]] = {
    "auto": _visits,
    "per-period": _periods,
    "shared": lambda captures: [list(captures)],
}
