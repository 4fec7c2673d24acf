"""One photo: whether it is usable, and its metadata."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path, PurePosixPath

from PIL import Image

from chronoscene.images.decoding import HEIF_SUFFIXES, HEIF_TODO, reads_heif, stored_size
from chronoscene.images.exif import RTK_FIXED, RTK_FLOAT, ExifData, read_exif, taken_at
from chronoscene.images.masks import find_masks
from chronoscene.io.documents import plain_file

GPS_SIGMA = (5.0, 5.0, 10.0)
"""Metres east, north, up, if the photo states none: a consumer receiver under open sky."""

FIXED = (0.02, 0.02, 0.03)  # The same of a fixed RTK solution, at least
FLOAT = (0.5, 0.5, 0.8)

DOP_METRES = 3.0  # Error of a position by a receiver without corrections, for a dilution of 1
LEAST_ERROR = 1.0  # Metres; an error that EXIF states is never smaller
MAX_ERROR = 1000.0  # A larger one is a mistake

LOOK_SIDE = 24

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
    """Its mask file, in ``masks/`` beside the folder of the photos or in it."""
    look: bytes = b""
    """Grey levels of the photo reduced to `LOOK_SIDE` pixels a side, by which copies are found."""


def open_photo(path: Path, name: str, period: int) -> Capture | str:
    """Read a capture; the reason if it is unusable. All files are decoded: many are truncated."""
    try:
        with Image.open(plain_file(path)) as image:
            width, height = stored_size(image)
            # A JPEG is then read to its end, but decoded at a reduced size.
            image.draft("RGB", (width // 8, height // 8))
            image.load()
            small = image.convert("L").resize((LOOK_SIDE, LOOK_SIDE), Image.Resampling.BOX)
            look = small.tobytes()
    except FileNotFoundError:
        return "the file is missing"
    except Exception as error:  # Pillow raises almost anything for damaged files
        if path.suffix.lower() in HEIF_SUFFIXES and not reads_heif():
            return f"HEIC photos are not read; {HEIF_TODO}"
        return f"cannot be decoded: {str(error) or type(error).__name__}"
    if min(width, height) < MIN_SIDE:
        return f"{width} x {height} pixels: too small"
    if is_panorama(path) or max(width, height) > MAX_ASPECT * min(width, height):
        return f"{width} x {height} pixels: a panorama, which no perspective camera model describes"
    exif = read_exif(path)
    above = path.absolute().parents
    depth = len(PurePosixPath(name).parts)
    masks = find_masks(above[depth - 1], [name]) | find_masks(above[depth], [name])
    return Capture(
        name=name,
        path=path,
        period=period,
        width=width,
        height=height,
        exif=exif,
        taken=taken_at(path, exif),
        gps=_position(exif),
        mask=masks.get(name),
        look=look,
    )


def is_panorama(path: Path) -> bool:
    """Return True if GPano metadata declare an equirectangular or cylindrical projection."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    return re.search(rb"GPano:ProjectionType\W{1,4}(equirectangular|cylindrical)", head) is not None


def _position(exif: ExifData) -> Gps | None:
    if exif.latitude is None or exif.longitude is None:
        return None
    return Gps(
        latitude=exif.latitude,
        longitude=exif.longitude,
        altitude=exif.altitude,
        relative_altitude=None if exif.drone is None else exif.drone.relative_altitude,
        sigma=gps_sigma(exif),
    )


def gps_sigma(exif: ExifData) -> tuple[float, float, float]:
    """Standard deviations of a position east, north and up, by what the photo states.

    In this order: deviations in XMP, the kind of its RTK solution, the error or the dilution of
    precision in EXIF. Errors of a consumer receiver are twice as large in height.
    """
    drone = exif.drone
    if drone is not None and drone.rtk_std is not None and all(0 < s < 100 for s in drone.rtk_std):
        # Stated deviations are of the antenna at the fix, not at the shutter.
        east, north, up = (max(s, least) for s, least in zip(drone.rtk_std, FIXED, strict=True))
        return east, north, up
    if drone is not None and drone.rtk_flag == RTK_FIXED:
        return FIXED
    if drone is not None and drone.rtk_flag == RTK_FLOAT:
        return FLOAT
    if exif.gps_error is not None and exif.gps_error < MAX_ERROR:
        error = max(exif.gps_error, LEAST_ERROR)
    elif exif.gps_dop is not None and exif.gps_dop * DOP_METRES < MAX_ERROR:
        error = max(exif.gps_dop * DOP_METRES, LEAST_ERROR)
    else:
        return GPS_SIGMA
    return error, error, 2 * error
