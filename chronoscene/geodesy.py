"""Positions in a local east-north-up frame in metres, geodetic and projected, by PROJ.

The frame is topocentric (EPSG method 9837) around a position: there is no map projection and so
no distortion. No geoid grid is needed, because heights are used as stated: heights above sea level
instead of the ellipsoid shift the whole frame vertically and do not bend it. Projected coordinates
are no such frame: their scale is not 1, their north is not north, and they ignore the curvature of
the earth. So they are converted point by point.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import ChronoSceneError, ConfigError, SceneError

STEP = 10.0
"""Metres to either side over which a projection is differentiated: curvature cancels out."""
WGS84 = "EPSG:4326"
USUAL_ACCURACY = 1.0
"""Metres. No national system has a better conversion to WGS 84, of which there are several."""

HeightKind = Literal["as stated", "relative", "none"]


@dataclass(frozen=True, slots=True)
class Georeference:
    """A local frame: x east, y north, z up, in metres, around an origin on WGS 84."""

    latitude: float
    """Degrees, of the origin."""
    longitude: float
    height: float
    """Metres, of the origin, in the sense of ``height_kind``."""
    height_kind: HeightKind
    """``as stated`` (above sea level or the ellipsoid: photos do not state which), ``relative``
    (above take-off, by the barometer) or ``none`` (unknown: all are set to zero)."""

    @property
    def crs(self) -> str:
        """PROJ string of the frame: the last step of a pipeline."""
        return (
            f"+proj=topocentric +ellps=WGS84 +lat_0={self.latitude!r} +lon_0={self.longitude!r} "
            f"+h_0={self.height!r}"
        )

    def to_enu(self, latitude: Array, longitude: Array, height: Array) -> Array:
        """Metres east, north and up of the origin. [N] each -> [N, 3]"""
        places = _pipeline(self.crs).transform(longitude, latitude, height)
        return np.stack([np.asarray(a, np.float64) for a in places], axis=-1)

    def to_geodetic(self, enu: Array) -> Array:
        """Latitude, longitude (degrees) and height (metres): inverse of `to_enu`. [N, 3]"""
        inverse: Any = "INVERSE"
        east, north, up = np.moveaxis(enu, -1, 0)
        lon, lat, height = _pipeline(self.crs).transform(east, north, up, direction=inverse)
        return np.stack([lat, lon, height], axis=-1)


@dataclass(frozen=True, slots=True)
class ReferenceSystem:
    """A projected or geographic reference system.

    Coordinates are east, north, height, or longitude, latitude, height. Heights are those of
    `Georeference`, in the unit of the system, otherwise unchanged.
    """

    text: str
    """Its name for PROJ, such as ``EPSG:32632``."""
    is_projected: bool
    unit: float = 1.0
    """Metres in a unit of its coordinates, such as a foot; 1 for degrees, whose heights are in
    metres."""
    axes: tuple[str, ...] = ("east", "north")
    """Directions of its axes."""

    @property
    def is_east_north(self) -> bool:
        """False if an axis points the other way; around a pole, both point along meridians."""
        return set(self.axes) in ({"east", "north"}, {"north"}, {"south"})

    def to_local(self, frame: Georeference, xyz: Array) -> Array:
        """Coordinates in this system to a local frame; not finite outside its area. [N, 3]"""
        # Heights stay as they are, but those far above an ellipsoid shift its change to another.
        longitude, latitude, height = _to_wgs84(self.text).transform(
            xyz[:, 0], xyz[:, 1], self.unit * xyz[:, 2]
        )
        return frame.to_enu(latitude, longitude, height)

    def from_local(self, frame: Georeference, enu: Array) -> Array:
        """Inverse of `to_local`. [N, 3]"""
        latitude, longitude, height = frame.to_geodetic(enu).T
        inverse: Any = "INVERSE"
        x, y, z = _to_wgs84(self.text).transform(longitude, latitude, height, direction=inverse)
        return np.column_stack([x, y, z / self.unit])

    def to_geodetic(self, place: Array) -> tuple[float, float]:
        """Latitude and longitude of coordinates in this system, degrees. [3]"""
        longitude, latitude = _to_wgs84(self.text).transform(place[0], place[1])
        return float(latitude), float(longitude)

    def remarks_at(self, latitude: float, longitude: float, source: str = WGS84) -> list[str]:
        """List reasons for which coordinates, converted from another system, are not exact.

        Args:
            latitude: Of the place, degrees.
            longitude: Of the place, degrees.
            source: The other system.
        """
        if not np.isfinite([latitude, longitude]).all():
            return []
        outside = self._outside(latitude, longitude)
        found = outside or self._inexact(latitude, longitude, source)
        return [] if found is None else [found]

    def _outside(self, latitude: float, longitude: float) -> str | None:
        """Return a remark if a place is outside of the area of the system.

        Its coordinates are as PROJ computes them there: distorted, or far off without a sign of it.
        None inside, and for a system without an area.
        """
        import pyproj

        area = pyproj.CRS.from_user_input(self.text).area_of_use
        if area is None:
            return None
        width = (area.east - area.west) % 360 or 360
        if (longitude - area.west) % 360 <= width and area.south <= latitude <= area.north:
            return None
        return (
            f"the scene is at {latitude:.4f} north, {longitude:.4f} east, outside of "
            f"the area of {self.text} ({area.south:g} to {area.north:g} north, {area.west:g} to "
            f"{area.east:g} east): coordinates in it may be distorted or wrong"
        )

    def _inexact(self, latitude: float, longitude: float, source: str) -> str | None:
        """Return a remark if PROJ does not convert a system to this one as exactly as usual."""
        from pyproj.aoi import AreaOfInterest

        here = AreaOfInterest(longitude, latitude, longitude, latitude)
        group = _conversions(source, self.text, here)
        used, pair = group.transformers[0], f"between {source} and {self.text}"
        if "Ballpark" in used.description:
            return f"PROJ knows no conversion {pair} here and takes their datums for the same"
        if used.accuracy <= USUAL_ACCURACY:
            return None
        better, best = "", group.unavailable_operations[:1]
        if not group.best_available and 0 <= best[0].accuracy < used.accuracy:
            better = f" ({best[0].accuracy:g} m with a grid: {_install(best[0])})"
        return (
            f"PROJ converts {pair} with an accuracy of {used.accuracy:g} m here{better}: "
            f"coordinates may be off by as much, except with ground control given in {self.text}"
        )

    def derivative(self, frame: Georeference, enu: Array) -> Array:
        """Derivative of the coordinates by those of the local frame. [N, 3] -> [N, 3, 3]"""
        places = enu[:, None, None] + STEP * np.array([1.0, -1.0])[:, None, None] * np.eye(3)
        ahead, behind = np.moveaxis(
            self.from_local(frame, places.reshape(-1, 3)).reshape(places.shape), 1, 0
        )
        return np.asarray(np.swapaxes(ahead - behind, 1, 2) / (2 * STEP))


def read_reference_system(
    place: str, text: str, *, error: type[ChronoSceneError] = SceneError
) -> ReferenceSystem:
    """Parse a reference system.

    Raises:
        ChronoSceneError: If PROJ does not know it, if it is neither geographic nor projected, if
            it has heights of its own, or if PROJ lacks the grid that it needs.
    """
    import pyproj

    def wrong(found: str, todo: str) -> ChronoSceneError:
        expected = "a horizontal reference system that PROJ knows, such as EPSG:32632"
        return error(place, expected=expected, found=f"{text[:80]!r}{found}", todo=todo)

    try:
        crs = pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as cause:
        raise wrong("", "correct it; WGS 84 / UTM zone 32N is understood, too") from cause
    if crs.is_compound:
        todo = "give its horizontal part alone: heights stay as they are stated"
        raise wrong(", which has heights above a geoid", todo)
    if not crs.is_geographic and not crs.is_projected:
        raise wrong(f", which is {crs.type_name.lower()}", "convert to a projected one")
    try:
        group = _conversions(crs, WGS84)
    except IndexError as cause:  # pyproj wants to name a grid, and there is none
        found = ", which PROJ does not convert to WGS 84 exactly"
        raise wrong(found, "convert to a system on WGS 84") from cause
    if not group.best_available:
        best = group.unavailable_operations[0]
        grids = ", ".join(grid.short_name for grid in best.grids)
        raise wrong(
            f", which PROJ converts exactly only with the grid {grids}",
            f"install it ({_install(best)}), or convert to a system on WGS 84",
        )
    unit = float(crs.axis_info[0].unit_conversion_factor) if crs.is_projected else 1.0
    axes = tuple(str(axis.direction) for axis in crs.axis_info[:2])
    return ReferenceSystem(text, bool(crs.is_projected), unit, axes)


def read_projected(
    place: str,
    text: str,
    *,
    metres: bool = False,
    todo: str = "choose the UTM zone of the place (--crs), for example",
) -> ReferenceSystem:
    """Parse the reference system of an output, which must be projected, and in metres if asked.

    Its axes must point east and north: what is written is called so, and cameras are turned by it.
    ``todo`` is the advice where they do not, or it is of another kind.

    Raises:
        ConfigError: If it is not, or as `read_reference_system`.
    """
    system = read_reference_system(place, text, error=ConfigError)
    found = None
    if not system.is_projected or (metres and system.unit != 1):
        found = f"one in {'feet' if system.is_projected else 'degrees'}"
    elif not system.is_east_north:
        found = f"one whose axes point {' and '.join(system.axes)}"
    if found is not None:
        raise ConfigError(
            place,
            expected=f"a projected reference system{' in metres' * metres}, with axes east and "
            "north, such as EPSG:32632",
            found=f"{found} ({text})",
            todo=todo,
        )
    return system


def from_crs(crs: str | None) -> Georeference | None:
    """The frame that `Georeference.crs` describes; None for any other text."""
    number = r"([-+0-9.e]+)"
    pattern = rf"\+proj=topocentric \+ellps=WGS84 \+lat_0={number} \+lon_0={number} \+h_0={number}"
    found = re.fullmatch(pattern, crs or "")
    if found is None:
        return None
    latitude, longitude, height = (float(value) for value in found.groups())
    return Georeference(latitude, longitude, height, height_kind="as stated")


def median_longitude(degrees: Array) -> float:
    """Median of longitudes in degrees, correct across the antimeridian."""
    first = degrees[0]
    turned = (degrees - first + 180) % 360 - 180
    return float((np.median(turned) + first + 180) % 360 - 180)


def _pipeline(crs: str) -> Any:
    """Transformer from longitude, latitude (degrees) and height (metres) to the frame."""
    import pyproj

    return pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=cart +ellps=WGS84 +step {crs}"
    )


@lru_cache(maxsize=16)
def _to_wgs84(crs: str) -> Any:
    """Transformer from a reference system to longitude and latitude in degrees."""
    import pyproj

    return pyproj.Transformer.from_crs(crs, WGS84, always_xy=True)


def _conversions(source: Any, target: Any, area: Any = None) -> Any:
    """Conversions between two systems that PROJ knows, the best ones first."""
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a grid that is not there
        return TransformerGroup(source, target, always_xy=True, area_of_interest=area)


def _install(operation: Any) -> str:
    """Commands that install the grids of a conversion."""
    return "; ".join(f"pyproj sync --file {grid.short_name}" for grid in operation.grids)
