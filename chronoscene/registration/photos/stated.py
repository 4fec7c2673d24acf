"""Focal length, height and heading that the metadata of a photo state, to compare with."""

from __future__ import annotations

from dataclasses import dataclass

from chronoscene.registration.photos.photo import Capture

FILM_WIDTH = 35.0
"""Longer side that focal lengths for film refer to, in millimetres: by the diagonal of a sensor of
4:3 it is 34.6, by the width of one of 3:2 it is 36."""

FILM_ERROR, PLANE_ERROR, CALIBRATED_ERROR = 0.03, 0.02, 0.005
"""Relative errors of a focal length for film, which is also rounded to millimetres; by the
resolution of the sensor; and by calibration."""

MAX_DIFFERENCE = 0.05  # Between a focal length and a stated one, beyond the error of the latter

MAX_ASPECT_CHANGE = 0.02  # A photo of another shape than its metadata say has been cropped


@dataclass(frozen=True, slots=True)
class Stated:
    """Metadata of a photo to compare a model with; None for what is missing."""

    focal: float | None = None
    """Pixels of the photo as it is."""
    focal_error: float = 0.0
    """Relative standard deviation."""
    height: float | None = None
    """Metres above the take-off point."""
    heading: float | None = None
    """Degrees clockwise from north in which the camera looks; of its upper side, if down."""


def stated(capture: Capture) -> Stated:
    """Collect what the metadata of a photo state."""
    exif, drone = capture.exif, capture.exif.drone
    focal, error = _focal(capture)
    heading = exif.heading if drone is None or drone.heading is None else drone.heading
    height = None if drone is None else drone.relative_altitude
    return Stated(focal, error, height, heading)


def _focal(capture: Capture) -> tuple[float | None, float]:
    """Focal length in pixels and its relative error, from the most precise source."""
    exif = capture.exif
    width, height = exif.width or capture.width, exif.height or capture.height
    if (width < height) != (capture.width < capture.height):
        width, height = height, width
    if abs(width * capture.height / (height * capture.width) - 1) > MAX_ASPECT_CHANGE:
        return None, 0.0
    resized = capture.width / width
    if exif.drone is not None and exif.drone.calibrated_focal is not None:
        return exif.drone.calibrated_focal * resized, CALIBRATED_ERROR
    if exif.focal_35mm is not None:
        pixels = exif.focal_35mm / FILM_WIDTH * max(capture.width, capture.height)
        return pixels, FILM_ERROR + 0.5 / exif.focal_35mm
    if exif.focal_mm is not None and exif.focal_plane is not None:
        return exif.focal_mm * exif.focal_plane * resized, PLANE_ERROR
    return None, 0.0


def contradicts(focal: float, stated_focal: float, error: float) -> bool:
    """Return True if a focal length differs from a stated one by 5 % more than its error."""
    return abs(focal / stated_focal - 1) > MAX_DIFFERENCE + error
