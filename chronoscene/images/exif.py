"""Metadata of photos by cameras and drones: time, place, lens, orientation.

Nothing is trusted: whatever is absent, damaged or absurd is None. Only the header of a file is
read.

Sources: Exif 2.32 (CIPA DC-008) for the tags, JFIF and TIFF 6.0 for where they are in a file; the
names of DJI's XMP attributes are as the makers' photos have them.
"""

from __future__ import annotations

import math
import re
import struct
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from PIL import ExifTags, Image
from PIL.ExifTags import GPS, Base

from chronoscene.io.documents import plain_file

Number = TypeVar("Number", int, float)

_EXIF, _APP1, _START_OF_SCAN = b"Exif\0\0", 0xE1, 0xDA
_SHORT, _LONG = 3, 4

MAX_XMP_BYTES = 1_000_000
MAX_NAME_LENGTH = 100

_DATE = re.compile(
    r"(\d{4})[-:./](\d{1,2})[-:./](\d{1,2})(?!\d)(?:[ T]+(\d{1,2})\D(\d{1,2})(?:\D(\d{1,2}))?)?",
    re.ASCII,
)

YEARS = range(1990, 2100)
"""Years of photos; clocks that were never set say less, and damaged ones more."""

RTK_FIXED, RTK_FLOAT = 50, 34
"""Values of ``RtkFlag``; 16 is a position without corrections, 0 is none."""


@dataclass(frozen=True, slots=True)
class DroneData:
    """Data that drones add in XMP."""

    relative_altitude: float | None = None
    """Metres above the take-off point, by barometer."""
    rtk_std: tuple[float, float, float] | None = None
    """Standard deviations of longitude, latitude and height in metres."""
    rtk_flag: int | None = None
    """`RTK_FIXED`, for example."""
    calibrated_focal: float | None = None
    """Focal length by calibration, in pixels of the photo as it was taken."""
    heading: float | None = None
    """Degrees clockwise from north, of a camera on a gimbal."""


_DRONE = re.compile(rb"(?:drone(?:-\w+)?|Camera):\w")

_CENTIMETRE = 3
_UNITS = {2: 25.4, _CENTIMETRE: 10.0, 4: 1.0}
"""Millimetres in a unit of the focal plane's resolution."""


@dataclass(frozen=True, slots=True)
class ExifData:
    """Metadata of a photo; None for what is missing."""

    date: datetime | None = None
    """Time of capture by the clock of the camera, without a time zone."""
    latitude: float | None = None
    """Degrees, north positive (WGS 84)."""
    longitude: float | None = None
    """Degrees, east positive (WGS 84)."""
    altitude: float | None = None
    """Metres, negative below the reference: the sea or the ellipsoid, which the maker decides."""
    no_hemisphere: bool = False
    """True if a position is left out as it names no hemisphere: Exif has no default for it."""
    is_void: bool = False
    """True if a position is left out as the receiver had none: it may be an old one."""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    """Focal length on 36 x 24 mm film with the same view, in millimetres."""
    focal_plane: float | None = None
    """Pixels of the photo as it was taken, per millimetre of the sensor."""
    gps_error: float | None = None
    """Horizontal error of the position in metres."""
    gps_dop: float | None = None
    """Dilution of precision of the position."""
    heading: float | None = None
    """Degrees clockwise from true north in which the camera looks."""
    make: str | None = None
    model: str | None = None
    orientation: int = 1
    """1..8; 1 is upright."""
    width: int | None = None
    """Pixels, according to the tag; the file may have been resized since."""
    height: int | None = None
    drone: DroneData | None = None

    @property
    def has_position(self) -> bool:
        """True if latitude and longitude are known."""
        return self.latitude is not None and self.longitude is not None


def read_exif(path: Path) -> ExifData:
    """Read the metadata of a photo; empty for a file that is not an image. Never raises."""
    with suppress(Exception), warnings.catch_warnings():  # Pillow raises almost anything
        warnings.simplefilter("ignore")
        with Image.open(plain_file(path)) as image:
            return exif_of(image)
    return ExifData()


def exif_of(image: Image.Image) -> ExifData:
    """Read the metadata of an open image. Never raises."""
    with suppress(Exception):  # damaged metadata raises almost anything, with intact pixels
        tags = Image.Image.getexif(image)  # the one of PNG files would decode the pixels
        if tags or "xmp" in image.info:
            return _parse(tags, _drone(image.info.get("xmp")))
    return ExifData()


def lens_tags(exif: ExifData) -> Image.Exif:
    """Return the tags of camera and focal length, for a copy of a photo in another format."""
    per_cm = None if exif.focal_plane is None else 10 * exif.focal_plane
    camera = {Base.Make: exif.make, Base.Model: exif.model}
    lens = {
        Base.FocalLength: exif.focal_mm,
        Base.FocalLengthIn35mmFilm: exif.focal_35mm and round(exif.focal_35mm),
        Base.FocalPlaneXResolution: per_cm,
        Base.FocalPlaneYResolution: per_cm,
        Base.FocalPlaneResolutionUnit: _CENTIMETRE,
        Base.ExifImageWidth: exif.width,
        Base.ExifImageHeight: exif.height,
    }
    tags = Image.Exif()
    for directory, values in ((tags, camera), (tags.get_ifd(ExifTags.IFD.Exif), lens)):
        directory.update({tag: value for tag, value in values.items() if value is not None})
    return tags


def taken_at(path: Path, exif: ExifData) -> datetime | None:
    """Return the time of capture: from EXIF, else from a date at the start of the file name."""
    if exif.date is not None:
        return exif.date
    found = re.match(r"((?:19|20)\d{2})[-_]?(\d{2})[-_]?(\d{2})(?!\d)", path.name, re.ASCII)
    try:
        return datetime(*map(int, found.groups())) if found else None  # type: ignore[arg-type]
    except ValueError:
        return None


def capture_times(images: Path, names: Iterable[str]) -> dict[str, datetime | None]:
    """Return the time of capture of each photo in a folder, by name; None if unknown."""
    return {name: taken_at(images / name, read_exif(images / name)) for name in names}


def _ifd(tags: Image.Exif, key: int) -> Mapping[int, Any]:
    with suppress(Exception):  # one damaged directory must not hide the others
        return tags.get_ifd(key)
    return {}


def _parse(tags: Image.Exif, drone: DroneData | None) -> ExifData:
    main: Mapping[int, Any] = dict(tags)
    exif, gps = _ifd(tags, ExifTags.IFD.Exif), _ifd(tags, ExifTags.IFD.GPSInfo)
    latitude = _degrees(gps.get(GPS.GPSLatitude), 90.0)
    longitude = _degrees(gps.get(GPS.GPSLongitude), 180.0)
    north = _sign(gps.get(GPS.GPSLatitudeRef), "NS")
    east = _sign(gps.get(GPS.GPSLongitudeRef), "EW")
    no_hemisphere = False
    is_void = False
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        latitude = longitude = None  # without a fix, some cameras write zeros
    elif (_text(gps.get(GPS.GPSStatus)) or "").upper().startswith("V"):
        latitude, longitude, is_void = None, None, True
    elif north is None or east is None:
        latitude, longitude, no_hemisphere = None, None, True
    else:
        latitude, longitude = north * latitude, east * longitude
    altitude = _number(gps.get(GPS.GPSAltitude))
    if altitude is not None and _integer(gps.get(GPS.GPSAltitudeRef)) in (1, 3):
        altitude = -altitude  # below the reference
    date = _date(exif.get(Base.DateTimeOriginal)) or _date(exif.get(Base.DateTimeDigitized))
    orientation = _integer(main.get(Base.Orientation)) or 1
    return ExifData(
        date=date or _gps_date(gps),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        no_hemisphere=no_hemisphere,
        is_void=is_void,
        focal_mm=_positive(_number(exif.get(Base.FocalLength))),
        focal_35mm=_positive(_number(exif.get(Base.FocalLengthIn35mmFilm))),
        focal_plane=_focal_plane(exif),
        gps_error=_positive(_number(gps.get(GPS.GPSHPositioningError))),
        gps_dop=_positive(_number(gps.get(GPS.GPSDOP))),
        heading=_heading(gps),
        make=_text(main.get(Base.Make)),
        model=_text(main.get(Base.Model)),
        orientation=orientation if 1 <= orientation <= 8 else 1,
        width=_positive(_integer(exif.get(Base.ExifImageWidth))),
        height=_positive(_integer(exif.get(Base.ExifImageHeight))),
        drone=drone,
    )


def _focal_plane(exif: Mapping[int, Any]) -> float | None:
    """Resolution of the sensor, in pixels per millimetre."""
    resolution = _positive(_number(exif.get(Base.FocalPlaneXResolution)))
    unit = _UNITS.get(_integer(exif.get(Base.FocalPlaneResolutionUnit)) or 2)
    return None if resolution is None or unit is None else resolution / unit


def _heading(gps: Mapping[int, Any]) -> float | None:
    """Direction of view; one from magnetic north is not comparable."""
    degrees = _number(gps.get(GPS.GPSImgDirection))
    magnetic = (_text(gps.get(GPS.GPSImgDirectionRef)) or "T").upper().startswith("M")
    return None if degrees is None or magnetic or not 0 <= degrees <= 360 else degrees


def _drone(xmp: Any) -> DroneData | None:
    """Find attributes of DJI, Autel and Pix4D by name: an XML parser gets no untrusted XMP."""
    if not isinstance(xmp, bytes) or not _DRONE.search(xmp[:MAX_XMP_BYTES]):
        return None
    text = xmp[:MAX_XMP_BYTES].decode("utf-8", "replace")

    def value(name: str) -> float | None:
        pattern = rf"(?:drone(?:-\w+)?|Camera):{name}\s*(?:=\s*[\"']|>)\s*([-+0-9.eE]{{1,40}})"
        found = re.search(pattern, text)
        return _number(found[1]) if found else None

    lon, lat, height = (value(f"RtkStd{axis}") for axis in ("Lon", "Lat", "Hgt"))
    if lon is None and lat is None and height is None:
        lon = lat = value("GPSXYAccuracy")
        height = value("GPSZAccuracy")
    known = lon is not None and lat is not None and height is not None
    dewarp = re.search(r"DewarpData\s*=\s*[\"'][^;\"']{1,20};([0-9.]{1,20}),", text)
    focal = _number(dewarp[1]) if dewarp else None
    return DroneData(
        relative_altitude=value("RelativeAltitude"),
        rtk_std=(lon, lat, height) if known else None,  # type: ignore[arg-type]
        rtk_flag=_integer(value("RtkFlag")),
        calibrated_focal=_positive(focal) or _positive(value("CalibratedFocalLength")),
        heading=value("GimbalYawDegree"),
    )


def _date(value: Any) -> datetime | None:
    """Parse date and time in the form of Exif, or in variants that other programs write.

    Midnight where the time of day is missing or impossible. Fractions of a second and time zones
    are ignored: clocks of cameras are not that accurate.
    """
    found = _DATE.match(_text(value) or "")
    if not found:
        return None
    year, month, day, *time = (int(group or 0) for group in found.groups())
    for clock in (time, (0, 0, 0)):
        try:
            date = datetime(year, month, day, *clock)
        except ValueError:
            continue
        return date if year in YEARS else None
    return None


def _gps_date(gps: Mapping[int, Any]) -> datetime | None:
    """Parse date and time of a GPS fix, in UTC."""
    date, time = _date(gps.get(GPS.GPSDateStamp)), gps.get(GPS.GPSTimeStamp)
    if date is None or not isinstance(time, tuple | list) or len(time) != 3:
        return date
    hour, minute, second = (_number(part) for part in time)
    if hour is None or minute is None or second is None or not 0 <= hour < 24:
        return date
    return date + timedelta(hours=hour, minutes=minute % 60, seconds=second % 60)


def _degrees(value: Any, limit: float) -> float | None:
    """Combine degrees, minutes and seconds in one number without a sign."""
    if not isinstance(value, tuple | list) or not 1 <= len(value) <= 3:
        return None
    degrees = 0.0
    for i, part in enumerate(map(_number, value)):
        if part is None or part < 0:
            return None
        degrees += part / 60**i
    return degrees if degrees <= limit else None


def _sign(ref: Any, directions: str) -> int | None:
    """Return 1 for the first of two directions and -1 for the second; None for anything else."""
    found = directions.find((_text(ref) or " ")[0].upper())
    return None if found < 0 else 1 - 2 * found


def _number(value: Any) -> float | None:
    with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
        number = float(value)
        return number if math.isfinite(number) else None
    return None


def _positive(number: Number | None) -> Number | None:
    return number if number is not None and number > 0 else None


def _integer(value: Any) -> int | None:
    if isinstance(value, bytes) and len(value) == 1:
        return value[0]
    number = _number(value)
    return int(number) if number is not None and number == int(number) else None


def _text(value: Any) -> str | None:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str):
        return None
    text = "".join(c for c in value if c.isprintable()).strip()
    return text[:MAX_NAME_LENGTH] or None


def set_upright(data: bytes) -> bytes | None:
    """Return a JPEG with orientation 1 and equal pixels; None if there is nothing to change.

    Pillow would rewrite all metadata and lose what it does not know.
    """
    upright = bytearray(data)
    for at, order in _orientation_values(data):
        struct.pack_into(f"{order}H", upright, at, 1)
    return bytes(upright) if upright != data else None


def _orientation_values(data: bytes) -> Iterator[tuple[int, str]]:
    """Yield the offset of the 16 bits of each orientation tag, and their byte order."""
    for start, tiff in _exif_segments(data):
        order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
        if order is None:
            continue
        try:
            (directory,) = struct.unpack_from(f"{order}I", tiff, 4)
            (count,) = struct.unpack_from(f"{order}H", tiff, directory)
            for i in range(count):
                entry = directory + 2 + 12 * i
                tag, kind, length, _ = struct.unpack_from(f"{order}HHII", tiff, entry)
                if tag == Base.Orientation and kind in (_SHORT, _LONG) and length == 1:
                    yield start + entry + (10 if kind == _LONG and order == ">" else 8), order
        except struct.error:
            pass  # a directory beyond the end of the segment


def _exif_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield offset and content of the TIFF data in each Exif segment of a JPEG."""
    at = 2 if data[:2] == b"\xff\xd8" else len(data)
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != _START_OF_SCAN:
        end = at + 2 + struct.unpack_from(">H", data, at + 2)[0]
        if data[at + 1] == _APP1 and data.startswith(_EXIF, at + 4):
            start = at + 4 + len(_EXIF)
            yield start, data[start:end]
        at = end
