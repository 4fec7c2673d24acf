"""The result of a registration: poses of all periods in one frame, points, held-out tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.geodesy import Georeference
from chronoscene.registration.features import METHOD
from chronoscene.registration.photos.stated import Stated
from chronoscene.scene import Camera

Route = Literal["joint", "frozen", "separate", "resection"]

ROUTES: tuple[Route, ...] = ("joint", "frozen", "separate", "resection")


ANOTHER_PLACE = "another place, or wrong positions"
"""End of the reason why photos of a period are missing that is far from the others."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutTracks:
    """Observations of held-out tracks in registered images, grouped by track.

    Whole tracks are held out: no match of any of their keypoints, within a period or across,
    reached the mapper. A track has at most one observation an image and is seen in at least two
    periods, so that it can be triangulated in one and projected into another.
    """

    start: Ints
    """Observations of track i are ``start[i]:start[i + 1]``. [K + 1]"""
    image: Ints
    """Index into `Registered.names`. [O]"""
    xy: Array
    """[O, 2]"""

    @classmethod
    def empty(cls) -> HeldOutTracks:
        return cls(np.zeros(1, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Resection:
    """Precision of poses that surveyed points fix, by two measures."""

    deviations: Mapping[str, tuple[list[float], list[float]]]
    """Standard deviations by photo, from the adjustment: of its centre in world units, and of its
    turns about the axes of the world in degrees. Empty if the points do not fix all poses."""
    left_out: Mapping[str, tuple[list[float], list[float]] | None]
    """Error of each control point in an adjustment to which its coordinates are unknown, and the
    standard deviations of that, world units; None if the others do not fix the poses."""


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """One model of all periods, in metres if georeferenced or moved to ground control.

    N registered images, P points, O observations.
    """

    names: tuple[str, ...]
    """Registered images, sorted, unique: paths below the folder of the prepared photos."""
    periods: Ints
    """Period of each image. [N]"""
    cam_from_world: Array
    """[N, 4, 4]"""
    cameras: tuple[Camera, ...]
    """Camera of each image, with its distortion. [N]"""
    points: Array
    """[P, 3]"""
    colors: NDArray[np.uint8]
    """[P, 3]"""
    track_start: Ints
    """Observations of point i are ``track_start[i]:track_start[i + 1]``. [P + 1]"""
    track_image: Ints
    """Index into ``names``. [O]"""
    track_xy: Array
    """Pixels of the observations. [O, 2]"""
    unregistered: Mapping[str, str]
    """Name of each image that has no pose, and why. A refused photo is listed by its path."""
    unregistered_periods: Mapping[str, int]
    """Period of each of them."""
    route: Route
    gps_enu: Array
    """GPS position of each photo in the frame of the model, plausible or not; else NaN. [N, 3]"""
    gps_used: Mask
    """True if the position took part in the estimation. [N]"""
    georeference: Georeference | None
    """None if the place in the world is unknown."""
    num_periods: int
    labels: tuple[str, ...]
    dates: tuple[str | None, ...]
    """ISO dates of the periods."""
    held_out_tracks: HeldOutTracks
    images_root: str
    """Folder of the images: photos as ``cameras`` describe them."""
    stated: Mapping[str, Stated] = field(default_factory=dict)
    """Metadata of photos to compare with, by name."""
    short: bool = False
    """True if points of two images and of small angles count."""
    held: bool = False
    """True if focal lengths are those that photos state."""
    loose: frozenset[str] = frozenset()
    """Images in parts that most matches with the rest contradict (`consistency.loose_parts`)."""
    unplaced: frozenset[str] = frozenset()
    """Images of periods that are in a frame of their own, to be placed by tie points."""
    features: str = METHOD
    """Name of the features and matches."""
    resection: Resection | None = None
    """Precision of poses that surveyed points fix."""
    local_metres: bool = False
    """True if the frame is that of ground control without a reference system."""

    @property
    def unit(self) -> str:
        """``metre``, or ``unknown``."""
        return "unknown" if self.georeference is None and not self.local_metres else "metre"

    def counts(self) -> list[dict[str, Any]]:
        """Count the photos of each period, those that cannot be used among them."""
        placed = np.bincount(self.periods, minlength=self.num_periods).tolist()
        missing = list(self.unregistered_periods.values())
        return [
            {"period": i, "label": label, "photos": n + missing.count(i), "registered": n}
            for i, (label, n) in enumerate(zip(self.labels, placed, strict=True))
        ]
