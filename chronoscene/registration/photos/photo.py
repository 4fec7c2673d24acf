"""One photo: whether it is usable, and its metadata."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path, PurePosixPath

from PIL import Image

from chronoscene.images.exif import ExifData, read_exif, taken_at
from chronoscene.images.masks import find_masks
from chronoscene.io.documents import plain_file

GPS_SIGMA = (5.0, 5.0, 10.0)
"""Metres east, north, up, if the photo states none: a consumer receiver under open sky."""

MIN_SIDE = 64  # Pixels; smaller images are icons and previews
HEAD_BYTES = 200_000  # Bytes of a file that are searched for panorama metadata
MAX_ASPECT = 3.0  # Wider images are panoramas, which no perspective camera model describes


@dataclass(frozen=True, slots=True)
class Gps:
    """GPS position in the metadata of a photo."""

    latitude: float
    """Degrees."""
    longitude: float
    altitude: float | None
    """Metres, as the photo states it."""
    relative_altitude: float | None
    """Metres above take-off."""
    sigma: tuple[float, float, float]
    """Metres east, north, up."""


@dataclass(frozen=True, slots=True)
class Capture:
    """One photograph."""

    name: str
    """Unique over all periods: ``<period folder>/<path in it>`` in posix form."""
    path: Path
    period: int
    width: int
    """Pixels, as stored."""
    height: int
    exif: ExifData
    taken: datetime | None
    gps: Gps | None
    mask: Path | None = None
    """Its mask file, in ``masks/`` beside the folder of the photos."""


def open_photo(path: Path, name: str, period: int) -> Capture | str:
    """Read a capture; the reason if it is unusable. All files are decoded: many are truncated."""
    try:
        with Image.open(plain_file(path)) as image:
            width, height = image.size
            # A JPEG is then read to its end, but decoded at a reduced size.
            image.draft("RGB", (width // 8, height // 8))
            image.load()
    except Exception as error:  # Pillow raises almost anything for damaged files
        return f"cannot be decoded: {str(error) or type(error).__name__}"
    if min(width, height) < MIN_SIDE:
        return f"{width} x {height} pixels: too small"
    if is_panorama(path) or max(width, height) > MAX_ASPECT * min(width, height):
        return f"{width} x {height} pixels: a panorama, which no perspective camera model describes"
    exif = read_exif(path)
    beside = path.absolute().parents[len(PurePosixPath(name).parts)]
    return Capture(
        name=name,
        path=path,
        period=period,
        width=width,
        height=height,
        exif=exif,
        taken=taken_at(path, exif),
        gps=_position(exif),
        mask=find_masks(beside, [name]).get(name),
    )


def is_panorama(path: Path) -> bool:
    """Return True if GPano metadata declare an equirectangular or cylindrical projection."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    return re.search(rb"GPano:ProjectionType\W{1,4}(equirectangular|cylindrical)", head) is not None


def _position(exif: ExifData) -> Gps | None:
    if exif.latitude is None or exif.longitude is None:
        return None
    drone = exif.drone
    sigma = GPS_SIGMA
    relative = None
    if drone is not None:
        relative = drone.relative_altitude
        if drone.rtk_std is not None and all(0 < s < 100 for s in drone.rtk_std):
            east, north, up = drone.rtk_std
            # Stated deviations are of the antenna at the fix, not at the shutter: at least 2 cm.
            sigma = (max(east, 0.02), max(north, 0.02), max(up, 0.03))
    return Gps(
        latitude=exif.latitude,
        longitude=exif.longitude,
        altitude=exif.altitude,
        relative_altitude=relative,
        sigma=sigma,
    )
