"""Splits by date of capture: what was taken last is for testing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, datetime
from pathlib import Path

from PIL import Image

from chronoscene.errors import SceneError
from chronoscene.scene import Scene

_EXIF_IFD = 0x8769

_CAPTURE_TAGS = (0x9003, 0x9004)
"""DateTimeOriginal, DateTimeDigitized."""


def latest(scene: Scene, fraction: float) -> set[str]:
    """The last images of each period, as near to the fraction as whole days allow.

    Raises:
        SceneError: If an image has no date.
    """
    times = capture_times(scene)
    tests = set()
    for period in scene.periods:
        frames = scene.select(period=period.id)
        ordered = sorted(frames, key=lambda f: (times[f.name], f.name))
        days = sorted({times[f.name].date() for f in ordered})
        if len(days) > 1:
            tests |= _last_days([(times[f.name].date(), f.name) for f in ordered], fraction)
        else:
            held_out = max(1, round(fraction * len(ordered)))
            tests |= {f.name for f in ordered[len(ordered) - held_out :]}
    return tests


def _last_days(dated: Sequence[tuple[date, str]], fraction: float) -> set[str]:
    """Images of the last days, as many days as come nearest to the fraction; one at least."""
    days = sorted({day for day, _ in dated})
    after = [sum(day >= first for day, _ in dated) for first in days[1:]]
    nearest = min(range(len(after)), key=lambda i: (abs(after[i] - fraction * len(dated)), -i))
    return {name for day, name in dated if day >= days[1 + nearest]}


def capture_times(scene: Scene) -> dict[str, datetime]:
    """When each image was taken: its EXIF block says, else the beginning of its file name.

    Raises:
        SceneError: If an image has neither.
    """
    times = {f.name: _capture_time(scene.image_path(f)) for f in scene.frames}
    if lost := [name for name, time in times.items() if time is None]:
        raise SceneError(
            scene.root,
            expected="a date of capture of every image: EXIF DateTimeOriginal, or a file name that "
            "begins with 2023-04-17 or 20230417",
            found=f"none for {len(lost)} of {len(times)} images, {lost[0]!r} for example",
            todo="choose another strategy, or hold out whole periods (--strategy periods)",
        )
    return {name: time for name, time in times.items() if time is not None}


def _capture_time(path: Path) -> datetime | None:
    try:
        with Image.open(path) as image:
            exif = image.getexif().get_ifd(_EXIF_IFD)
    except Exception:  # Pillow raises anything for damaged EXIF; the name may still have a date
        exif = {}
    for tag in _CAPTURE_TAGS:
        try:
            return datetime.strptime(str(exif.get(tag, "")).strip("\0 "), "%Y:%m:%d %H:%M:%S")
        except ValueError:
            continue
    return _time_in_name(path.name)


def _time_in_name(name: str) -> datetime | None:
    match = re.match("((?:19|20)[0-9]{2})-?([0-9]{2})-?([0-9]{2})(?![0-9])", name)
    try:
        return datetime(*map(int, match.groups())) if match else None  # type: ignore[arg-type]
    except ValueError:
        return None
